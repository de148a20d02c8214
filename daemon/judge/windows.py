"""Windows in which motion is measured: the steps remembered, and the motion that noise seems to be.

The short window shows fast motion early. Slow slides show only in the long one.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from graspd.biotac import ELECTRODES

STEP_NS = 5_000_000
"""Shortest step of a window, ns. Faster sweeps are averaged within a step."""
STEP_SWEEPS_MAX = 10
"""Most sweeps of a step. More came late and all at once, so their motion is not known."""
SHORT_NS, LONG_NS = 100_000_000, 240_000_000
STEPS = LONG_NS // STEP_NS + 2
"""Number of steps kept: those of the long window, and one more at each end."""
STEPS_MIN = 3
"""Fewest steps of a window. With slow sweeps the short window is longer than `SHORT_NS`."""
APART = 3
"""Number of steps after which noise is no longer correlated.

Sensors show a correlation of 0.32 after one sweep and 0.03 after two. A palm's stream at 100 Hz
also repeats 2 of 7 values.
"""
BLOCK_STEPS, BLOCKS = 24, 16
"""Steps of a block, and number of blocks kept: about 4 s at 100 Hz. The noise is the lower quartile
of the blocks, so a hand that closes or opens does not change it."""
LOST_MAX = 3
"""Most sweeps in a row in which the last value of an unusable electrode stands for the new ones."""
MEAN_ABS = math.sqrt(2.0 / math.pi)
"""Mean absolute value of a Gaussian of standard deviation 1."""
SLOPE_ECHO = np.zeros((STEPS + 1, APART - 1))
"""`SLOPE_ECHO[n, k-1]`: lag-k autocorrelation of a centred ramp of n samples; scales the slope's
variance for correlated noise."""
SPREAD_ECHO = np.zeros((STEPS + 1, APART - 1))
"""`SPREAD_ECHO[n, k-1]`: share of the pairs of n samples that are k steps apart. Times the noise's
correlation it is the share by which the samples spread less."""
for _number in range(STEPS_MIN, STEPS + 1):
    for _lag in range(1, APART):
        _line = np.arange(_number) - (_number - 1) / 2.0
        SLOPE_ECHO[_number, _lag - 1] = _line[_lag:] @ _line[:-_lag] / (_line @ _line)
        SPREAD_ECHO[_number, _lag - 1] = 2.0 * (_number - _lag) / (_number * (_number - 1))


@dataclass(frozen=True, slots=True, eq=False)
class Noise:
    """Motion that noise alone seems to show, by a window's number of steps, then by finger."""

    slope: list[list[float]]
    """Mean absolute slope times the square root of the sum of squared times, counts.

    The times are counted from their mean, s. Divide by that root to get the slope, counts/s.
    """
    variance: list[list[float]]
    """Mean square deviation from the mean, counts**2."""
    spread: list[list[float]]
    """Standard deviation of a finger's `variance`, as a share of it."""

    @classmethod
    def of(cls, variance: NDArray[np.float64], correlations: NDArray[np.float64]) -> Noise:
        """Return the motion that measured noise causes in windows of 0 to `STEPS` steps.

        `variance`: of the noise of each finger's electrodes, counts**2, shape (fingers,).
        `correlations`: of the noise with itself 1 to `APART` - 1 steps later, shape
        (APART - 1, fingers).
        """
        slopes = np.maximum(1.0 + 2.0 * SLOPE_ECHO @ correlations, 0.1)
        spreads = np.maximum(1.0 - SPREAD_ECHO @ correlations, 0.1)
        free = ELECTRODES * np.maximum(np.arange(STEPS + 1) - 1.0, 1.0)[:, np.newaxis]
        return cls(
            slope=(MEAN_ABS * np.sqrt(variance * slopes)).tolist(),
            variance=(variance * spreads).tolist(),
            spread=np.sqrt(2.0 * (1.0 + 2.0 * np.square(correlations).sum(axis=0)) / free).tolist(),
        )
