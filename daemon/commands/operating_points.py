"""The slowest motions that the gate can tell from noise, for `graspd check`."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from daemon.judge.stillness import Tails, centred, fast_limit, slow_limit
from daemon.judge.windows import LONG_NS, MEAN_ABS, SHORT_NS, STEP_NS, STEPS_MIN, Noise

TYPICAL_COUNTS, TYPICAL_CORRELATIONS = 3.5 / math.sqrt(1.0 - 0.32), (0.32, 0.03)
"""Standard deviation of a held touch's electrode, and its correlation at one and two sweeps.

Measured from differences of sweeps, which the correlation makes smaller: 3.5 counts (2.9 to 4.2).
"""


class OperatingPoint(NamedTuple):
    """What one window can tell."""

    after_ns: int
    """Length of the window, ns."""
    counts_per_s: float
    """Steady motion, mean of a finger's electrodes, that is seen in every other sweep."""


def operating_points(tails: Tails, period_ns: int) -> tuple[OperatingPoint, OperatingPoint]:
    """Return what the short and the long window tell of a finger of typical noise."""
    sweeps = max(math.ceil(STEP_NS / period_ns), 1)
    step_ns = sweeps * period_ns
    short, long = (
        max(math.ceil(window_ns / step_ns), STEPS_MIN) for window_ns in (SHORT_NS, LONG_NS)
    )
    variance, correlations = np.full(1, TYPICAL_COUNTS**2 / sweeps), np.array(TYPICAL_CORRELATIONS)
    noise = Noise.of(variance, correlations[:, np.newaxis])
    # The squares of noise and motion add up: how much motion brings the sum to the limit?
    slope = noise.slope[short].item() / math.sqrt(_extent(short, step_ns))
    (limit,) = fast_limit(tails.alone, [slope])
    fast = slope * math.sqrt(limit**2 - 1.0)
    square, extent = noise.variance[long].item() * (long - 1), _extent(long, step_ns)
    (limit,) = slow_limit(tails.slow, extent, [square], noise.spread[long].tolist())
    slow = MEAN_ABS * math.sqrt((limit**2 - 1.0) * square / extent)
    return (
        OperatingPoint(max(SHORT_NS, short * step_ns), fast),
        OperatingPoint(max(LONG_NS, long * step_ns), slow),
    )


def _extent(steps: int, step_ns: int) -> float:
    times_s = centred(np.arange(steps) * step_ns / 1e9)
    return float(times_s @ times_s)
