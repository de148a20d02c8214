"""Whether joints keep still: speeds by hand, late and lost streams, several senders."""

from __future__ import annotations

import itertools
from collections.abc import Mapping

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


NOISE_RAD = 1e-9
"""Far below all limits: what is measured is never the same to the bit."""


def send(motion: JointMotion, t_ns: int, *angles: float, names: tuple[str, ...] = NAMES) -> None:
    measured = np.array(angles) + NOISE_RAD * np.sin(t_ns / MS)
    motion.observe(JointReading(t_ns, 0, names, measured), t_ns)


def turning(rate_hz: float, rad_per_s: float, seconds: float = 1.0) -> tuple[JointMotion, int]:
    """One joint of three turns at a constant speed; also the time of the last angles."""
    motion, t_ns = JointMotion(), START_NS
    for place in range(round(seconds * rate_hz) + 1):
        t_ns = START_NS + round(place / rate_hz * 1e9)
        send(motion, t_ns, 0.3, 1.2 + rad_per_s * (t_ns - START_NS) / 1e9, -0.1)
    return motion, t_ns


@pytest.mark.parametrize("rate_hz", [10.0, 71.43, 1000.0])
@pytest.mark.parametrize(
    ("rad_per_s", "reason"),
    [
        (0.095, None),
        (-0.095, None),
        (0.105, Reason.MOVING),
        (-0.105, Reason.MOVING),
    ],
)
def test_speed_is_angle_over_time_at_every_rate(
    rate_hz: float, rad_per_s: float, reason: Reason | None
) -> None:
    motion, now_ns = turning(rate_hz, rad_per_s)
    assert motion.objection(now_ns) is reason


@pytest.mark.parametrize(
    ("age_ms", "reason", "lost"),
    [
        (0, None, False),
        (150, None, False),
        (151, Reason.JOINTS_LATE, False),
        (1000, Reason.JOINTS_LATE, False),
        (1001, None, True),
        (3_600_000, None, True),
    ],
)
def test_joints_are_late_and_then_lost(age_ms: int, reason: Reason | None, lost: bool) -> None:
    motion, now_ns = turning(100.0, 0.0)
    assert motion.objection(now_ns + age_ms * MS) is reason
    assert motion.is_lost(now_ns + age_ms * MS) is lost


def test_joints_that_never_come_are_waited_for_once() -> None:
    motion = JointMotion()
    assert not motion.is_lost(START_NS)
    assert motion.objection(START_NS) is Reason.JOINTS_LATE
    assert motion.objection(START_NS + 1000 * MS) is Reason.JOINTS_LATE
    assert motion.objection(START_NS + 1001 * MS) is None
    assert motion.is_lost(START_NS + 1001 * MS)


def test_angles_of_one_and_the_same_time_give_no_speed() -> None:
    motion, now_ns = turning(100.0, 0.0)
    for _ in range(1000):
        send(motion, now_ns, 0.3, 1.2, -0.1)
    assert motion.objection(now_ns) is None
    alone = JointMotion()
    for angle in range(100):
        send(alone, START_NS, float(angle), 0.0, 0.0)
        assert alone.objection(START_NS) is Reason.MOVING


def test_each_sender_must_be_still() -> None:
    motion = JointMotion()
    for ms in range(0, 501, 10):
        t_ns = START_NS + ms * MS
        send(motion, t_ns, 0.3, 1.2, -0.1)
        send(motion, t_ns + MS, 0.5 * ms / 1000, names=("THJ1",))
        send(motion, t_ns + 2 * MS, 0.1, 0.2, names=("WRJ1", "WRJ2"))
    assert motion.objection(START_NS + 502 * MS) is Reason.MOVING
    for ms in range(510, 700, 10):
        t_ns = START_NS + ms * MS
        send(motion, t_ns, 0.3, 1.2, -0.1)
        send(motion, t_ns + MS, 0.25, names=("THJ1",))
        send(motion, t_ns + 2 * MS, 0.1, 0.2, names=("WRJ1", "WRJ2"))
    assert motion.objection(START_NS + 692 * MS) is None


@pytest.mark.parametrize(
    ("silent_ms", "reason"),
    [(100, None), (200, Reason.JOINTS_LATE), (900, Reason.JOINTS_LATE), (1100, None)],
)
def test_a_silent_sender_beside_another_is_late_then_lost(
    silent_ms: int, reason: Reason | None
) -> None:
    motion, now_ns = turning(100.0, 0.0)
    for ms in range(-500, silent_ms + 1, 10):
        send(motion, now_ns + ms * MS, 0.5, names=("THJ1",))
    assert motion.objection(now_ns + silent_ms * MS) is reason


def test_angles_from_the_future_are_not_trusted() -> None:
    motion, now_ns = turning(100.0, 0.0)
    assert motion.objection(now_ns - 100 * MS) is None, "jitter between two links"
    assert motion.objection(now_ns - 151 * MS) is Reason.JOINTS_LATE


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


def test_a_joint_without_an_angle_is_late_then_lost() -> None:
    motion, now_ns = turning(100.0, 0.0)
    for ms in range(10, 1500, 10):
        send(motion, now_ns + ms * MS, 0.3, np.nan, -0.1)
        found = motion.objection(now_ns + ms * MS)
        if 160 <= ms <= 1000:
            assert found is Reason.JOINTS_LATE
        if ms >= 1010:
            assert found is None
            assert motion.misses_some(now_ns + ms * MS)


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
    (past,) = motion.past.values()
    assert len(past) == kept
    steps = {later[0] - earlier[0] for earlier, later in itertools.pairwise(past)}
    assert steps == {round({5: 5, 4: 8, 2.5: 5, 10: 10}[every_ms] * MS)}


def test_a_window_compares_with_its_first_angle() -> None:
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


def test_eight_senders_are_kept_apart_and_a_ninth_restarts() -> None:
    motion = JointMotion()
    for sender in range(8):
        send(motion, START_NS, 1.0, names=(f"J{sender}",))
    assert len(motion.past) == len(motion.latest_ns) == 8
    send(motion, START_NS, 1.0, names=("J3",))
    assert len(motion.past) == 8
    send(motion, START_NS, 1.0, names=("J8",))
    assert set(motion.past) == set(motion.latest_ns) == {("J8",)}


def test_64_lost_joints_are_remembered_once_each() -> None:
    motion = JointMotion()
    for place in range(70):
        t_ns = START_NS + place * 2000 * MS
        send(motion, t_ns, 1.0, names=(f"J{place // 2}",))  # each comes twice
        motion.objection(t_ns + 1500 * MS)
    assert motion.lost == [f"J{joint}" for joint in range(35)]
    for place in range(70, 200):
        t_ns = START_NS + place * 2000 * MS
        send(motion, t_ns, 1.0, names=(f"J{place}",))
        motion.objection(t_ns + 1500 * MS)
    assert len(motion.lost) == 64


def held(rates_hz: Mapping[tuple[str, ...], float], seconds: float) -> JointMotion:
    """Senders whose angles stay the same to the bit, by the names of their joints."""
    motion = JointMotion()
    times = sorted(
        (START_NS + round(place / rate_hz * 1e9), names)
        for names, rate_hz in rates_hz.items()
        for place in range(round(seconds * rate_hz) + 1)
    )
    for t_ns, names in times:
        motion.observe(JointReading(t_ns, 0, names, np.full(len(names), 0.8)), t_ns)
    return motion


@pytest.mark.parametrize("rate_hz", [10.0, 71.43, 100.0, 1000.0])
def test_angles_unchanged_for_a_second_are_frozen(rate_hz: float) -> None:
    assert held({NAMES: rate_hz}, 0.95).objection(START_NS + 950 * MS) is None
    motion = held({NAMES: rate_hz}, 1.1)
    now_ns = START_NS + 1100 * MS
    assert motion.objection(now_ns) is Reason.JOINTS_FROZEN
    assert motion.is_frozen


@pytest.mark.parametrize("gap_ms", [200, 900, 1500, 5000])
def test_silence_does_not_make_frozen_angles_fresh(gap_ms: int) -> None:
    motion = held({NAMES: 100.0}, 1.5)
    for ms in range(0, 301, 10):
        t_ns = START_NS + (1500 + gap_ms + ms) * MS
        motion.observe(JointReading(t_ns, 0, NAMES, np.full(len(NAMES), 0.8)), t_ns)
        found = motion.objection(t_ns)
    assert found is Reason.JOINTS_FROZEN


def test_after_time_went_back_angles_have_a_second_to_change() -> None:
    motion = held({NAMES: 100.0}, 1.5)
    early_ns = START_NS - 10**11
    reasons = []
    for ms in range(0, 1201, 10):
        t_ns = early_ns + ms * MS
        motion.observe(JointReading(t_ns, 0, NAMES, np.full(len(NAMES), 0.8)), t_ns)
        reasons.append(motion.objection(t_ns))
    assert reasons == [Reason.MOVING] * 8 + [None] * 93 + [Reason.JOINTS_FROZEN] * 20


def test_the_health_says_that_joints_are_frozen_until_one_changes() -> None:
    hand = HandLimits(joints=True)
    model = TactileModel(zoo.find("cnn1"))
    pipeline = Pipeline(model, FINGERS, Limits(), lambda: START_NS, hand=hand)
    for ms in range(0, 1501, 10):
        angles = np.array([0.8, 0.4 + (ms == 1500)])
        pipeline.observe_joints(JointReading(START_NS + ms * MS, 0, ("FFJ3", "THJ1"), angles))
        frozen = pipeline.health().get("joints") is Reason.JOINTS_FROZEN
        assert frozen is (1000 < ms < 1500)
