"""The gate's limits to the nanosecond, its invariants, and what a hand hands over to judge."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import compress

import numpy as np
import pytest

from graspd.biotac import Finger
from graspd.daemon.judge.decision import GateLimits, HandLimits
from graspd.daemon.judge.gate import Gate
from graspd.daemon.judge.hand import HandTracker
from graspd.daemon.judge.health import Checked
from graspd.daemon.judge.reasons import GateCause, GateChange, GateState, Reason
from graspd.daemon.judge.stillness import Motion
from tests.daemon.fakes import FINGERS, MS
from tests.daemon.judge.test_gate import (
    ALL,
    GATE,
    GRASPED,
    LIMITS,
    SHAPE,
    START_NS,
    UP,
    Scenario,
    check_chain,
    play,
    readings,
)

NOTHING: tuple[Finger, ...] = ()


def gate_of(limits: HandLimits) -> tuple[Gate, Motion]:
    """A gate, and the motion that it looks at."""
    motion = Motion(3, limits.gate.false_alarms, early=limits.gate.early)
    return Gate(FINGERS, limits, motion), motion


class Steps:
    """Feeds a gate constant counts, so that times and limits can be told to the nanosecond."""

    def __init__(self, *, on_request: bool = False, limits: GateLimits = GATE) -> None:
        self.gate, self.motion = gate_of(HandLimits(on_request=on_request, gate=limits))
        self.now = self.gate.moment(NOTHING)
        self.t_ns = START_NS
        self._changes: list[GateChange] = []

    def step(
        self,
        after_ms: float = 10.0,
        counts: float = 3000.0,
        touching: tuple[Finger, ...] = FINGERS,
        objections: tuple[Reason, ...] = (),
    ) -> GateState | None:
        """One reading: all electrodes of FF read `counts`, the others 3000."""
        after_ns = round(after_ms * MS)
        self.t_ns += after_ns
        median = np.full(SHAPE, 3000, dtype=np.uint16)
        median[0] = round(counts)
        if not 0 <= after_ns <= 100 * MS:
            self.gate.restart(self.t_ns)
        self.motion.add(self.t_ns, median, ALL, wanted=bool(touching))
        self.now = self.gate.step(self.t_ns, median, ALL, touching, objections)
        assert self.now.judges or not self.now.judged
        self._changes += self.now.changes
        return self.now.state

    def take_changes(self) -> list[GateChange]:
        changes, self._changes = self._changes, []
        return changes

    def rest(self, seconds: float = 1.2) -> None:
        for _ in range(round(seconds * 100)):
            self.step(touching=NOTHING)

    def hold(self) -> None:
        """Rest, touch, and hold until nothing moves or slides."""
        self.rest()
        for _ in range(25):
            self.step()

    def grasp(self) -> None:
        self.hold()
        assert self.now.settled

    def story(self) -> str:
        return " ".join(f"{change.state}:{change.cause}" for change in self.take_changes())


@pytest.mark.parametrize("period_ms", [1.0, 8.0, 10.0, 16.0, 20.0, 40.0, 80.0])
@pytest.mark.parametrize(("early", "window_ms"), [(True, 100), (False, 240)])
def test_a_touch_must_last_as_long_as_the_window(
    period_ms: float, early: bool, window_ms: int
) -> None:
    steps = Steps(limits=replace(GATE, early=early))
    steps.rest()
    steps.step(period_ms)
    touched_ns = steps.t_ns
    while steps.now.state is GateState.CLOSING:
        assert steps.now.reasons == (Reason.SETTLING,)
        assert steps.now.still_ms == (steps.t_ns - touched_ns) / MS < window_ms
        steps.step(period_ms)
    assert steps.now.settled
    assert steps.now.early is early
    late_ns = steps.t_ns - touched_ns - window_ms * MS
    assert 0 <= late_ns < period_ms * MS
    assert [c.t_ns for c in steps.take_changes()] == [touched_ns, steps.t_ns, steps.t_ns]


def test_an_early_verdict_is_judged_again_after_the_long_window() -> None:
    steps = Steps(limits=replace(GATE, early=True))
    steps.rest()
    for _ in range(60):
        steps.step()
    assert steps.now.settled
    assert not steps.now.early
    changes = steps.take_changes()
    assert [str(change.cause) for change in changes] == ["contact", *["still", "judged"] * 2]
    touched, *_, judged = changes
    assert judged.t_ns - touched.t_ns == 240 * MS


def test_a_judged_grasp_moving_for_two_windows_settles_again() -> None:
    steps = Steps()
    steps.grasp()
    steps.story()
    for place in range(100):  # 120 counts/s, to and fro, so that it is never another grasp
        steps.step(counts=3000 + 1.2 * min(place % 60, 60 - place % 60))
    assert steps.story() == "closing:moved"
    for _ in range(60):
        steps.step()
    assert steps.story() == "settled:still judged:judged"


@pytest.mark.parametrize(("fresh", "first"), [(True, 5), (False, 11)])
def test_fresh_verdicts_last_50_ms_and_old_ones_100(fresh: bool, first: int) -> None:
    steps, sweep = Steps(), np.full(SHAPE, 3000, dtype=np.uint16)
    steps.grasp()
    judged = []
    for place in range(1, 23):
        t_ns = steps.t_ns + place * 10 * MS
        steps.motion.add(t_ns, sweep, ALL)
        if steps.gate.step(t_ns, sweep, ALL, FINGERS, fresh=fresh).judges:
            judged.append(place)
    assert judged == list(range(first, 23, first))


def test_an_open_hand_tells_no_motion() -> None:
    steps = Steps()
    steps.rest()
    assert steps.now.motion == dict.fromkeys(FINGERS)
    assert steps.now.motion_limits == dict.fromkeys(FINGERS, 1.0)


@pytest.mark.parametrize(("counts", "state"), [(40, "judged"), (-40, "judged"), (41, "closing")])
def test_another_grasp_is_more_than_the_limit_away(counts: int, state: str) -> None:
    steps = Steps()
    steps.grasp()
    assert steps.step(counts=3000 + counts) == state
    assert not steps.now.settled, "it moves"


@pytest.mark.parametrize(
    ("gap_ms", "causes"),
    [(100, ""), (100.001, "closing:gap"), (-1, "closing:gap"), (-1e-6, "closing:gap")],
)
def test_a_gap_is_longer_than_its_limit(gap_ms: float, causes: str) -> None:
    steps = Steps()
    steps.grasp()
    steps.story()
    steps.step(gap_ms)
    assert steps.story() == causes
    assert steps.now.settled is (not causes)


@pytest.mark.parametrize(("after_ms", "state"), [(99.999, "released"), (100, "idle")])
def test_released_lasts_its_time(after_ms: float, state: str) -> None:
    steps = Steps()
    steps.grasp()
    assert steps.step(touching=NOTHING) is GateState.RELEASED
    assert steps.step(50, touching=NOTHING) is GateState.RELEASED
    assert steps.step(after_ms - 50, touching=NOTHING) == state


@pytest.mark.parametrize(("after_ms", "judged"), [(1000, True), (1000.001, False)])
def test_a_request_expires_after_its_time(after_ms: float, judged: bool) -> None:
    steps = Steps(on_request=True)
    steps.rest()
    steps.gate.ask()
    for _ in range(18):
        steps.step(50, objections=(Reason.MOVING,))
    # Its time runs from the first reading after it.
    steps.step(after_ms - 930, objections=(Reason.MOVING,))
    assert steps.step(80) is (GateState.JUDGED if judged else GateState.SETTLED)
    assert steps.now.reasons == (() if judged else (Reason.NOT_ASKED,))


@pytest.mark.parametrize("reason", [Reason.NOT_TARED, Reason.MOVING, Reason.JOINTS_LATE])
def test_what_others_say_against_it_keeps_a_grasp_from_settling(reason: Reason) -> None:
    steps = Steps()
    steps.rest()
    steps.step(touching=NOTHING, objections=(Reason.MOVING, Reason.NOT_TARED))
    assert list(steps.now.reasons) == [Reason.NOT_TARED, Reason.NO_CONTACT], "not that it moves"
    for _ in range(50):
        assert steps.step(objections=(reason,)) is GateState.CLOSING
        assert steps.now.reasons == (reason,)
    for _ in range(9):
        steps.step()
    assert steps.now.settled
    steps.step(objections=(reason,))
    assert steps.now.state is GateState.JUDGED
    assert not steps.now.settled
    assert steps.now.reasons == (reason,)
    steps.step()
    assert steps.now.settled, "the same grasp, so its verdict stands"


def test_unusable_electrodes_neither_move_nor_change_a_grasp() -> None:
    steps = Steps()
    steps.grasp()
    usable, median = ALL.copy(), np.full(SHAPE, 3000, dtype=np.uint16)
    usable[0, :12] = False
    for place in range(50):
        median[0, :12] = 4095 * (place % 2)
        steps.t_ns += 10 * MS
        steps.motion.add(steps.t_ns, median.copy(), usable)
        assert steps.gate.step(steps.t_ns, median, usable, FINGERS).settled


@pytest.mark.parametrize("seed", range(6))
def test_whatever_comes_the_gate_goes_along_its_arrows(seed: int) -> None:
    random = np.random.default_rng(seed)
    required = FINGERS if seed % 2 == 0 else ("ff", "th")
    gate, motion = gate_of(HandLimits(on_request=seed % 3 == 0, required=required, gate=GATE))
    changes: list[GateChange] = []
    touching, median, t_ns = NOTHING, np.full(SHAPE, 3000), START_NS
    for _ in range(4000):
        usual = random.random() < 0.97
        step_ns = 10 * MS if usual else round(MS * random.choice([0, 1, 90, 101, 5000, -20]))
        t_ns += step_ns
        if not 0 <= step_ns <= 100 * MS:
            gate.restart(t_ns)
        if random.random() < 0.02:
            touching = tuple(compress(FINGERS, random.random(3) < random.choice([0.1, 0.9])))
        if random.random() < 0.01:
            median = random.integers(2900, 3000, SHAPE)
        if random.random() < 0.05:
            gate.ask()
        objections = (Reason.JOINTS_LATE,) if random.random() < 0.02 else ()
        if random.random() < 0.05:
            now = gate.moment(touching)
        else:
            sweep, usable = median.astype(np.uint16), random.random(SHAPE) < (0.9 + 0.1 * usual)
            motion.add(t_ns, sweep, usable, wanted=bool(touching))
            now = gate.step(
                *(t_ns, sweep, usable, touching, objections),
                in_time=random.random() < 0.8,
                fresh=random.random() < 0.9,
            )
        assert now.settled or not now.judges
        assert now.judges or not now.judged
        assert not now.settled or (now.state is GateState.JUDGED and now.in_contact)
        assert now.settled == (not now.reasons)
        assert len(now.changes) <= 5
        changes += now.changes
    check_chain(changes)
    begun = [change for change in changes if change.cause is GateCause.CONTACT]
    assert [change.grasp for change in begun] == list(range(1, gate.phase.grasp + 1))
    assert {change.state for change in changes} == set(GateState), "the walk saw all of it"


def test_after_a_gap_three_fresh_sweeps_are_judged() -> None:
    hasty = replace(GATE, early=True)
    firm = Scenario("firm", GRASPED, UP, limits=replace(LIMITS, gate=hasty))
    hand, none = HandTracker(FINGERS, firm.limits), Checked((), ~ALL)
    sweeps = [(t_s, reading) for t_s, reading in readings(firm) if not 0.5 < t_s < 0.75]
    after = [reading.counts for t_s, reading in sweeps if t_s >= 0.75]
    for t_s, reading in sweeps:
        _, counts = hand.step(reading.made_ns, reading.counts, none)
        if counts is not None and t_s > 0.5:
            since = round((t_s - 0.75) * 100) + 1
            assert since >= 3
            window = np.array(after[:since])
            assert (counts >= window.min(axis=0)).all()
            assert (counts <= window.max(axis=0)).all()
            return
    pytest.fail("it was never judged again")


def test_a_finger_lost_while_settled_is_contact_lost() -> None:
    steps = Steps(on_request=True)
    steps.hold()
    assert steps.now.state is GateState.SETTLED
    steps.step(touching=FINGERS[:2])
    assert steps.take_changes()[-1].cause is GateCause.CONTACT_LOST


def test_a_grasp_that_slides_slowly_while_settled_must_settle_anew() -> None:
    steps = Steps(on_request=True)
    steps.hold()
    assert steps.now.state is GateState.SETTLED
    for sweep in range(100):
        if steps.step(counts=3000 + 0.65 * sweep) is not GateState.SETTLED:
            break
    assert steps.motion.loose.early, "nothing moves fast"
    assert steps.now.reasons == (Reason.MOVING,)
    assert steps.take_changes()[-1].cause is GateCause.MOVED


def test_a_finger_that_need_not_touch_need_not_be_tared() -> None:
    hand, none = HandTracker(FINGERS, replace(LIMITS, required=FINGERS[:2])), Checked((), ~ALL)
    for t_s, reading in readings(Scenario("firm", GRASPED, UP)):
        counts = reading.counts.copy()
        counts[2] += round(22.0 * (t_s + 5.0))  # it warms up too fast to be tared, and is no slide
        now, _ = hand.step(reading.made_ns, counts, none)
        if t_s > 0.7:
            break
    assert hand.tared == FINGERS[:2]
    assert now.settled


def test_released_ends_though_time_went_back() -> None:
    steps = Steps()
    steps.grasp()
    steps.step(touching=NOTHING)
    steps.step(-60_000.0, touching=NOTHING)
    steps.rest(1.0)
    assert steps.now.state is GateState.IDLE


def test_a_request_expires_though_time_went_back() -> None:
    steps = Steps(on_request=True)
    steps.rest()
    steps.gate.ask()
    steps.step(-60_000.0, touching=NOTHING)
    steps.rest(2.0)
    for _ in range(30):
        steps.step()
    assert steps.now.state is GateState.SETTLED


def test_an_electrode_back_at_settling_is_judged_by_new_values() -> None:
    firm = Scenario("firm", GRASPED, UP)
    moment_s = play(firm).first_s(GateState.SETTLED)
    hand, lost = HandTracker(FINGERS, LIMITS), ~ALL
    lost[0, [0, 3, 6, 9, 12]] = True  # five of the eight that are pressed by 300 counts
    for t_s, reading in readings(firm):
        away = -0.05 <= t_s < moment_s - 1e-3
        _, counts = hand.step(reading.made_ns, reading.counts, Checked((), lost if away else ~ALL))
        if counts is not None:
            assert t_s >= moment_s - 1e-3
            assert np.abs(counts.astype(np.int64) - reading.counts).max() < 30
            return
    pytest.fail("it was never judged")


@pytest.mark.parametrize(("missing", "tared"), [((0.5, 1.4), FINGERS), ((0.3, 1.45), ())])
def test_sensors_away_for_a_second_may_be_others(
    missing: tuple[float, float], tared: tuple[str, ...]
) -> None:
    away = Scenario("away for 0.9 s, or 1.2", GRASPED, "", missing=missing)
    assert play(away).hand.tared == tared


@pytest.mark.parametrize(("back_ns", "tared"), [(900_000_000, FINGERS), (1_100_000_000, ())])
def test_after_time_went_back_a_second_sensors_may_be_others(
    back_ns: int, tared: tuple[str, ...]
) -> None:
    """As in two recordings, of which the later one is played first."""
    hand, none = HandTracker(FINGERS, LIMITS), Checked((), ~ALL)
    for t_s, reading in readings(Scenario("firm", GRASPED, UP)):
        hand.step(reading.made_ns, reading.counts, none)
        if t_s > -0.1:
            break
    assert hand.tared == FINGERS
    hand.step(reading.made_ns - back_ns, reading.counts, none)
    assert hand.tared == tared


def test_joints_are_lost_when_readings_go_on_without_them() -> None:
    silent = Scenario("no joints", GRASPED, UP, limits=replace(LIMITS, joints=True))
    assert "joints" not in HandTracker(FINGERS, silent.limits).health(), "nothing came yet"
    assert play(silent).hand.health()["joints"] is Reason.JOINTS_LATE
    assert "joints" not in play(replace(silent, joint=lambda t_s: 0.7)).hand.health()
    assert "joints" not in play(replace(silent, limits=LIMITS)).hand.health(), "nobody asks"


def test_after_readings_were_left_out_a_grasp_settles_again() -> None:
    firm, none = Scenario("firm", GRASPED, UP), Checked((), ~ALL)
    hand, since = HandTracker(FINGERS, LIMITS), 0
    now = hand.silent()
    for t_s, reading in readings(firm):
        if abs(t_s - 0.8) < 1e-6:
            assert now.settled
            hand.interrupt()
        now, _ = hand.step(reading.made_ns, reading.counts, none)
        since += t_s > 0.8 - 1e-6
        if since and now.settled:
            break
    # The first begins the motion again; 24 readings later the long window is full.
    assert since == 1 + 24


def test_the_window_nearer_its_limit_is_reported() -> None:
    hand, alone, told = HandTracker(FINGERS, LIMITS), Motion(3, GATE.false_alarms), set()
    for _, reading in readings(Scenario("firm", GRASPED, UP)):
        felt, _ = hand.step(reading.made_ns, reading.counts, Checked((), ~ALL))
        alone.add(reading.t_ns, reading.counts, ALL)
        motion, limits = felt.motion or {}, felt.motion_limits or {}
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
