"""One hand in scenarios of whole grasps: how its gate changes, and when it forgets its tare."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import pytest
from numpy.typing import NDArray

from graspd.daemon.judge import phase
from graspd.daemon.judge.decision import GateLimits, HandLimits
from graspd.daemon.judge.hand import HandTracker
from graspd.daemon.judge.health import Checked
from graspd.daemon.judge.reasons import GateState, Moment, Reason
from graspd.daemon.judge.stillness import Motion
from graspd.drivers.base import JointReading, TactileReading
from tests.conftest import ROOT
from tests.daemon.fakes import FINGERS, sound

START_NS = 10**12
SHAPE = (3, 24)
ALL = np.ones(SHAPE, dtype=np.bool_)
NOISE = 3.5
"""Standard deviation of an electrode, counts (measured: 2.9 to 4.3)."""
PRESSED = np.where(np.arange(24) % 3 == 0, 1.0, 0.2)
"""Share of a touch's depth that each electrode feels: 0.467 in the mean, and the third deepest
falls by 0.8 of the depth further than the median one."""
GATE = GateLimits()
LIMITS = HandLimits(gate=GATE)
Knots = Sequence[tuple[float, float]]


@dataclass(frozen=True)
class Scenario:
    """Readings after a second of rest that ends at 0 s, and the expected changes of the gate."""

    name: str
    depth: Knots | dict[str, Knots]
    """Depth of the touch, counts: line through points (s, counts), of all fingers or by finger."""
    changes: str
    """Expected changes, each as `state:cause`."""
    seconds: float = 1.5
    settled_s: tuple[float, float] | None = None
    """Expected: earliest and latest time at which it settles first, s."""
    unusable: tuple[float, float] = (0.0, 0.0)
    """Begin and end of the readings that cannot be used, s."""
    missing: tuple[float, float] = (0.0, 0.0)
    joints_until_s: float = -math.inf
    """Time until which joints, which keep still, send their angles, s."""
    retime: Callable[[float], float] = lambda t_s: t_s
    """Function of the time at which a reading is made, s; returns the time that it states, s."""
    limits: HandLimits = LIMITS


@dataclass
class Played:
    """Hand after a scenario, and its results."""

    hand: HandTracker
    told: list[tuple[float, Moment, NDArray[np.uint16] | None]] = field(default_factory=list)
    """Time, s, state of the grasp, and counts to be judged, if any, of each reading."""

    @property
    def story(self) -> str:
        changes = (change for _, moment, _ in self.told for change in moment.changes)
        return " ".join(f"{change.state}:{change.cause}" for change in changes)


def depths(scenario: Scenario, t_s: float) -> NDArray[np.float64]:
    """Return the depth of each finger's touch at a time, shape (fingers,)."""
    given = scenario.depth
    felt = np.zeros(len(FINGERS))
    for place, finger in enumerate(FINGERS):
        knots = np.array(given.get(finger, ((0, 0),)) if isinstance(given, dict) else given)
        felt[place] = np.interp(t_s, knots[:, 0], knots[:, 1])
    return felt


def readings(scenario: Scenario) -> list[tuple[float, TactileReading]]:
    """Return time, s, and reading of each sweep; the first 110 are rest before 0 s."""
    random = np.random.default_rng(11)
    rest = random.uniform(2400.0, 3400.0, SHAPE)
    made = []
    for place in range(-110, round(scenario.seconds * 100)):
        t_s = place / 100
        counts = rest - depths(scenario, t_s)[:, None] * PRESSED
        counts += random.normal(0.0, NOISE, SHAPE)
        t_ns = START_NS + round(scenario.retime(t_s) * 1e9)
        made.append((t_s, sound(np.clip(np.rint(counts), 1, 4094), t_ns)))
    return made


def play(scenario: Scenario, interrupt_s: float = math.inf) -> Played:
    """Feed a hand with a scenario; at `interrupt_s`, say that readings are missing before it."""
    played = Played(HandTracker(FINGERS, scenario.limits))
    hand = played.hand
    for t_s, reading in readings(scenario):
        if t_s <= scenario.joints_until_s:
            angles = np.array([0.7, 0.4 + t_s / 1e9])
            hand.observe_joints(JointReading(reading.t_ns, 0, ("FFJ3", "THJ1"), angles))
        if scenario.missing[0] <= t_s < scenario.missing[1]:
            continue
        if abs(t_s - interrupt_s) < 1e-6:
            hand.interrupt()
        lost = scenario.unusable[0] <= t_s < scenario.unusable[1]
        checked = Checked((Reason.ELECTRODES_BROKEN,) if lost else (), ~ALL)
        moment, counts = hand.step(reading.made_ns, reading.counts, checked)
        assert moment.judges is (counts is not None)
        played.told.append((t_s, moment, counts))
    return played


GRASPED = ((0.0, 0.0), (0.2, 300.0))
"""All fingers close within 0.2 s and hold."""
OPENED = (*GRASPED, (1.0, 300.0), (1.1, 0.0))
UP = "closing:contact settled:still judged:judged"
AGAIN = "settled:still judged:judged"
DOWN = "released:contact-lost idle:time"
SETTLES = (0.41, 0.45)
"""Expected time of settling, s: 0.2 s of closing, and 240 ms in which the hand keeps still. The
last sweep or two of closing look still."""
JOINTS = replace(LIMITS, joints=True)
SUBSET = replace(LIMITS, required=("ff", "th"))


SCENARIOS = [
    Scenario("firm grasp", OPENED, f"{UP} closing:changed {DOWN}", settled_s=SETTLES),
    Scenario(
        "required fingers of which the third is none",
        {"ff": OPENED, "th": OPENED},
        f"{UP} closing:changed {DOWN}",
        limits=SUBSET,
    ),
    Scenario(
        "sensor lost in mid-grasp",
        GRASPED,
        f"{UP} closing:gap {AGAIN}",
        unusable=(0.8, 1.2),
    ),
    Scenario(
        "burst after a stall: old readings bear the time of their arrival",
        GRASPED,
        UP,
        retime=lambda t_s: 0.375 if 0.3 <= t_s < 0.38 else t_s,
        settled_s=SETTLES,
    ),
    Scenario(
        # The first reading after the gap is of 0.79 s: a window later it settles.
        "burst after a long stall: nothing settles before its own time",
        GRASPED,
        UP,
        retime=lambda t_s: 0.79 + t_s / 1e4 if 0.25 <= t_s < 0.8 else t_s,
        settled_s=(1.03, 1.05),
    ),
    Scenario(
        # By hand: silent since 0 s, lost after 1 s; the fingers have kept still for long.
        "joints lost",
        GRASPED,
        UP,
        joints_until_s=0.0,
        limits=JOINTS,
        settled_s=(1.0, 1.02),
    ),
]


@pytest.mark.parametrize("scenario", SCENARIOS, ids=lambda scenario: scenario.name)
def test_the_gate_follows_each_scenario(scenario: Scenario) -> None:
    played = play(scenario)
    assert played.story == scenario.changes
    if scenario.settled_s is not None:
        earliest, latest = scenario.settled_s
        changes = [change for _, moment, _ in played.told for change in moment.changes]
        (settled_ns, *_) = [each.t_ns for each in changes if each.state is GateState.SETTLED]
        assert earliest <= (settled_ns - START_NS) / 1e9 <= latest


def test_the_wire_readme_lists_all_transitions_of_the_gate() -> None:
    page = (ROOT / "deploy" / "wire" / "README.md").read_text()
    assert "\n".join(phase.lines()) in page


FIRM = Scenario("firm", GRASPED, UP)
SOUND = Checked((), ~ALL)


def test_after_a_gap_only_counts_of_later_sweeps_are_judged() -> None:
    hasty = replace(LIMITS, gate=replace(GATE, early=True))
    gap = replace(FIRM, missing=(0.505, 0.745), limits=hasty)
    after = [reading.counts for t_s, reading in readings(gap) if t_s > 0.745]
    judged = [counts for t_s, _, counts in play(gap).told if t_s > 0.745]
    number = next(place for place, counts in enumerate(judged, start=1) if counts is not None)
    assert number >= 3
    window = np.array(after[:number])
    counts = judged[number - 1]
    assert counts is not None
    assert ((window.min(axis=0) <= counts) & (counts <= window.max(axis=0))).all()


def test_after_readings_were_left_out_a_grasp_settles_again() -> None:
    told = play(FIRM, interrupt_s=0.8).told
    before, *settled = [moment.settled for t_s, moment, _ in told if t_s > 0.785]
    assert before
    # The first begins the motion again; 24 readings later the long window is full.
    assert settled.index(True) == 24


def test_a_finger_that_need_not_touch_need_not_be_tared() -> None:
    hand = HandTracker(FINGERS, replace(LIMITS, required=FINGERS[:2]))
    for t_s, reading in readings(FIRM):
        counts = reading.counts.copy()
        # It warms up too fast for the tare, and does not slide.
        counts[2] += round(22.0 * (t_s + 5.0))
        now, _ = hand.step(reading.made_ns, counts, SOUND)
        if t_s > 0.7:
            break
    assert hand.tared == FINGERS[:2]
    assert hand.health() == {FINGERS[2]: Reason.NOT_TARED}
    assert now.settled


@pytest.mark.parametrize(
    ("missing", "is_gap", "tared"),
    [
        ((0.805, 0.895), False, FINGERS),
        ((0.805, 0.905), True, FINGERS),  # more than 100 ms
        ((0.495, 1.485), True, FINGERS),
        ((0.395, 1.395), False, ()),  # more than a second: they may be others
    ],
)
def test_a_gap_unsettles_the_grasp_an_outage_forgets_the_tare(
    missing: tuple[float, float], is_gap: bool, tared: tuple[str, ...]
) -> None:
    played = play(replace(FIRM, missing=missing))
    assert ("closing:gap" in played.story) is is_gap
    assert played.hand.tared == tared


@pytest.mark.parametrize(("back_ns", "tared"), [(10**9, FINGERS), (10**9 + 1, ())])
def test_time_that_goes_back_over_one_second_forgets_the_tare(
    back_ns: int, tared: tuple[str, ...]
) -> None:
    """Time goes back if the later of two recordings is played first."""
    hand = HandTracker(FINGERS, LIMITS)
    for t_s, reading in readings(FIRM):
        hand.step(reading.made_ns, reading.counts, SOUND)
        if t_s > -0.1:
            break
    assert hand.tared == FINGERS
    hand.step(reading.made_ns - back_ns, reading.counts, SOUND)
    assert hand.tared == tared
    known = (hand.read_rest() > 0.0).all(axis=1).tolist()
    assert known == [finger in tared for finger in FINGERS]


def test_the_health_reports_required_joints_that_send_no_angles() -> None:
    silent = Scenario("no joints", GRASPED, UP, limits=replace(LIMITS, joints=True))
    assert "joints" not in HandTracker(FINGERS, silent.limits).health(), "nothing came yet"
    assert play(silent).hand.health()["joints"] is Reason.JOINTS_LATE
    assert "joints" not in play(replace(silent, joints_until_s=math.inf)).hand.health()
    assert "joints" not in play(replace(silent, limits=LIMITS)).hand.health(), "not required"


def test_the_reported_motion_is_of_the_window_nearer_its_limit() -> None:
    hand, alone, told = HandTracker(FINGERS, LIMITS), Motion(3, GATE.false_alarms), set()
    for _, reading in readings(FIRM):
        felt, _ = hand.step(reading.made_ns, reading.counts, SOUND)
        alone.add(reading.t_ns, reading.counts, ALL)
        motion, limits = felt.motion or {}, felt.motion_limits or {}
        if not felt.touching:
            assert felt.motion == dict.fromkeys(FINGERS)
            assert felt.motion_limits == dict.fromkeys(FINGERS, 1.0)
        if not felt.touching or not alone.known or max(alone.slow) == math.inf:
            continue
        most = alone.loose if felt.state is GateState.JUDGED else alone.strict
        for place, finger in enumerate(FINGERS):
            fast = alone.fast[place], most.fast[place]
            slow = alone.slow[place], most.slow[place]
            nearer = max(fast, slow, key=lambda window: window[0] / window[1])
            assert (motion[finger], limits[finger]) == pytest.approx(nearer, abs=0.00501)
            told.add(nearer is slow)
    assert told == {False, True}
