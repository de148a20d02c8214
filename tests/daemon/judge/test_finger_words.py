"""State of each finger: free, touch or slide. An unknown one is None, and none flickers."""

from __future__ import annotations

import math
from collections.abc import Callable
from itertools import pairwise

import pytest

from graspd.biotac import Finger
from graspd.daemon.judge.decision import Limits
from graspd.daemon.judge.hand import FingerWord, HandTracker
from graspd.daemon.judge.health import Checked
from graspd.daemon.judge.pipeline import Pipeline
from graspd.daemon.judge.reasons import FingerState, GateState, Reason
from graspd.models import zoo
from graspd.models.runtime import TactileModel
from tests.daemon.fakes import FINGERS, MS
from tests.daemon.judge.test_gate import ALL, LIMITS, Scenario, readings

FREE, TOUCH, SLIDE = FingerState
UNKNOWN = dict.fromkeys(FINGERS)
HELD = dict.fromkeys(FINGERS, TOUCH)
FIRM = Scenario("firm", ((0.0, 0.0), (0.2, 300.0)), "", seconds=1.5)
SLIPPING = Scenario(
    "one finger slips from 1 s to 1.3 s",
    {
        "ff": ((0.0, 0.0), (0.2, 300.0), (1.0, 300.0), (1.3, 255.0)),  # 70 counts/s in the mean
        "mf": ((0.0, 0.0), (0.2, 300.0)),
        "th": ((0.4, 0.0), (0.6, 300.0), (2.2, 300.0), (2.4, 0.0)),
    },
    "",
    seconds=2.5,
)
Told = list[tuple[float, GateState | None, dict[Finger, FingerState | None]]]
"""Time, s, state of the gate and states of the fingers at each reading."""
SOUND = Checked((), None)


def felt(
    scenario: Scenario,
    restart_s: float = math.inf,
    check: Callable[[float], Checked] = lambda _t_s: SOUND,
) -> Told:
    """Return what a hand reports in a scenario; at `restart_s` its grasp must settle again.

    `check`: result of the health check by time, s.
    """
    hand, told = HandTracker(FINGERS, LIMITS), Told()
    for t_s, reading in readings(scenario):
        if abs(t_s - restart_s) < 1e-6:
            hand.restart()
        moment, _ = hand.step(reading.made_ns, reading.counts, check(t_s))
        assert moment.fingers is not None
        told.append((t_s, moment.state, dict(moment.fingers)))
    assert hand.silent().fingers == UNKNOWN, "nothing is told without a reading"
    return told


def words(told: Told, finger: Finger) -> list[str]:
    """Return the states of a finger in `told`, in order, each as often as it begins."""
    said = [feelings[finger] or "unknown" for _, _, feelings in told]
    return [said[0], *(word for former, word in pairwise(said) if word != former)]


def test_finger_states_follow_a_grasp_from_rest_to_release() -> None:
    told = felt(SLIPPING)
    assert words(told, "ff") == ["unknown", "free", "slide", "touch", "slide", "touch"]
    assert words(told, "mf") == ["unknown", "free", "slide", "touch"]
    assert words(told, "th") == ["unknown", "free", "slide", "touch", "slide", "free"]
    slides_s = [t_s for t_s, _, feelings in told if t_s > 0.9 and feelings["ff"] is SLIDE]
    # It stays until hardly any of the slide is left in the long window.
    assert 1.0 < slides_s[0] < 1.2
    assert 1.3 <= slides_s[-1] < 1.3 + 0.24
    assert {state for t_s, state, _ in told if 1.15 < t_s < 1.3} == {GateState.JUDGED}


def test_a_still_finger_slides_only_after_lasting_motion() -> None:
    finger = FingerWord()
    moves = [True, True, False, True, True, True, False, True, None, True]
    told = [finger.touch(place * 10 * MS, each) for place, each in enumerate(moves)]
    # While it has not been still at all, it slides from the first reading.
    first, later, again = [SLIDE, SLIDE, TOUCH], [TOUCH, TOUCH, SLIDE], [TOUCH, TOUCH, None, SLIDE]
    assert told == first + later + again
    assert FingerWord(was_still=True, moves_since_ns=50).touch(49, True) is SLIDE, "time went back"


def test_a_finger_state_is_known_once_both_windows_are_full() -> None:
    known = [feelings for t_s, _, feelings in felt(FIRM, restart_s=1.0) if t_s > 1.0 - 1e-6]
    # The long window is full by the 25th sweep.
    assert known == [UNKNOWN] * 24 + [HELD] * (len(known) - 24)


def test_a_fast_finger_slides_before_the_long_window_is_full() -> None:
    told = [feelings for t_s, _, feelings in felt(SLIPPING, restart_s=2.15) if t_s < 2.295]
    assert told[-1] == {"ff": None, "mf": None, "th": SLIDE}


@pytest.mark.parametrize("reason", [Reason.SENSOR_MISSING, Reason.FROZEN, Reason.PARITY])
def test_no_finger_state_is_known_in_an_unusable_reading(reason: Reason) -> None:
    told = felt(FIRM, check=lambda t_s: Checked((reason,) * (abs(t_s - 1.2) < 1e-6), None))
    around = [feelings for t_s, _, feelings in told if abs(t_s - 1.2) < 0.015]
    assert around == [HELD, UNKNOWN, HELD]


def test_only_a_finger_with_few_usable_electrodes_is_unknown() -> None:
    lost = ~ALL
    lost[1, :13] = True
    told = felt(FIRM, check=lambda t_s: Checked((), lost if t_s > 1.0 else None))
    assert told[-1][2] == {"ff": TOUCH, "mf": None, "th": TOUCH}


@pytest.mark.parametrize(("late_ms", "is_known"), [(100, True), (101, False)])
def test_a_reading_older_than_100_ms_gives_no_finger_state(late_ms: int, is_known: bool) -> None:
    now_ns = late_ns = 0
    model = TactileModel(zoo.find("cnn1"))
    judge = Pipeline(model, FINGERS, Limits(), lambda: now_ns, hand=LIMITS, learns=False)
    for t_s, reading in readings(FIRM):
        late_ns = late_ms * MS if t_s > 1.2 else 0
        now_ns = reading.t_ns + late_ns
        judgement = judge.judge(reading)
    assert (judgement.moment.fingers == HELD) is is_known
    assert (judgement.moment.fingers == UNKNOWN) is not is_known
    assert judge.silence(reading.t_ns).moment.fingers == UNKNOWN
