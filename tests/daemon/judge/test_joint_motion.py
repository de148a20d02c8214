"""Whether joints keep still: speeds that are known, late and lost angles, several senders."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from graspd.daemon.judge.decision import HandLimits, Limits
from graspd.daemon.judge.joint_motion import JointMotion
from graspd.daemon.judge.pipeline import Pipeline
from graspd.daemon.judge.reasons import Reason
from graspd.drivers.base import JointReading
from graspd.models import zoo
from graspd.models.runtime import TactileModel
from tests.daemon.fakes import FINGERS

MS = 1_000_000
START_NS = 10**12
NAMES = ("FFJ1", "FFJ2", "FFJ3")
ALL = (*NAMES, "THJ1")
NOISE_RAD = 1e-9
"""Noise of an angle, far below all limits, so that no two angles are the same to the bit."""


def send(motion: JointMotion, t_ns: int, *angles: float, names: tuple[str, ...] = NAMES) -> None:
    measured = np.array(angles) + NOISE_RAD * np.sin(t_ns / MS)
    motion.observe(JointReading(t_ns, 0, names, measured))


def turning(rate_hz: float, rad_per_s: float, seconds: float = 1.0) -> tuple[JointMotion, int]:
    """Turn one joint of three at `rad_per_s`, for `seconds`, with angles at `rate_hz`.

    Return its motion, and the time of the last angles, ns.
    """
    motion, t_ns = JointMotion(), START_NS
    for place in range(round(seconds * rate_hz) + 1):
        t_ns = START_NS + round(place / rate_hz * 1e9)
        send(motion, t_ns, 0.3, 1.2 + rad_per_s * (t_ns - START_NS) / 1e9, -0.1)
    return motion, t_ns


@pytest.mark.parametrize("rate_hz", [10.0, 71.43, 1000.0])
@pytest.mark.parametrize("rad_per_s", [0.095, -0.095, 0.105, -0.105])
def test_joints_faster_than_the_limit_are_moving_at_every_rate(
    rate_hz: float, rad_per_s: float
) -> None:
    motion, now_ns = turning(rate_hz, rad_per_s)
    assert motion.objection(now_ns) is (Reason.MOVING if abs(rad_per_s) > 0.1 else None)


OTHERS = {"none": (), "a finger": ("THJ1",), "those but one": ("FFJ1", "FFJ3")}
"""Joints whose angles continue; those of all others are not valid any more."""


@pytest.mark.parametrize("others", OTHERS.values(), ids=OTHERS)
@pytest.mark.parametrize(
    ("age_ms", "reason"),
    [
        (-150, None),  # jitter between two links
        *((0, None), (150, None), (151, Reason.JOINTS_LATE), (1000, Reason.JOINTS_LATE)),
        *((1001, None), (3000, None)),
    ],
)
def test_silent_joints_are_late_after_150_ms_then_lost(
    age_ms: int, reason: Reason | None, others: tuple[str, ...]
) -> None:
    motion, last_ns = turning(100.0, 0.0)
    angles = [0.3 if name in others else np.nan for name in ALL]
    for ms in range(10, age_ms + 1, 10):
        send(motion, last_ns + ms * MS, *angles, names=ALL)
    now_ns = last_ns + age_ms * MS
    assert motion.objection(now_ns) is reason
    assert motion.is_lost(now_ns) is (age_ms > 1000 and not others)
    assert motion.misses_some(now_ns) is (age_ms > 1000)
    assert not motion.is_frozen


@pytest.mark.parametrize(
    ("delay_ms", "reason", "is_missing"),
    [(150, None, False), (500, Reason.JOINTS_LATE, False), (1500, None, True)],
)
def test_joints_that_all_come_late_count_as_silent_ones(
    delay_ms: int, reason: Reason | None, is_missing: bool
) -> None:
    motion, now_ns = turning(100.0, 0.0)
    for ms in range(10, 3000, 10):
        now_ns += 10 * MS
        send(motion, now_ns - min(ms, delay_ms) * MS, 0.3, 1.2, -0.1)
    assert motion.misses_some(now_ns - 10 * MS) is is_missing, "also before the next sweep"
    assert motion.objection(now_ns) is reason
    assert motion.misses_some(now_ns) is is_missing


def test_joints_that_have_sent_nothing_are_waited_for_one_second() -> None:
    motion, last_ns = turning(100.0, 0.0)
    for waits, now_ns in ((JointMotion(), START_NS), (motion, last_ns - 151 * MS)):
        for ms, reason in ((0, Reason.JOINTS_LATE), (1000, Reason.JOINTS_LATE), (1001, None)):
            assert waits.objection(now_ns + ms * MS) is reason
            assert waits.is_lost(now_ns + ms * MS) is (ms > 1000)


def test_angles_of_one_and_the_same_time_give_no_speed() -> None:
    motion = JointMotion()
    for angle in range(100):
        send(motion, START_NS, float(angle), 0.0, 0.0)
        assert motion.objection(START_NS) is Reason.MOVING
    motion, now_ns = turning(100.0, 0.0)
    send(motion, now_ns, 0.3, 1.2, -0.1)
    assert motion.objection(now_ns) is None


def test_joints_of_every_sender_must_be_still() -> None:
    motion = JointMotion()
    for ms in range(0, 700, 10):
        t_ns = START_NS + ms * MS
        send(motion, t_ns, 0.3, 1.2, -0.1)
        send(motion, t_ns, 0.5 * min(ms, 500) / 1000, names=("THJ1",))
        send(motion, t_ns, 0.1, 0.2, names=("WRJ1", "WRJ2"))
        if ms >= 100:
            # 80 ms after its end, and a little less by how much is left of it.
            assert motion.objection(t_ns) is (Reason.MOVING if ms < 570 else None)


@pytest.mark.parametrize("swing_hz", [12.5, 11.9, 25.0])
@pytest.mark.parametrize("rate_hz", [100.0, 1000.0])
def test_joints_that_swing_in_step_with_the_window_are_moving(
    swing_hz: float, rate_hz: float
) -> None:
    motion = JointMotion()
    for place in range(round(rate_hz)):
        t_s = place / rate_hz
        send(
            motion, START_NS + round(t_s * 1e9), 0.1 * np.sin(2 * np.pi * swing_hz * t_s), 0.0, 0.0
        )
        if t_s > 0.3:
            assert motion.objection(START_NS + round(t_s * 1e9)) is Reason.MOVING


@pytest.mark.parametrize(("gap_ms", "reason"), [(150, None), (151, Reason.MOVING)])
def test_angles_after_a_gap_begin_a_new_window(gap_ms: int, reason: Reason | None) -> None:
    motion = JointMotion()
    for t_ns in (START_NS, START_NS + gap_ms * MS):
        send(motion, t_ns, 0.3, 1.2, -0.1)
    assert motion.objection(t_ns) is reason


@pytest.mark.parametrize(("every_ms", "kept"), [(5, 18), (4, 18), (2.5, 18), (10, 18)])
def test_eighteen_angles_a_sixteenth_of_a_window_apart_are_kept(every_ms: float, kept: int) -> None:
    """Sixteen in a window of 80 ms, and one at each end."""
    motion = JointMotion()
    for place in range(200):
        send(motion, START_NS + round(place * every_ms * MS), 0.3, 1.2, -0.1)
    for past in motion.past.values():
        assert len(past) == kept
        steps = {later[0] - earlier[0] for earlier, later in itertools.pairwise(past)}
        assert steps == {round({5: 5, 4: 8, 2.5: 5, 10: 10}[every_ms] * MS)}


def test_joint_speed_is_measured_over_the_last_80_ms() -> None:
    """By hand: 0.0079 rad in 80 ms are 0.099 rad/s, 0.0081 rad 0.101 rad/s."""
    for moved, reason in ((0.0079, None), (0.0081, Reason.MOVING)):
        motion, now_ns = turning(100.0, 0.0)
        for ms in range(10, 81, 10):
            send(motion, now_ns + ms * MS, 0.3, 1.2 + (moved if ms == 80 else 0.0), -0.1)
        assert motion.objection(now_ns + 80 * MS) is reason
    motion, now_ns = turning(100.0, 0.0)
    for ms in range(10, 201, 10):
        send(motion, now_ns + ms * MS, 0.3, 1.7 if ms <= 110 else 1.2, -0.1)
        found = motion.objection(now_ns + ms * MS)
    assert found is None, "it moved 90 ms ago"


def test_64_joints_are_followed_one_more_clears_them() -> None:
    motion = JointMotion()
    for joint in range(64):
        send(motion, START_NS, 1.0, names=(f"J{joint}",))
    send(motion, START_NS, 1.0, names=("J3",))
    assert len(motion.past) == len(motion.latest_ns) == 64
    send(motion, START_NS, 1.0, names=("J64",))
    assert set(motion.past) == set(motion.latest_ns) == {"J64"}


@pytest.mark.parametrize("sends", ["all", "four", "one", "some"])
def test_joints_are_judged_alike_however_messages_group_them(sends: str) -> None:
    """`some`: in any order those that happened to change, each at least every 100 ms."""
    joints = [f"{finger}J{place}" for finger in ("FF", "MF", "TH") for place in range(1, 5)]
    size = {"all": 12, "four": 4, "one": 1, "some": 6}[sends]
    for rad_per_s, reason in ((0.0, None), (0.2, Reason.MOVING)):
        motion, random = JointMotion(), np.random.default_rng(1)
        for ms in range(0, 1001, 10):
            angles = dict.fromkeys(joints, 0.3) | {"MFJ2": 1.2 + rad_per_s * ms / 1000}
            order = random.permutation(joints).tolist() if sends in ("all", "some") else joints
            groups = [order[first : first + size] for first in range(0, len(joints), size)]
            for names in groups[:1] if sends == "some" and ms % 100 else groups:
                picked = map(angles.__getitem__, names)
                send(motion, START_NS + ms * MS, *picked, names=tuple(names))
            if ms >= 200:
                assert motion.objection(START_NS + ms * MS) is reason


@pytest.mark.parametrize(("rad_per_s", "reason"), [(0.0, None), (0.105, Reason.MOVING)])
@pytest.mark.parametrize("valid_every_ms", [20, 100, 140])
def test_a_joint_sometimes_null_is_judged_by_its_valid_angles(
    rad_per_s: float, reason: Reason | None, valid_every_ms: int
) -> None:
    motion = JointMotion()
    for ms in range(0, 2001, 10):
        turned = 1.2 + rad_per_s * ms / 1000
        send(motion, START_NS + ms * MS, 0.3, np.nan if ms % valid_every_ms else turned, -0.1)
        if ms >= 200:
            assert motion.objection(START_NS + ms * MS) is reason
    assert set(motion.past) == set(NAMES)


@pytest.mark.parametrize("rad_per_s", [0.0, 0.2])
def test_a_joint_whose_angle_is_mostly_null_is_never_still(rad_per_s: float) -> None:
    motion = JointMotion()
    for ms in range(0, 2001, 10):
        turned = 1.2 + rad_per_s * ms / 1000
        send(motion, START_NS + ms * MS, 0.3, np.nan if ms % 160 else turned, -0.1)
        assert motion.objection(START_NS + ms * MS) in (Reason.MOVING, Reason.JOINTS_LATE)


def test_up_to_64_lost_joints_are_remembered_once_each() -> None:
    motion = JointMotion()
    for place in range(140):
        t_ns = START_NS + place * 2000 * MS
        send(motion, t_ns, 1.0, names=(f"J{place // 2}",))  # each comes twice
        motion.objection(t_ns + 1500 * MS)
    assert motion.lost == [f"J{joint}" for joint in range(64)]


def frozen(
    motion: JointMotion, begin_ms: int, end_ms: int, period_ms: float = 10.0
) -> Reason | None:
    """Send angles that stay the same to the bit, from `begin_ms` to `end_ms`, one a `period_ms`;
    return the objection at the last."""
    found = None
    for ms in np.arange(begin_ms, end_ms + 0.5, period_ms).tolist():
        t_ns = START_NS + round(ms * MS)
        motion.observe(JointReading(t_ns, 0, NAMES, np.full(len(NAMES), 0.8)))
        found = motion.objection(t_ns)
    return found


@pytest.mark.parametrize("period_ms", [100.0, 14.0, 10.0, 1.0])
def test_angles_unchanged_for_a_second_are_frozen(period_ms: float) -> None:
    motion = JointMotion()
    assert frozen(motion, 0, 1000, period_ms) is None
    assert frozen(motion, 1000, 1100, period_ms) is Reason.JOINTS_FROZEN


@pytest.mark.parametrize("gap_ms", [200, 900, 1500, 5000])
def test_angles_that_are_equal_after_a_gap_stay_frozen(gap_ms: int) -> None:
    motion = JointMotion()
    assert frozen(motion, 0, 1500) is Reason.JOINTS_FROZEN
    assert frozen(motion, 1500 + gap_ms, 1800 + gap_ms) is Reason.JOINTS_FROZEN


@pytest.mark.parametrize(
    ("lasts_ms", "reason"),
    [(70, Reason.MOVING), (80, None), (1000, None), (1010, Reason.JOINTS_FROZEN)],
)
def test_after_time_went_back_angles_have_a_second_to_change(
    lasts_ms: int, reason: Reason | None
) -> None:
    motion = JointMotion()
    frozen(motion, 0, 1500)
    assert frozen(motion, -100_000, -100_000 + lasts_ms) is reason


def test_the_health_says_that_joints_are_frozen_until_one_changes() -> None:
    hand = HandLimits(joints=True)
    model = TactileModel(zoo.find("cnn1"))
    pipeline = Pipeline(model, FINGERS, Limits(), lambda: START_NS, hand=hand)
    for ms in range(0, 2601, 10):
        angles = np.array([0.8, 0.4 + (ms >= 1500)])
        pipeline.observe_joints(JointReading(START_NS + ms * MS, 0, ("FFJ3", "THJ1"), angles))
        frozen = pipeline.health().get("joints") is Reason.JOINTS_FROZEN
        assert frozen is (1000 < ms < 1500 or ms > 2500)
