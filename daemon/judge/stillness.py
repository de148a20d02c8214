"""Whether the fingers keep still: how each moves, in units of its own noise."""

from __future__ import annotations

import math
from collections.abc import Sequence
from statistics import NormalDist
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from graspd.biotac import ELECTRODES
from graspd.daemon.judge.windows import (
    APART,
    BLOCK_STEPS,
    BLOCKS,
    LONG_NS,
    LOST_MAX,
    MEAN_ABS,
    SHORT_NS,
    STEP_NS,
    STEP_SWEEPS_MAX,
    STEPS,
    STEPS_MIN,
    Noise,
)

SPIKE_COUNTS = 20.0
"""A value that jumps further is believed once the next one does too. Spikes last for one sweep:
those of a sensor are 25 counts or more; noise jumps so far in one value of three thousand."""
SPIKE_SWEEPS_MAX = 3
"""Sweeps that a spike lasts where values come more slowly than sweeps and are held."""
SPIKES_MAX = 4
"""More electrodes of a finger that jump in one sweep are motion: noise does that less than once a
year."""
QUARTILE = 0.95
"""Lower quartile of the blocks' variances over their mean; the same for white noise."""
BLOCKS_MIN = 4
"""Blocks from which on noise is known."""
SIGMA_COUNTS = (0.5, 10.0)
"""An electrode wavers no less, as counts are whole numbers, and no more: measured 2.9 to 4.3."""
SOUND_MIN = 12
"""A finger of which fewer electrodes, of 24, were usable all the time is not known to be still."""
ONES = np.ones(ELECTRODES, dtype=np.float32)
SLOPE_SPREAD = math.sqrt((math.pi / 2.0 - 1.0) / ELECTRODES)
"""Standard deviation of the mean of 24 absolute values of a Gaussian, over its mean."""
CREEP_COUNTS_PER_S, CREEP_SPREAD = 7.5, 0.67
"""A held touch relaxes: median speed of its electrodes, root mean square, and standard deviation of
its logarithm. With the noise it is what 44 held touches of one sensor showed, in windows of 50 to
240 ms."""
FAST_SHARE = 0.1
"""Share of the false alarms that the short window may have where the long one decides."""
LOOSE_SHARE = 0.1
"""Share of `false_alarms` by which the loose limit is laid, as noise and creep alone pass it. The
pressure of a real hold wanders as well: together they pass it in `false_alarms` of the time."""

Times = NDArray[np.float64]
SlowNoise = tuple[float, list[float], list[float]]
"""Arguments of `slow_limit` besides a tail."""


class Tails(NamedTuple):
    """How far a finger that holds may be above what is usual, in standard deviations."""

    slow: float
    """In the long window."""
    fast: float
    """In the short window where the long one decides."""
    alone: float
    """In the short window where it decides alone."""

    @classmethod
    def of(cls, fingers: int, false_alarms: float, *, early: bool) -> Tails:
        """Return them by `false_alarms`, 0..0.5. Raises `ValueError` for another share."""
        if not 0.0 < false_alarms < 0.5:
            raise ValueError(f"false_alarms is {false_alarms}, must be between 0 and 0.5")
        finger = 1.0 - (1.0 - false_alarms) ** (1.0 / fingers)
        slow, fast = (-NormalDist().inv_cdf(share) for share in (finger, FAST_SHARE * finger))
        return cls(slow, fast, slow if early else fast)


class MotionLimits(NamedTuple):
    """Largest motion of each finger, in units of its noise, and whether all fingers are within."""

    fast: list[float]
    """Largest motion of each finger over the short window."""
    slow: list[float]
    """Largest motion of each finger over the long window."""
    early: bool = False
    """True if all fingers keep within `fast`."""
    sure: bool = False
    """True if all fingers keep within both: slow slides are excluded too."""


class Motion:
    """How each finger moves, in units of its own noise; constant memory, no clock.

    Fast motion shows in a short window, as the mean of the electrodes' absolute slopes. Slow slides
    stop and turn; they show in a long one, as the root mean square of the electrodes' deviations
    from their means. Each is divided by what noise alone makes of it. There are two limits of it: a
    hand settles by the strict one, and goes on by the loose one.
    """

    def __init__(self, fingers: int, false_alarms: float, *, early: bool = False) -> None:
        """`false_alarms`: share of a settled hand's sweeps that may pass the loose limit, 0..0.5.

        With `early` the short window may have as large a share itself. Raises `ValueError` for
        another share.
        """
        shape = (fingers, ELECTRODES)
        self._strict = Tails.of(fingers, false_alarms, early=early)
        self._loose = Tails.of(fingers, LOOSE_SHARE * false_alarms, early=early)
        self._noise: Noise | None = None
        """Worked out when it is needed, once for each new block."""
        self.clean = np.zeros(shape, dtype=np.float32)
        """The last sweep without spikes, shape (fingers, 24), as all arrays of sweeps."""
        self._times_ns = np.zeros(2 * STEPS, dtype=np.int64)
        """Oldest first; as with `steps`, what is remembered is a slice."""
        self.steps = np.zeros((2 * STEPS, *shape), dtype=np.float32)
        """It moves to the right, and then goes back to the left."""
        self.first = self.number = 0
        """Index of the oldest entry in `steps`, and number of steps that are remembered."""
        self._counts = np.zeros(shape, dtype=np.float32)
        """The last sweep as it came."""
        self._jumped = np.zeros(shape, dtype=np.uint8)
        """Number of sweeps for which it has jumped and was not believed."""
        self._lost = np.zeros(shape, dtype=np.uint8)
        """Number of sweeps for which it has not been usable, up to `LOST_MAX` and one."""
        self._usable_since_ns = np.zeros(shape, dtype=np.int64)
        """Since when an electrode has been usable; gaps of `LOST_MAX` sweeps do not count."""
        self._all_usable_since_ns = 0
        """Since when all have."""
        self._total = np.zeros(shape, dtype=np.float32)
        """Sum of the sweeps of the step at hand."""
        self._sweeps = 0
        """Sweeps of the step at hand."""
        self._total_ns = 0
        """Sum of their times since the step before."""
        self._last_ns: int | None = None
        """Time of the last sweep that ended a step."""
        self.block = np.zeros((APART, fingers))
        """Sums of the squared differences of steps 1 to `APART` apart."""
        self._blocks = np.zeros((BLOCKS, APART, fingers))
        """Their means, written round and round."""
        self._block_steps = 0
        """Steps of the block at hand."""
        self._pending = 0
        """The last of these, which are still to be taken into it."""
        self._block_number = 0
        """Blocks so far."""
        self._jumps = np.zeros(shape, dtype=np.float32)
        self._unknown = [math.inf] * fingers
        self._no_limits = MotionLimits([1.0] * fingers, [1.0] * fingers)
        self.fast = self.slow = self._unknown
        """How each finger moves over the short and over the long window, in units of its noise;
        infinite where that is not known."""
        self.strict = self.loose = self._no_limits
        """Limits of that motion before a hand has settled, and after it."""
        self.looked = False
        """True if that was worked out for the last step; else it was not wanted."""
        self.known = False
        """True if it is known of all fingers how they moved in the short window."""

    @property
    def slides(self) -> bool:
        """True if a finger is known to move slowly, or to have moved within the long window."""
        limits = self.strict.slow
        return any(limit < move < math.inf for move, limit in zip(self.slow, limits, strict=True))

    def reset(self) -> None:
        """Forget the motion: what comes next does not continue what came before."""
        self.number = self._sweeps = self._block_steps = self._total_ns = 0
        self.first = self._pending = 0
        self._last_ns = None
        self.block.fill(0.0)
        self._say_unknown()

    def forget(self) -> None:
        """Forget the noise too: the sensors may be others."""
        self.reset()
        self._block_number = 0
        self._noise = None

    def add(
        self,
        t_ns: int,
        counts: NDArray[np.uint16],
        usable: NDArray[np.bool_] | None,
        *,
        wanted: bool = True,
    ) -> None:
        """Take in the sweep of `t_ns`, shape (fingers, 24), and which electrodes are usable.

        `usable` is None if all are. How the fingers move is not worked out, and not known, where it
        is not `wanted`. Times must not go back; call `reset` where they do, and after a gap.
        """
        sweep = counts.astype(np.float32)
        if self._last_ns is None:
            self._last_ns = self._all_usable_since_ns = t_ns
            self.clean = self._counts = sweep
            self._jumped.fill(0)
            self._lost.fill(LOST_MAX)
            self._usable_since_ns.fill(t_ns)
        if usable is None:
            self._lost.fill(0)
        else:
            sweep = np.where(usable, sweep, self.clean)
            gone = ~usable & (self._lost >= LOST_MAX)
            if gone.any():
                end = self.first + self.number
                was_usable = self._usable_since_ns[gone] <= self._times_ns[end - 1 - APART]
                if self._pending and was_usable.any():
                    self._fill_block()
                # Not in this step, and what comes next has nothing to jump from.
                self._all_usable_since_ns = t_ns + STEP_NS
                self._usable_since_ns[gone] = t_ns + STEP_NS
                self._jumped[gone] = SPIKE_SWEEPS_MAX
            self._lost += ~usable & ~gone
            self._lost[usable] = 0
        self._clean(sweep)
        self._total = self._total + self.clean if self._sweeps else self.clean
        self._total_ns += t_ns - self._last_ns
        self._sweeps += 1
        if self.number and t_ns - self._last_ns < STEP_NS:
            if self._sweeps > STEP_SWEEPS_MAX:
                self._say_unknown()
            elif wanted and not self.looked:
                self._decide()
            return
        self._remember(self._last_ns + self._total_ns // self._sweeps)
        self._sweeps = self._total_ns = 0
        self._last_ns = t_ns
        self._learn_noise()
        if wanted:
            self._decide()
        else:
            self._say_unknown()

    def _clean(self, counts: NDArray[np.float32]) -> None:
        """Leave out what has jumped for one sweep alone, or is held for a few."""
        jumps = self._jumps
        np.abs(np.subtract(counts, self.clean, out=jumps), out=jumps)
        self._counts, before = counts, self._counts
        if jumps.item(jumps.argmax()) <= SPIKE_COUNTS:
            self.clean = counts
            self._jumped.fill(0)
            return
        jumped = jumps > SPIKE_COUNTS
        jumped[np.count_nonzero(jumped, axis=1) > SPIKES_MAX] = False
        held = (counts == before) & (self._jumped < SPIKE_SWEEPS_MAX)
        jumped &= (self._jumped == 0) | held
        self._jumped += 1
        self._jumped *= jumped
        self.clean = np.where(jumped, self.clean, counts)

    def _remember(self, t_ns: int) -> None:
        if self.number == STEPS:
            self.first += 1
            self.number -= 1
        place = self.first + self.number
        if place == len(self.steps):
            self.steps[: self.number] = self.steps[self.first :]
            self._times_ns[: self.number] = self._times_ns[self.first :]
            self.first, place = 0, self.number
        np.divide(self._total, self._sweeps, out=self.steps[place])
        self._times_ns[place] = t_ns
        self.number += 1

    def _learn_noise(self) -> None:
        if self.number <= APART:
            return
        self._pending += 1
        self._block_steps += 1
        if self._block_steps >= BLOCK_STEPS:
            self._fill_block()
            self._blocks[self._block_number % BLOCKS] = self.block / BLOCK_STEPS
            self._block_number += 1
            self._noise = None
            self._block_steps = 0
            self.block.fill(0.0)

    def _fill_block(self) -> None:
        """Take the pending steps into the block, by the electrodes that are usable until now."""
        end = self.first + self.number
        begin, self._pending = end - self._pending, 0
        since_ns = self._times_ns[begin - APART : end - APART, np.newaxis, np.newaxis]
        usable = self._usable_since_ns <= since_ns
        numbers = np.maximum(np.count_nonzero(usable, axis=2), 1)
        for apart, sums in enumerate(self.block, start=1):
            differences = self.steps[begin:end] - self.steps[begin - apart : end - apart]
            means = (np.square(differences) * usable) @ ONES / numbers
            np.add.reduce((sums, *means), axis=0, out=sums)

    def _mean(self, values: NDArray[np.float32], begin: int) -> list[float]:
        """Return each finger's mean over electrodes usable since `begin`; infinite: too few."""
        since_ns = self._times_ns.item(begin)
        if self._all_usable_since_ns <= since_ns:
            return [total / ELECTRODES for total in values.dot(ONES).tolist()]
        usable = self._usable_since_ns <= since_ns
        totals = ((values * usable) @ ONES).tolist()
        numbers = np.count_nonzero(usable, axis=1).tolist()
        return [
            total / number if number >= SOUND_MIN else math.inf
            for total, number in zip(totals, numbers, strict=True)
        ]

    def _known_noise(self) -> Noise:
        number = min(self._block_number, BLOCKS)
        squares = np.sort(self._blocks[:number], axis=0)[number // 4]
        low, high = SIGMA_COUNTS
        correlations = 1.0 - squares[:-1] / np.maximum(squares[-1], 2.0 * low**2)
        correlations = np.minimum(np.maximum(correlations, 0.0), 1.0)
        variance = np.minimum(np.maximum(squares[-1] / 2.0 / QUARTILE, low**2), high**2)
        return Noise.of(variance, correlations)

    def _decide(self) -> None:
        number, end = self.number, self.first + self.number
        self._say_unknown()
        self.looked = True
        if self._block_number < BLOCKS_MIN or number <= STEPS_MIN:
            return
        times_ns = self._times_ns[self.first : end]
        now_ns = times_ns.item(-1)
        age_ns = now_ns - times_ns.item(0)
        if age_ns < SHORT_NS:
            return
        windows = times_ns.searchsorted((now_ns - SHORT_NS, now_ns - LONG_NS), side="right")
        short, long = (min(begin, number - STEPS_MIN) for begin in windows.tolist())
        if self._noise is None:
            self._noise = self._known_noise()
        times_s = (times_ns[long:] - now_ns) / 1e9
        first, noise, is_full = self.first, self._noise, age_ns >= LONG_NS
        fast_noise = self._follow_fast(first + short, end, times_s[short - long :], noise)
        self.known = max(self.fast) < math.inf
        of_slow = self._follow_slow(first + long, end, times_s, noise) if is_full else None
        self.strict = self._limits(self._strict, fast_noise, of_slow)
        self.loose = self._limits(self._loose, fast_noise, of_slow)

    def _follow_fast(self, begin: int, end: int, times_s: Times, noise: Noise) -> list[float]:
        """Find how steps moved; return the mean absolute slopes that noise makes, counts/s."""
        line = centred(times_s)
        extent = float(line.dot(line))
        root = math.sqrt(extent)
        by_noise = [each / root for each in noise.slope[len(line)].tolist()]
        weights = (line / extent).astype(np.float32)
        slopes = np.abs(weights.dot(self.steps[begin:end].reshape(len(line), -1)))
        means = self._mean(slopes.reshape(self.clean.shape), begin)
        self.fast = [mean / usual for mean, usual in zip(means, by_noise, strict=True)]
        return by_noise

    def _follow_slow(self, begin: int, end: int, times_s: Times, noise: Noise) -> SlowNoise:
        """Find how far steps have spread; return what noise makes of that."""
        steps, number, line = self.steps[begin:end], end - begin, centred(times_s)
        middle = np.add.reduce(steps, axis=0)
        middle /= number
        squares = np.add.reduce(np.square(steps - middle), axis=0)
        means = self._mean(squares, begin)
        by_noise = [each * (number - 1) for each in noise.variance[number].tolist()]
        self.slow = [math.sqrt(mean / usual) for mean, usual in zip(means, by_noise, strict=True)]
        return float(line.dot(line)), by_noise, noise.spread[number].tolist()

    def _limits(
        self, tails: Tails, fast_noise: list[float], of_slow: SlowNoise | None
    ) -> MotionLimits:
        """Return the limits of the steps at hand, and whether the fingers keep to them."""
        fast = fast_limit(tails.alone, fast_noise)
        early = _within(self.fast, fast)
        if of_slow is None:
            return MotionLimits(fast, self._no_limits.slow, early)
        slow = slow_limit(tails.slow, *of_slow)
        beside = fast if tails.fast == tails.alone else fast_limit(tails.fast, fast_noise)
        sure = _within(self.slow, slow) and _within(self.fast, beside)
        return MotionLimits(fast, slow, early, sure)

    def _say_unknown(self) -> None:
        self.fast = self.slow = self._unknown
        self.strict = self.loose = self._no_limits
        self.looked = self.known = False


def fast_limit(tail: float, by_noise: Sequence[float]) -> list[float]:
    """Return the limit of each finger's mean absolute slope over `by_noise`, both in counts/s."""
    usual, creeps = math.exp(SLOPE_SPREAD * tail), MEAN_ABS * creep(tail)
    return [math.hypot(usual, creeps / each) for each in by_noise]


def slow_limit(
    tail: float, extent: float, by_noise: Sequence[float], spreads: Sequence[float]
) -> list[float]:
    """Return the limit of each finger's root mean square deviation over that of noise.

    `extent` is the sum of the squares of the times around their mean, s**2, `by_noise` that of the
    noise, counts**2, and `spreads` are those of `Noise`.
    """
    middle, tails, limits = CREEP_COUNTS_PER_S**2, creep(tail) ** 2, []
    for noise, spread in zip(by_noise, spreads, strict=True):
        usual, most = middle * (extent / noise), tails * (extent / noise)
        # Noise and creep know nothing of each other: their deviations add up as squares do.
        above = math.hypot(tail * spread * (1.0 + usual), most - usual)
        limits.append(math.sqrt(1.0 + usual + above))
    return limits


def creep(tail: float) -> float:
    """Return the speed of a held touch, counts/s, `tail` standard deviations above the median."""
    return CREEP_COUNTS_PER_S * math.exp(CREEP_SPREAD * tail)


def centred(times_s: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return times with a mean of 0."""
    return np.asarray(times_s - np.add.reduce(times_s) / len(times_s))


def _within(moves: list[float], limits: list[float]) -> bool:
    """Return True if no finger moves more than its limit."""
    return False not in [move <= limit for move, limit in zip(moves, limits, strict=True)]
