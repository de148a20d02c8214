"""How fast the electrodes change: now against the last moments, so that noise is no motion.

The window is remembered in few sweeps however fast they come, so memory is constant.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from daemon.judge.findings import Number
from drivers.base import ELECTRODES

SWEEPS = 16
"""Sweeps remembered of a window; of faster readings, some are left out."""
KEPT = SWEEPS + 2
"""And one at each end of the window."""
ONES = np.ones(ELECTRODES, dtype=np.float32)


def mean_distance(
    one: NDArray[np.float32], other: NDArray[np.float32], usable: NDArray[np.bool_]
) -> NDArray[np.float64]:
    """Of the `usable` electrodes (fingers, 24), counts, shape (..., fingers).

    Counts of shape (..., fingers, 24), whole numbers below 2**16: float32 adds 24 of them exactly.
    """
    distance = one - other
    np.abs(distance, out=distance)
    if np.count_nonzero(usable) == usable.size:
        return (distance @ ONES).astype(np.float64) / ELECTRODES
    distance *= usable
    mean: NDArray[np.float64] = (distance @ ONES) / np.maximum(usable.sum(axis=1), 1)
    return mean


@dataclass(slots=True, eq=False)
class StillnessMemory:
    """The medians of the last window."""

    times_ns: list[int]
    """Of the sweeps of the window, oldest first."""
    sweeps: NDArray[np.float32]
    """Shape (2 * KEPT, fingers, 24), twice as long as it must be: the window is a slice of it that
    moves to the right, and goes back to the left when it has come to the end."""
    first: Number
    """Where in `sweeps` the window begins."""

    def __post_init__(self) -> None:
        """Raise `ValueError` for what no window can be."""
        if self.first + len(self.times_ns) > len(self.sweeps):
            raise ValueError("the window is longer than what is remembered")


class Stillness:
    """Remembers the medians of the last window."""

    def __init__(self, window_ns: int, fingers: int) -> None:
        """`window_ns` is how far back a sweep is compared with, at least, ns."""
        self._window_ns = window_ns
        sweeps = np.zeros((2 * KEPT, fingers, ELECTRODES), dtype=np.float32)
        self.memory = StillnessMemory([], sweeps, 0)

    def reset(self) -> None:
        """Forget: what comes next does not continue what came before."""
        self.memory.times_ns.clear()
        self.memory.first = 0

    def add(self, t_ns: int, median: NDArray[np.float32]) -> None:
        """Take in the median of `t_ns`, shape (fingers, 24)."""
        memory = self.memory
        times_ns, sweeps = memory.times_ns, memory.sweeps
        if times_ns and t_ns - times_ns[-1] < self._window_ns // SWEEPS:
            return
        if len(times_ns) == KEPT:
            self._drop_oldest()
        place = memory.first + len(times_ns)
        if place == len(sweeps):
            sweeps[: len(times_ns)] = sweeps[memory.first :]
            memory.first, place = 0, len(times_ns)
        sweeps[place] = median
        times_ns.append(t_ns)

    def rate(
        self, t_ns: int, median: NDArray[np.float32], usable: NDArray[np.bool_]
    ) -> NDArray[np.float64] | None:
        """How far each finger's `usable` electrodes were away, counts/s, shape (fingers,).

        The largest mean distance to any sweep of the window, over the window, and to the latest one
        before it, over its age: two moments alone would miss what swings. None while no sweep is
        that old.
        """
        memory, window_ns = self.memory, self._window_ns
        times_ns = memory.times_ns
        while len(times_ns) > 1 and t_ns - times_ns[1] >= window_ns:
            self._drop_oldest()
        if not times_ns or t_ns - times_ns[0] < window_ns:
            return None
        past = memory.sweeps[memory.first : memory.first + len(times_ns)]
        rates = mean_distance(past, median, usable)
        rates[0] /= (t_ns - times_ns[0]) / 1e9
        rates[1:] /= window_ns / 1e9
        rate: NDArray[np.float64] = np.maximum.reduce(rates, axis=0)
        return rate

    def _drop_oldest(self) -> None:
        del self.memory.times_ns[0]
        self.memory.first += 1


STEP_NS = 5_000_000
"""Of sweeps that come faster than this, the mean is remembered."""
SHORT_NS, LONG_NS = WINDOWS_NS = (80_000_000, 240_000_000)
"""Windows that a straight line is fitted to: the short one shows fast motion soon, the long one a
slow slide; no window as short as that can."""
STEPS = LONG_NS // STEP_NS + 2
"""Steps remembered: the long window, and one at each end of it."""
SPIKE_COUNTS = 20.0
"""A value that falls further than this is believed when the next one is as low. Spikes last for one
sweep and go down by 25 counts or more; noise does so in one value of three thousand."""
BLOCK_STEPS, BLOCKS = 24, 16
"""Noise is the lower quartile of so many blocks of so many steps (about 4 s at 100 Hz): it stays
what it is while a hand closes or opens, ..."""
BLOCKS_MIN = 4
"""... and is not known before there are so many of them."""
SIGMA_COUNTS = (0.5, 10.0)
"""An electrode wavers no less, as counts are whole numbers, and no more: measured 2.9 to 4.3."""
APART = 3
"""Steps that are so far apart have no noise in common: sensors show a correlation of 0.32 at one
sweep and 0.03 at two, and a palm's stream at 100 Hz repeats 2 of 7 values besides."""
SOUND_MIN = 12
"""A finger of which fewer electrodes, of 24, were usable all the time is not known to be still."""
MEAN_ABS = math.sqrt(2.0 / math.pi)
"""Mean absolute value of a Gaussian of standard deviation 1."""
NOISE_SPREAD = math.sqrt((math.pi / 2.0 - 1.0) / ELECTRODES)
"""Standard deviation of the mean of 24 absolute values of a Gaussian, over its mean."""
CREEP_COUNTS_PER_S, CREEP_SPREAD = 6.0, 0.67
"""A held touch relaxes: median speed of its electrodes, and standard deviation of its logarithm.
With the noise it is what 44 held touches of one sensor showed, in windows of 50 to 240 ms."""
FALSE_ALARMS = 0.05
"""Share of the sweeps of a hand that holds in which it may be said to move."""
FAST_SHARE = 0.1
"""Share of that which the short window may have where the long one decides."""


@dataclass(slots=True, eq=False)
class MotionMemory:
    """The last steps and the noise of a hand; arrays of sweeps have shape (fingers, 24)."""

    times_ns: NDArray[np.int64]
    """Shape (2 * STEPS,), oldest first; as with `steps`, what is remembered is a slice."""
    steps: NDArray[np.float32]
    """Shape (2 * STEPS, fingers, 24): it moves to the right, and then goes back to the left."""
    clean: NDArray[np.float32]
    """The last sweep without spikes."""
    counts: NDArray[np.float32]
    """The last sweep as it came."""
    fallen: NDArray[np.bool_]
    """Where it was lower, and not believed."""
    usable_since_ns: NDArray[np.int64]
    """Since when an electrode has been usable."""
    total: NDArray[np.float32]
    """Sum of the sweeps of the step at hand."""
    block: NDArray[np.float64]
    """Sums of the squared differences of steps 1 to `APART` apart, shape (APART, fingers)."""
    blocks: NDArray[np.float64]
    """Their means, shape (BLOCKS, APART, fingers), written round and round."""
    first: Number = 0
    """Where in `steps` the oldest is."""
    number: Number = 0
    """Steps that are remembered."""
    sweeps: Number = 0
    """Sweeps of the step at hand."""
    total_ns: int = 0
    """Sum of their times since the step before."""
    last_ns: int | None = None
    """Time of the last sweep that ended a step."""
    block_steps: Number = 0
    """Steps of the block at hand."""
    block_number: Number = 0
    """Blocks so far."""


class Motion:
    """How each finger moves, in units of its own noise; constant memory, no clock.

    The mean over the electrodes of the absolute fitted slope, over what noise alone would make of
    it. Noise is known from the differences of sweeps, which slow motion hardly changes.
    """

    def __init__(self, fingers: int, false_alarms: float = FALSE_ALARMS) -> None:
        """`false_alarms`: share of a holding hand's sweeps that may be called moving, 0..0.5.

        Raises `ValueError` for another one.
        """
        if not 0.0 < false_alarms < 0.5:
            raise ValueError(f"false_alarms is {false_alarms}, must be between 0 and 0.5")
        shape = (fingers, ELECTRODES)
        finger = 1.0 - (1.0 - false_alarms) ** (1.0 / fingers)
        # Rows: the short window, the long one, and the short one where the long one decides.
        tails = np.array([upper_tail(share) for share in (finger, finger, FAST_SHARE * finger)])
        self._noise_factor = np.exp(NOISE_SPREAD * tails)[:, np.newaxis]
        self._creep = CREEP_COUNTS_PER_S * np.exp(CREEP_SPREAD * tails)[:, np.newaxis]
        self.memory = MotionMemory(
            times_ns=np.zeros(2 * STEPS, dtype=np.int64),
            steps=np.zeros((2 * STEPS, *shape), dtype=np.float32),
            clean=np.zeros(shape, dtype=np.float32),
            counts=np.zeros(shape, dtype=np.float32),
            fallen=np.zeros(shape, dtype=np.bool_),
            usable_since_ns=np.zeros(shape, dtype=np.int64),
            total=np.zeros(shape, dtype=np.float32),
            block=np.zeros((APART, fingers)),
            blocks=np.zeros((BLOCKS, APART, fingers)),
        )
        self._unknown = np.full((2, fingers), np.inf)
        self.motion = self._unknown
        """Over the short and the long window, shape (2, fingers), in units of the finger's noise;
        infinite where it is not known."""
        self.limits = np.ones((2, fingers))
        """What it may be at most for a finger that is still, in the same units."""
        self.early = False
        """Whether fast motion is excluded."""
        self.sure = False
        """Whether slow slides are excluded as well, as far as they can be told from noise."""

    def reset(self) -> None:
        """Forget the motion: what comes next does not continue what came before."""
        memory = self.memory
        memory.number = memory.sweeps = memory.block_steps = memory.total_ns = 0
        memory.first = 0
        memory.last_ns = None
        memory.total.fill(0.0)
        memory.block.fill(0.0)
        self._say_unknown()

    def forget(self) -> None:
        """Forget the noise too: the sensors may be others."""
        self.reset()
        self.memory.block_number = 0

    def add(self, t_ns: int, counts: NDArray[np.uint16], usable: NDArray[np.bool_]) -> None:
        """Take in the sweep of `t_ns`, shape (fingers, 24), and which electrodes are usable.

        Times must not go back; call `reset` where they do, and after a gap.
        """
        memory = self.memory
        if memory.last_ns is None:
            memory.last_ns = t_ns
            memory.clean[:] = memory.counts[:] = counts
            memory.fallen.fill(False)
            memory.usable_since_ns.fill(t_ns)
        self._clean(counts.astype(np.float32))
        if np.count_nonzero(usable) != usable.size:
            # Not in this step, and what comes next has nothing to fall from.
            memory.usable_since_ns[~usable] = t_ns + STEP_NS
            memory.fallen[~usable] = True
        memory.total += memory.clean
        memory.total_ns += t_ns - memory.last_ns
        memory.sweeps += 1
        if memory.number and t_ns - memory.last_ns < STEP_NS:
            return
        self._remember(memory.last_ns + memory.total_ns // memory.sweeps)
        memory.total.fill(0.0)
        memory.sweeps = memory.total_ns = 0
        memory.last_ns = t_ns
        self._learn_noise()
        self._decide()

    def _clean(self, counts: NDArray[np.float32]) -> None:
        """Leave out what has fallen for one sweep alone; held values repeat what was not."""
        memory = self.memory
        fallen = memory.clean - counts > SPIKE_COUNTS
        if fallen.any():
            fallen &= ~memory.fallen | (counts == memory.counts)
            memory.clean = np.where(fallen, memory.clean, counts)
        else:
            memory.clean = counts
        memory.fallen, memory.counts = fallen, counts

    def _remember(self, t_ns: int) -> None:
        memory = self.memory
        if memory.number == STEPS:
            memory.first += 1
            memory.number -= 1
        place = memory.first + memory.number
        if place == len(memory.steps):
            memory.steps[: memory.number] = memory.steps[memory.first :]
            memory.times_ns[: memory.number] = memory.times_ns[memory.first :]
            memory.first, place = 0, memory.number
        memory.steps[place] = memory.total / memory.sweeps
        memory.times_ns[place] = t_ns
        memory.number += 1

    def _learn_noise(self) -> None:
        memory = self.memory
        if memory.number <= APART:
            return
        last = memory.first + memory.number - 1
        differences = memory.steps[last] - memory.steps[last - APART : last][::-1]
        known = memory.usable_since_ns <= memory.times_ns[last - APART]
        differences *= known
        squares = np.einsum("sfe,sfe->sf", differences, differences)
        memory.block += squares / np.maximum(np.count_nonzero(known, axis=1), 1)
        memory.block_steps += 1
        if memory.block_steps == BLOCK_STEPS:
            memory.blocks[memory.block_number % BLOCKS] = memory.block / BLOCK_STEPS
            memory.block_number += 1
            memory.block_steps = 0
            memory.block.fill(0.0)

    def _noise(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Variance of a step, counts**2, (fingers,), and correlations, (APART - 1, fingers)."""
        number = min(self.memory.block_number, BLOCKS)
        squares = np.sort(self.memory.blocks[:number], axis=0)[number // 4]
        low, high = SIGMA_COUNTS
        correlations = 1.0 - squares[:-1] / np.maximum(squares[-1], 2.0 * low**2)
        variance = np.minimum(np.maximum(squares[-1] / 2.0, low**2), high**2)
        return variance, np.minimum(np.maximum(correlations, 0.0), 1.0)

    def _decide(self) -> None:
        memory = self.memory
        if memory.block_number < BLOCKS_MIN:
            self._say_unknown()
            return
        part = slice(memory.first, memory.first + memory.number)
        ages_ns = memory.times_ns[part][-1] - memory.times_ns[part]
        variance, correlations = self._noise()
        motion, limits = self._unknown.copy(), np.ones((3, len(variance)))
        for row, window_ns in enumerate(WINDOWS_NS):
            begins = int(np.count_nonzero(ages_ns >= window_ns))
            times_s = ages_ns[begins:] / -1e9
            if not begins or len(times_s) < 3:
                continue
            times_s -= times_s.mean()
            extent = float(times_s @ times_s)
            echoes = [times_s[lag:] @ times_s[:-lag] / extent for lag in range(1, APART)]
            noise = MEAN_ABS * np.sqrt(
                variance * (1.0 + 2.0 * np.array(echoes) @ correlations) / extent
            )
            weights = (times_s / extent).astype(np.float32)
            steps = memory.steps[memory.first + begins : part.stop]
            slopes = (weights @ steps.reshape(len(steps), -1)).reshape(memory.clean.shape)
            known = memory.usable_since_ns <= memory.times_ns[memory.first + begins]
            numbers = np.count_nonzero(known, axis=1)
            mean = (np.abs(slopes) * known).sum(axis=1) / np.maximum(numbers, 1)
            motion[row] = np.where(numbers >= SOUND_MIN, mean / noise, np.inf)
            for limit in (0, 2) if window_ns == SHORT_NS else (1,):
                limits[limit] = np.hypot(self._noise_factor[limit], self._creep[limit] / noise)
        self.motion, self.limits = motion, limits[:2]
        self.early = bool((motion[0] <= limits[0]).all())
        self.sure = bool((motion[1] <= limits[1]).all() and (motion[0] <= limits[2]).all())

    def _say_unknown(self) -> None:
        self.motion, self.limits = self._unknown, np.ones_like(self._unknown)
        self.early = self.sure = False


def upper_tail(share: float) -> float:
    """How many standard deviations this share, 0..0.5, of a Gaussian lies above.

    Abramowitz and Stegun, 26.2.23; the error is at most 0.00045.
    """
    t = math.sqrt(-2.0 * math.log(share))
    above = 2.515517 + t * (0.802853 + t * 0.010328)
    return t - above / (1.0 + t * (1.432788 + t * (0.189269 + t * 0.001308)))
