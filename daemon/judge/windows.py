"""The windows over which motion is looked for: what noise makes of them, and the limits.

The short one shows fast motion soon; the long one slow slides, which no short one can.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from statistics import NormalDist
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from drivers.base import ELECTRODES

STEP_NS = 5_000_000
"""Of sweeps that come faster than this, the mean is remembered."""
STEP_SWEEPS_MAX = 10
"""More sweeps within a step came late, and at once: how the last ones move is not known."""
SHORT_NS, LONG_NS = 100_000_000, 240_000_000
STEPS = LONG_NS // STEP_NS + 2
"""Steps remembered: the long window, and one at each end of it."""
STEPS_MIN = 3
"""Steps of a window at least: where sweeps come slowly, windows are longer."""
APART = 3
"""Steps that are so far apart have no noise in common: sensors show a correlation of 0.32 at one
sweep and 0.03 at two, and a palm's stream at 100 Hz repeats 2 of 7 values besides."""
MEAN_ABS = math.sqrt(2.0 / math.pi)
"""Mean absolute value of a Gaussian of standard deviation 1."""
SLOPE_SPREAD = math.sqrt((math.pi / 2.0 - 1.0) / ELECTRODES)
"""Standard deviation of the mean of 24 absolute values of a Gaussian, over its mean."""
CREEP_COUNTS_PER_S, CREEP_SPREAD = 7.5, 0.67
"""A held touch relaxes: median speed of its electrodes, root mean square, and standard deviation of
its logarithm. With the noise it is what 44 held touches of one sensor showed, in windows of 50 to
240 ms."""
FAST_SHARE = 0.1
"""Share of the false alarms that the short window may have where the long one decides."""
SLOPE_ECHO = np.zeros((STEPS + 1, APART - 1))
"""`SLOPE_ECHO[n, k-1]`: lag-k autocorrelation of a centred ramp of n samples; scales the slope's
variance for correlated noise."""
SPREAD_ECHO = np.zeros((STEPS + 1, APART - 1))
"""`SPREAD_ECHO[n, k-1]`: share of the pairs of n samples that are k steps apart; correlated noise
spreads less by that."""
for _number in range(STEPS_MIN, STEPS + 1):
    for _lag in range(1, APART):
        _line = np.arange(_number) - (_number - 1) / 2.0
        SLOPE_ECHO[_number, _lag - 1] = _line[_lag:] @ _line[:-_lag] / (_line @ _line)
        SPREAD_ECHO[_number, _lag - 1] = 2.0 * (_number - _lag) / (_number * (_number - 1))


@dataclass(frozen=True, slots=True, eq=False)
class Noise:
    """What noise alone makes of windows of a number of steps; shape (steps, fingers)."""

    slope: NDArray[np.float64]
    """Mean absolute slope, counts/s, where squared times around their mean sum to 1 s**2."""
    variance: NDArray[np.float64]
    """Mean square deviation from the mean, counts**2 ..."""
    spread: NDArray[np.float64]
    """... and its standard deviation over that."""

    @classmethod
    def of(cls, variance: NDArray[np.float64], correlations: NDArray[np.float64]) -> Noise:
        """Return it by the variance of each finger's electrodes, counts**2, shape (fingers,).

        `correlations`, shape (APART - 1, fingers): those at 1 to `APART` - 1 steps.
        """
        slopes = np.maximum(1.0 + 2.0 * SLOPE_ECHO @ correlations, 0.1)
        spreads = np.maximum(1.0 - SPREAD_ECHO @ correlations, 0.1)
        free = ELECTRODES * np.maximum(np.arange(STEPS + 1) - 1.0, 1.0)[:, np.newaxis]
        return cls(
            slope=MEAN_ABS * np.sqrt(variance * slopes),
            variance=variance * spreads,
            spread=np.sqrt(2.0 * (1.0 + 2.0 * np.square(correlations).sum(axis=0)) / free),
        )

    def fast(
        self, times_s: NDArray[np.float64], tails: Tails
    ) -> tuple[NDArray[np.float64], list[float], list[float], list[float]]:
        """Describe the short window of steps at these times.

        Return the weights by which a sum of steps is their slope; each finger's mean absolute slope
        by noise alone, counts/s; and the limits of slopes over that, where the short window decides
        alone and where it does not.
        """
        line = centred(times_s)
        extent = float(line.dot(line))
        root = math.sqrt(extent)
        by_noise = [each / root for each in self.slope[len(line)].tolist()]
        alone = beside = fast_limit(tails.alone, by_noise)
        if tails.fast != tails.alone:
            beside = fast_limit(tails.fast, by_noise)
        return line / extent, by_noise, alone, beside

    def slow(self, times_s: NDArray[np.float64], tails: Tails) -> tuple[list[float], list[float]]:
        """Describe the long window of steps at these times.

        Return each finger's sum of squared deviations by noise alone, counts**2, and the limits of
        the root of a sum over that.
        """
        number, line = len(times_s), centred(times_s)
        extent = float(line.dot(line))
        by_noise = [each * (number - 1) for each in self.variance[number].tolist()]
        return by_noise, slow_limit(tails.slow, extent, by_noise, self.spread[number].tolist())


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
