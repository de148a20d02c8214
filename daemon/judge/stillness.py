"""Measure how each finger moves, in units of its own noise, to find whether it keeps still. A sweep
goes through `SpikeFilter`, `StepRing` and `NoiseBlocks`; `MotionLimits` say what is still."""

from __future__ import annotations

import math
from bisect import bisect_right
from operator import truediv

import numpy as np
from numpy.typing import NDArray

from graspd.biotac import ELECTRODES
from graspd.daemon.judge.motion_limits import LOOSE_SHARE, MotionLimits, SlowNoise, Tails
from graspd.daemon.judge.windows import (
    APART,
    BLOCK_STEPS,
    BLOCKS,
    LONG_NS,
    LOST_MAX,
    SHORT_NS,
    STEP_NS,
    STEP_SWEEPS_MAX,
    STEPS,
    STEPS_MIN,
    Noise,
)

SPIKE_COUNTS = 20.0
"""Largest step that is believed at once, counts. A larger one is believed if the next value has it
too. Spikes last for one sweep and are at least 25 counts high. Noise steps this far in one value of
three thousand."""
SPIKE_SWEEPS_MAX = 3
"""Most sweeps that a spike lasts if values come more slowly than sweeps and are repeated."""
SPIKES_MAX = 4
"""Most electrodes of a finger that spike in one sweep. More are motion: by noise alone they would
jump together less than once a year."""
QUARTILE = 0.95
"""Ratio of the lower quartile of the blocks' variances to their mean, for white noise."""
BLOCKS_MIN = 4
"""Fewest blocks by which noise is known."""
SIGMA_COUNTS = (0.5, 10.0)
"""Smallest and largest assumed noise of an electrode, counts; measured 2.9 to 4.3. Counts are whole
numbers, so even a quiet one has some."""
SOUND_MIN = 12
"""Fewest electrodes of a finger, of 24, usable for the whole window; with fewer its motion is
unknown."""
ONES = np.ones(ELECTRODES, dtype=np.float32)
EACH_STEP = np.ones(STEPS, dtype=np.float32)
Sweep = NDArray[np.float32]
"""Counts, shape (fingers, 24)."""
Usable = NDArray[np.bool_]
"""Which electrodes can be used, shape (fingers, 24)."""


class SpikeFilter:
    """Removes spikes: of one sweep, or one count repeated for up to `SPIKE_SWEEPS_MAX` sweeps."""

    def __init__(self, shape: tuple[int, int]) -> None:
        """`shape` is (fingers, 24)."""
        self.clean = np.zeros(shape, dtype=np.float32)
        """The last sweep without spikes."""
        self._came = np.zeros(shape, dtype=np.float32)
        """The last sweep as it came."""
        self._jumped = np.zeros(shape, dtype=np.uint8)
        """Number of sweeps in a row in which an electrode's value was left out as a spike."""
        self._jumps = np.zeros(shape, dtype=np.float32)

    def begin(self, sweep: Sweep) -> None:
        """Take the first sweep as it is."""
        self.clean = self._came = sweep
        self._jumped.fill(0)

    def believe(self, which: Usable) -> None:
        """Take the next values of these electrodes as they are: they have no value to jump from."""
        self._jumped[which] = SPIKE_SWEEPS_MAX

    def add(self, sweep: Sweep) -> Sweep:
        """Take in a sweep; return it with the last clean value in place of each spike."""
        jumps = self._jumps
        np.abs(np.subtract(sweep, self.clean, out=jumps), out=jumps)
        before, self._came = self._came, sweep
        if jumps.item(jumps.argmax()) <= SPIKE_COUNTS:
            self.clean = sweep
            self._jumped.fill(0)
            return sweep
        jumped = jumps > SPIKE_COUNTS
        jumped[np.count_nonzero(jumped, axis=1) > SPIKES_MAX] = False
        held = (sweep == before) & (self._jumped < SPIKE_SWEEPS_MAX)
        jumped &= (self._jumped == 0) | held
        self._jumped += 1
        self._jumped *= jumped
        self.clean = np.where(jumped, self.clean, sweep)
        return self.clean


class StepRing:
    """The last steps of a hand, and the time since which each electrode is usable.

    A step is the mean of the sweeps of at least `STEP_NS`.
    """

    def __init__(self, shape: tuple[int, int]) -> None:
        """`shape` is (fingers, 24)."""
        self.times_s = np.zeros(2 * STEPS)
        """Times of `steps` since the first sweep, s."""
        self.steps = np.zeros((2 * STEPS, *shape), dtype=np.float32)
        """Buffer of steps. The kept ones are a slice from `first`; it moves right, then to 0."""
        self.usable_since_ns = np.zeros(shape, dtype=np.int64)
        """Time since which each electrode is usable, ns, apart from gaps of `LOST_MAX` sweeps."""
        self.crowded = False
        """True if the step has over `STEP_SWEEPS_MAX` sweeps, which came late and all at once."""
        self._lost = np.zeros(shape, dtype=np.uint8)
        """Number of sweeps for which each electrode was not usable, at most `LOST_MAX` + 1."""
        self._total = np.zeros(shape, dtype=np.float32)
        """Sum of the sweeps in the unfinished step."""
        self.reset()

    def reset(self) -> None:
        """Forget the steps."""
        self.times_ns: list[int] = []
        """Times of the steps that are kept, ns, oldest first."""
        self.first = 0
        """Index of the oldest entry in `steps`."""
        self.sweeps = 0
        """Number of sweeps in the unfinished step."""
        self._total_ns = 0
        """Sum of these sweeps' times, counted from the end of the last step, ns."""
        self.last_ns: int | None = None
        """Time of the last sweep that ended a step. None: there is none."""

    def begin(self, t_ns: int) -> None:
        """Start with the first sweep, of `t_ns`, as the end of a step."""
        self.last_ns = self._all_usable_since_ns = t_ns
        self._begun_ns = t_ns
        """Time of the first sweep."""
        self._lost.fill(LOST_MAX)
        self.usable_since_ns.fill(t_ns)

    def find_lost(self, usable: Usable | None) -> Usable | None:
        """Return the electrodes unusable for over `LOST_MAX` sweeps; None if `usable` is None."""
        if usable is None:
            self._lost.fill(0)
            return None
        gone = ~usable & (self._lost >= LOST_MAX)
        self._lost += ~usable & ~gone
        self._lost[usable] = 0
        return gone

    def lose(self, gone: Usable, t_ns: int) -> None:
        """Count the electrodes `gone` as unusable until `STEP_NS` after `t_ns`."""
        self._all_usable_since_ns = t_ns + STEP_NS
        self.usable_since_ns[gone] = t_ns + STEP_NS

    def add(self, t_ns: int, sweep: Sweep) -> bool:
        """Take in the sweep of `t_ns`; return True if it ends a step."""
        since_ns = t_ns if self.last_ns is None else self.last_ns
        self._total = self._total + sweep if self.sweeps else sweep
        self._total_ns += t_ns - since_ns
        self.sweeps += 1
        self.crowded = self.sweeps > STEP_SWEEPS_MAX
        if self.times_ns and t_ns - since_ns < STEP_NS:
            return False
        if len(self.times_ns) == STEPS:
            self.first += 1
            del self.times_ns[0]
        number = len(self.times_ns)
        if self.first + number == len(self.steps):
            self.steps[:number] = self.steps[self.first :]
            self.times_s[:number] = self.times_s[self.first :]
            self.first = 0
        step_ns = since_ns + self._total_ns // self.sweeps
        np.divide(self._total, self.sweeps, out=self.steps[self.first + number])
        self.times_s[self.first + number] = (step_ns - self._begun_ns) / 1e9
        self.times_ns.append(step_ns)
        self.sweeps = self._total_ns = 0
        self.last_ns = t_ns
        return True

    def since(self, begin: int) -> tuple[NDArray[np.float32], NDArray[np.float64]]:
        """Return the steps from index `begin` on, shape (steps, fingers * 24), and their times.

        The times are counted from their mean, s.
        """
        times_ns, first = self.times_ns[begin:], self.first + begin
        number = len(times_ns)
        mean_ns = (sum(times_ns) - number * self._begun_ns) / number
        steps = self.steps[first : first + number].reshape(number, -1)
        return steps, self.times_s[first : first + number] - mean_ns / 1e9

    def mean(self, values: NDArray[np.float32], begin: int) -> list[float]:
        """Return each finger's mean over its electrodes usable since step `begin`.

        Infinite: fewer than `SOUND_MIN` of them. `values`: shape (fingers * 24,).
        """
        values, since_ns = values.reshape(self._total.shape), self.times_ns[begin]
        if self._all_usable_since_ns <= since_ns:
            return [total / ELECTRODES for total in values.dot(ONES).tolist()]
        usable = self.usable_since_ns <= since_ns
        numbers = np.count_nonzero(usable, axis=1)
        means = (values * usable) @ ONES / np.maximum(numbers, 1)
        means[numbers < SOUND_MIN] = math.inf
        return [float(each) for each in means]


class NoiseBlocks:
    """Measures the electrodes' noise by the differences of steps, in blocks of `BLOCK_STEPS`."""

    def __init__(self, fingers: int) -> None:
        self.sums = np.zeros((APART, fingers))
        """Sums of squared differences of steps 1 to `APART` apart, in the unfinished block."""
        self._blocks = np.zeros((BLOCKS, APART, fingers))
        """Ring buffer of the blocks' mean squared differences, counts**2."""
        self.reset()
        self.forget()

    def reset(self) -> None:
        """Forget the unfinished block."""
        self._steps = 0
        """Number of steps in the unfinished block."""
        self._pending = 0
        """Number of these steps, the last ones, that are not in `sums` yet."""
        self.sums.fill(0.0)

    def forget(self) -> None:
        """Forget all blocks."""
        self.number = 0
        """Number of finished blocks."""
        self._noise: Noise | None = None
        """Cached result of `noise`. None: a block was added since."""

    def learn(self, ring: StepRing) -> None:
        """Take in the last step of `ring`, which has just ended."""
        if len(ring.times_ns) <= APART:
            return
        self._pending += 1
        self._steps += 1
        if self._steps >= BLOCK_STEPS:
            self._fill(ring)
            self._blocks[self.number % BLOCKS] = self.sums / BLOCK_STEPS
            self.number += 1
            self._noise = None
            self.reset()

    def lose(self, gone: Usable, ring: StepRing) -> None:
        """Add the pending steps to the block before the electrodes `gone` become unusable."""
        if self._pending and (ring.usable_since_ns[gone] <= ring.times_ns[-1 - APART]).any():
            self._fill(ring)

    def _fill(self, ring: StepRing) -> None:
        """Add the pending steps to the block, using the electrodes that are usable until now."""
        end = ring.first + len(ring.times_ns)
        since_ns = np.array(ring.times_ns[-self._pending - APART : -APART])
        begin, self._pending = end - self._pending, 0
        usable = ring.usable_since_ns <= since_ns[:, np.newaxis, np.newaxis]
        numbers = np.maximum(np.count_nonzero(usable, axis=2), 1)
        for apart, sums in enumerate(self.sums, start=1):
            differences = ring.steps[begin:end] - ring.steps[begin - apart : end - apart]
            sums += ((np.square(differences) * usable) @ ONES / numbers).sum(axis=0)

    def noise(self) -> Noise:
        """Return the motion that noise alone seems to show. Needs at least one finished block."""
        if self._noise is None:
            number = min(self.number, BLOCKS)
            squares = np.sort(self._blocks[:number], axis=0)[number // 4]
            low, high = SIGMA_COUNTS
            correlations = 1.0 - squares[:-1] / np.maximum(squares[-1], 2.0 * low**2)
            correlations = np.minimum(np.maximum(correlations, 0.0), 1.0)
            variance = np.minimum(np.maximum(squares[-1] / 2.0 / QUARTILE, low**2), high**2)
            self._noise = Noise.of(variance, correlations)
        return self._noise


class Motion:
    """How each finger moves, in units of its own noise; constant memory, no clock.

    Fast motion shows in a short window, as the mean of the electrodes' absolute slopes. Slow slides
    stop and turn; they show in a long one, as the root mean square of the electrodes' deviations
    from their means. Both are divided by the value that noise alone gives. Each has two limits: a
    hand settles by the strict one, and continues by the loose one.
    """

    def __init__(self, fingers: int, false_alarms: float, *, early: bool = False) -> None:
        """`false_alarms`: share of a settled hand's sweeps that may pass the loose limit.

        `early`: the short window may decide alone, with the same share. Raises `ValueError` for a
        share that is not above 0 and below 0.5.
        """
        shape = (fingers, ELECTRODES)
        self.spikes = SpikeFilter(shape)
        self.ring = StepRing(shape)
        self.blocks = NoiseBlocks(fingers)
        self.strict = MotionLimits(fingers, Tails.of(fingers, false_alarms, early=early))
        self.loose = MotionLimits(
            fingers, Tails.of(fingers, LOOSE_SHARE * false_alarms, early=early)
        )
        self._unknown = [math.inf] * fingers
        self.fast = self.slow = self._unknown
        """Motion of each finger in the short and in the long window, in units of its noise;
        infinite: not known."""
        self.looked = False
        """True if `fast` and `slow` were computed for the last step."""
        self.known = False
        """True if the motion of all fingers in the short window is known."""

    @property
    def slides(self) -> bool:
        """True if a finger moved more in the long window than the strict limit."""
        limits = self.strict.slow
        return any(limit < move < math.inf for move, limit in zip(self.slow, limits, strict=True))

    def reset(self) -> None:
        """Forget the motion: what comes next does not continue what came before."""
        self.ring.reset()
        self.blocks.reset()
        self._say_unknown()

    def forget(self) -> None:
        """Forget motion and noise: the sensors may have been exchanged."""
        self.reset()
        self.blocks.forget()

    def add(
        self,
        t_ns: int,
        counts: NDArray[np.uint16],
        usable: Usable | None,
        *,
        wanted: bool = True,
    ) -> None:
        """Take in the sweep of `t_ns`, shape (fingers, 24), and which electrodes are usable.

        `usable`: None if all are. `wanted`: False makes the motion unknown from the next step on,
        to save time. Times must not go back: call `reset` before one that does, and after a gap.
        """
        ring, sweep = self.ring, counts.astype(np.float32)
        if ring.last_ns is None:
            ring.begin(t_ns)
            self.spikes.begin(sweep)
        gone = ring.find_lost(usable)
        if usable is not None:
            sweep = np.where(usable, sweep, self.spikes.clean)
        if gone is not None and gone.any():
            self.blocks.lose(gone, ring)
            ring.lose(gone, t_ns)
            self.spikes.believe(gone)
        ended = ring.add(t_ns, self.spikes.add(sweep))
        if ended:
            self.blocks.learn(ring)
        if wanted and not ring.crowded and (ended or not self.looked):
            self._look()
        elif self.looked and (ended or ring.crowded):
            self._say_unknown()

    def _look(self) -> None:
        """Compute the fingers' motion from the steps, and the limits."""
        self._say_unknown()
        times_ns, self.looked = self.ring.times_ns, True
        now_ns, last = times_ns[-1], len(times_ns) - STEPS_MIN
        age_ns = now_ns - times_ns[0]
        if self.blocks.number < BLOCKS_MIN or last <= 0 or age_ns < SHORT_NS:
            return
        noise = self.blocks.noise()
        fast_noise = self._follow_fast(min(bisect_right(times_ns, now_ns - SHORT_NS), last), noise)
        self.known = max(self.fast) < math.inf
        slow_noise = None
        if age_ns >= LONG_NS:
            begin = min(bisect_right(times_ns, now_ns - LONG_NS), last)
            slow_noise = self._follow_slow(begin, noise)
        self.strict.lay(self.fast, fast_noise, self.slow, slow_noise)
        self.loose.lay(self.fast, fast_noise, self.slow, slow_noise)

    def _follow_fast(self, begin: int, noise: Noise) -> list[float]:
        """Set `fast` by the steps from `begin` on; return each finger's noise slope, counts/s."""
        steps, line = self.ring.since(begin)
        extent = line.dot(line).item()
        slopes = np.abs((line / extent).astype(np.float32).dot(steps))
        by_noise = [each / math.sqrt(extent) for each in noise.slope[len(line)]]
        self.fast = list(map(truediv, self.ring.mean(slopes, begin), by_noise))
        return by_noise

    def _follow_slow(self, begin: int, noise: Noise) -> SlowNoise:
        """Set `slow` by the steps from `begin` on; return the noise in that window."""
        steps, line = self.ring.since(begin)
        number, each_step = len(line), EACH_STEP[: len(line)]
        squares = each_step.dot(np.square(steps - each_step.dot(steps) / number))
        by_noise = [each * (number - 1) for each in noise.variance[number]]
        ratios = map(truediv, self.ring.mean(squares, begin), by_noise)
        self.slow = list(map(math.sqrt, ratios))
        return SlowNoise(line.dot(line).item(), by_noise, noise.spread[number])

    def _say_unknown(self) -> None:
        self.fast = self.slow = self._unknown
        self.strict.forget()
        self.loose.forget()
        self.looked = self.known = False
