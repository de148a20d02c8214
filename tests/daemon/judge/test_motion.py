"""Motion in units of a finger's own noise: when it is known, spikes, lost electrodes, limits."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from graspd.daemon.judge.motion_limits import MotionLimits, Tails
from graspd.daemon.judge.stillness import Motion, StepRing
from graspd.daemon.judge.windows import LOST_MAX, SLOPE_ECHO, SPREAD_ECHO, STEPS, Noise

FINGER = np.ones((1, 24), dtype=np.bool_)
SIGMA_COUNTS, CORRELATION = 3.5, 0.32
"""Noise of real held touches: standard deviation, from differences of sweeps over the root of 2,
and correlation from one sweep to the next."""


def wavering(seconds: float, rate_hz: float, sigma: float, seed: int) -> NDArray[np.float64]:
    """White noise of one finger around 2000 counts, shape (sweeps, 1, 24)."""
    random = np.random.default_rng(seed)
    return 2000.0 + random.normal(0.0, sigma, (round(seconds * rate_hz), 1, 24))


def fed(motion: Motion, counts: NDArray[np.float64], rate_hz: float, begin_ns: int = 0) -> int:
    """Feed sweeps `counts`, shape (sweeps, fingers, 24), at `rate_hz` from `begin_ns` on to
    `motion`; return when the next one is due, ns."""
    usable = np.ones(counts.shape[1:], dtype=np.bool_)
    for index, sweep in enumerate(np.rint(counts).astype(np.uint16)):
        motion.add(begin_ns + round(index / rate_hz * 1e9), sweep, usable)
    return begin_ns + round(len(counts) / rate_hz * 1e9)


def moves(motion: Motion) -> NDArray[np.float64]:
    """Return each finger's motion in the short and in the long window, shape (2, fingers)."""
    return np.array((motion.fast, motion.slow))


def test_too_many_sweeps_at_once_leave_motion_unknown() -> None:
    motion, counts = Motion(1, 0.05, early=True), wavering(3.0, 100.0, 3.5, 4)
    t_ns = fed(motion, counts, 100.0)
    known = []
    for sweep in np.rint(counts[:20]).astype(np.uint16):
        motion.add(t_ns, sweep, FINGER)
        known.append(motion.known)
    # Ten together, after the one that ended a step.
    assert known == [True] * 11 + [False] * 9
    for after_ms, is_known in ((5, False), (10, True)):
        motion.add(t_ns + after_ms * 1_000_000, np.rint(counts[-1]).astype(np.uint16), FINGER)
        assert motion.known is is_known


def test_motion_is_unknown_until_noise_is_known_and_after_gaps() -> None:
    motion, counts = Motion(1, 0.05, early=True), wavering(3.0, 100.0, 3.5, 4)
    known = []
    for index, sweep in enumerate(np.rint(counts).astype(np.uint16)):
        motion.add(index * 10_000_000, sweep, FINGER)
        known.append(bool(np.isfinite(moves(motion)).all()))
    # Four blocks of 24 differences over three sweeps.
    assert known.index(True) == 4 * 24 + 3 - 1
    motion.reset()
    assert not motion.strict.early
    assert not motion.strict.sure
    assert motion.strict.fast == motion.loose.slow == [1.0]
    fast = []
    for index in range(30):
        motion.add(10**10 + index * 10_000_000, np.rint(counts[index]).astype(np.uint16), FINGER)
        fast.append(tuple(np.isfinite((motion.fast[0], motion.slow[0])).tolist()))
        assert motion.known == fast[-1][0]
    # The first sweep that is 100 ms older than another is the 11th; that is 240 ms older, the 25th.
    assert fast == [(False, False)] * 10 + [(True, False)] * 14 + [(True, True)] * 6
    motion.forget()
    fed(motion, counts[:90], 100.0, 2 * 10**10)
    assert not np.isfinite(moves(motion)).any()


def test_the_echo_tables_equal_their_closed_forms_at_lag_one() -> None:
    """Closed forms of the sums, for neighbours in a window of n steps."""
    n = np.arange(3, STEPS + 1)
    np.testing.assert_allclose(SLOPE_ECHO[3:, 0], 1.0 - 3.0 / n, atol=1e-12)
    np.testing.assert_allclose(SPREAD_ECHO[3:, 0], 2.0 / n)


def test_a_jump_that_lasts_is_believed_in_its_fourth_sweep() -> None:
    motion, sweep = Motion(1, 0.05), np.full((1, 24), 2000, dtype=np.uint16)
    motion.add(0, sweep, None)
    fallen, believed = sweep.copy(), []
    fallen[0, 0] -= 120
    for number in range(1, 5):
        motion.add(number * 10_000_000, fallen, None)
        believed.append(motion.spikes.clean[0, 0] == fallen[0, 0])
    assert believed == [False, False, False, True]


@pytest.mark.parametrize(
    ("electrodes", "counts", "believed"), [(4, 20, True), (4, 21, False), (5, 21, True)]
)
def test_jumps_over_20_counts_in_four_electrodes_are_spikes(
    electrodes: int, counts: int, believed: bool
) -> None:
    motion = Motion(2, 0.05)
    sweep = np.full((2, 24), 2000, dtype=np.uint16)
    motion.add(0, sweep, None)
    jumped = sweep.copy()
    jumped[1, :electrodes] += np.uint16(counts)
    motion.add(10_000_000, jumped, None)
    assert (motion.spikes.clean == (jumped if believed else sweep)).all()


def test_motion_is_unknown_for_a_window_after_electrodes_are_lost() -> None:
    motion = Motion(1, 0.05, early=True)
    counts = np.rint(wavering(3.0, 100.0, 3.5, 12)).astype(np.uint16)
    known = []
    for index in range(300):
        usable, sweep = FINGER.copy(), counts[index].copy()
        if index in (120, 123, *range(150, 153), *range(160, 164), *range(200, 204)):
            lost = 12 if 160 <= index < 164 else 13
            usable[0, :lost] = False
            sweep[0, :lost] = 4095
        motion.add(index * 10_000_000, sweep, None if usable.all() else usable)
        known.append(tuple(np.isfinite((motion.fast[0], motion.slow[0])).tolist()))
        assert not known[-1][1] or motion.slow[0] < 1.5
    # Three sweeps in a row are bridged, a fourth is not: eleven electrodes, not twelve, are too few
    # to know that a finger is still, for as long as a window goes back to it.
    assert set(known[110:203]) == {(True, True)}
    assert known[203:] == [(False, False)] * 10 + [(True, False)] * 14 + [(True, True)] * 73


def test_memory_is_bounded_however_fast_readings_come() -> None:
    motion, counts = Motion(1, 0.05, early=True), wavering(0.5, 20_000.0, 3.5, 14)
    fed(motion, counts, 20_000.0)
    ring = motion.ring
    assert len(ring.times_ns) <= STEPS
    assert ring.first + len(ring.times_ns) <= len(ring.steps)


def test_noise_measured_before_an_electrode_is_lost_still_counts() -> None:
    motion, all_but_one = Motion(1, 0.05), np.ones((1, 24), dtype=np.bool_)
    all_but_one[0, 0] = False
    sweep = np.full((1, 24), 2000, dtype=np.uint16)
    for number in range(26):
        sweep[0, 0] = 2000 + 10 * (number % 2)  # the others read the same all the time
        motion.add(number * 10_000_000, sweep.copy(), all_but_one if number > 20 else None)
    assert motion.blocks.sums[0, 0] > 0.0


@pytest.mark.parametrize("share", [0.0, 0.5, -1.0, float("nan")])
def test_impossible_shares_of_false_alarms_are_refused(share: float) -> None:
    with pytest.raises(ValueError, match="false_alarms"):
        Motion(3, share)


def test_at_10_hz_motion_is_known_from_the_fourth_sweep() -> None:
    motion, counts = Motion(1, 0.05), np.rint(wavering(12.0, 10.0, 3.5, 17)).astype(np.uint16)
    known = []
    for index in range(115):
        if index == 110:
            motion.reset()
        motion.add(index * 100_000_000, counts[index], FINGER)
        known.append(motion.known)
    assert known[109:] == [True, False, False, False, True, True]


@pytest.mark.parametrize("rate_hz", [1000 / 14, 100.0, 1000.0])
def test_motion_computed_now_and_then_equals_motion_always_computed(rate_hz: float) -> None:
    always, late = Motion(1, 0.05), Motion(1, 0.05)
    counts = np.rint(wavering(6.0, rate_hz, 4.0, 5)).astype(np.uint16)
    for index, sweep in enumerate(counts):
        t_ns, looked = round(index / rate_hz * 1e9), index > len(counts) // 2 and index % 7 < 3
        always.add(t_ns, sweep, FINGER)
        late.add(t_ns, sweep, FINGER, wanted=looked)
        if looked:
            assert late.known
            assert (late.fast, late.slow) == (always.fast, always.slow)
            assert (late.strict.early, late.strict.sure) == (
                always.strict.early,
                always.strict.sure,
            )
        elif rate_hz < 200.0:  # else it is what it was at the last step
            assert (late.known, late.strict.early, late.strict.sure) == (False, False, False)


@pytest.mark.parametrize(("sweeps", "counts_per_s"), [(8, 83.0), (12, 53.0), (24, 25.0)])
def test_the_slope_limit_fits_19_of_20_real_touches(sweeps: int, counts_per_s: float) -> None:
    """There are 44 held touches at 100 Hz, in windows of 80, 120 and 240 ms."""
    times_s = 0.01 * (np.arange(sweeps) - (sweeps - 1) / 2)
    variance = np.array([SIGMA_COUNTS**2 / (1.0 - CORRELATION)])
    noise = Noise.of(variance, np.array([[CORRELATION], [0.03]]))
    by_noise = noise.slope[sweeps] / np.sqrt((times_s**2).sum())
    limits = MotionLimits(1, Tails.of(1, 0.05, early=True))
    limits.lay([0.0], by_noise.tolist())
    assert limits.fast[0] * by_noise[0] == pytest.approx(counts_per_s, rel=0.1)


def test_an_electrode_that_stays_unusable_is_lost_for_good() -> None:
    ring, usable = StepRing((1, 24)), FINGER.copy()
    ring.begin(0)
    ring.find_lost(None)
    usable[0, 3] = False
    for sweep in range(1, 600):
        gone = ring.find_lost(usable)
        assert gone is not None
        assert gone.sum() == gone[0, 3] == (sweep > LOST_MAX)
