"""What a hand hands over to judge, and what it forgets after gaps, outages and times gone back."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from graspd.daemon.judge.hand import HandTracker
from graspd.daemon.judge.health import Checked
from graspd.daemon.judge.reasons import GateState, Reason
from graspd.daemon.judge.stillness import Motion
from tests.daemon.fakes import FINGERS
from tests.daemon.judge.test_gate import (
    ALL,
    GATE,
    GRASPED,
    LIMITS,
    UP,
    Scenario,
    play,
    readings,
)

FIRM = Scenario("firm", GRASPED, UP)
SOUND = Checked((), ~ALL)


def test_after_a_gap_three_fresh_sweeps_are_judged() -> None:
    hasty = replace(GATE, early=True)
    hand = HandTracker(FINGERS, replace(LIMITS, gate=hasty))
    sweeps = [(t_s, reading) for t_s, reading in readings(FIRM) if not 0.5 < t_s < 0.75]
    after = [reading.counts for t_s, reading in sweeps if t_s >= 0.75]
    for t_s, reading in sweeps:
        _, counts = hand.step(reading.made_ns, reading.counts, SOUND)
        if counts is not None and t_s > 0.5:
            since = round((t_s - 0.75) * 100) + 1
            assert since >= 3
            window = np.array(after[:since])
            assert (counts >= window.min(axis=0)).all()
            assert (counts <= window.max(axis=0)).all()
            return
    pytest.fail("it was never judged again")


def test_after_readings_were_left_out_a_grasp_settles_again() -> None:
    hand, since = HandTracker(FINGERS, LIMITS), 0
    now = hand.silent()
    for t_s, reading in readings(FIRM):
        if abs(t_s - 0.8) < 1e-6:
            assert now.settled
            hand.interrupt()
        now, _ = hand.step(reading.made_ns, reading.counts, SOUND)
        since += t_s > 0.8 - 1e-6
        if since and now.settled:
            break
    # The first begins the motion again; 24 readings later the long window is full.
    assert since == 1 + 24


def test_an_electrode_back_at_settling_is_judged_by_new_values() -> None:
    moment_s = play(FIRM).first_s(GateState.SETTLED)
    hand, lost = HandTracker(FINGERS, LIMITS), ~ALL
    lost[0, [0, 3, 6, 9, 12]] = True  # five of the eight that are pressed by 300 counts
    for t_s, reading in readings(FIRM):
        away = -0.05 <= t_s < moment_s - 1e-3
        _, counts = hand.step(reading.made_ns, reading.counts, Checked((), lost if away else ~ALL))
        if counts is not None:
            assert t_s >= moment_s - 1e-3
            assert np.abs(counts.astype(np.int64) - reading.counts).max() < 30
            return
    pytest.fail("it was never judged")


def test_a_finger_that_need_not_touch_need_not_be_tared() -> None:
    hand = HandTracker(FINGERS, replace(LIMITS, required=FINGERS[:2]))
    for t_s, reading in readings(FIRM):
        counts = reading.counts.copy()
        counts[2] += round(
            22.0 * (t_s + 5.0)
        )  # it warms up too fast for the tare, and does not slide
        now, _ = hand.step(reading.made_ns, counts, SOUND)
        if t_s > 0.7:
            break
    assert hand.tared == FINGERS[:2]
    assert now.settled


@pytest.mark.parametrize(
    ("missing", "is_gap", "tared"),
    [
        ((0.805, 0.895), False, FINGERS),
        ((0.805, 0.905), True, FINGERS),  # more than 100 ms
        ((0.5, 1.4), True, FINGERS),
        ((0.3, 1.45), False, ()),  # more than a second: they may be others
    ],
)
def test_sensors_away_have_the_grasp_settle_or_are_tared_again(
    missing: tuple[float, float], is_gap: bool, tared: tuple[str, ...]
) -> None:
    played = play(replace(FIRM, missing=missing))
    assert ("closing:gap" in played.story) is is_gap
    assert played.hand.tared == tared


@pytest.mark.parametrize(("back_ns", "tared"), [(900_000_000, FINGERS), (1_100_000_000, ())])
def test_after_time_went_back_a_second_sensors_may_be_others(
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


def test_joints_are_lost_when_readings_continue_without_them() -> None:
    silent = Scenario("no joints", GRASPED, UP, limits=replace(LIMITS, joints=True))
    assert "joints" not in HandTracker(FINGERS, silent.limits).health(), "nothing came yet"
    assert play(silent).hand.health()["joints"] is Reason.JOINTS_LATE
    assert "joints" not in play(replace(silent, joint=lambda t_s: 0.7)).hand.health()
    assert "joints" not in play(replace(silent, limits=LIMITS)).hand.health(), "not required"


def test_the_window_nearer_its_limit_is_reported() -> None:
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
