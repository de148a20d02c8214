"""Noise of untouched electrodes, as measured in recordings."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from graspd.drivers.base import ELECTRODES

NOISE_COUNTS = 3.5
"""Standard deviation of an untouched electrode, counts; measured 2.9 to 4.3 (robust)."""
SPIKE_PROBABILITY = 0.01
"""Chance per electrode and sweep of a downward spike; measured 0.75 to 1.22 %."""
SPIKE_COUNTS = (25.0, 150.0)
"""Depth of a spike, counts; no upward spike was recorded."""
DRIFT_COUNTS_PER_S = 0.7
"""Warm-up drift, counts/s; measured 0.56 to 0.84, always upward."""
WARM_UP_S = 300.0
"""End of the drift, s, after 210 counts; assumed, because the recordings are shorter."""


class MeasuredNoise:
    """Gaussian noise, downward spikes of single electrodes, and the warm-up drift.

    At most one electrode of a finger spikes in a sweep, and none twice in a row, as recorded.
    """

    def __init__(
        self,
        fingers: int,
        rng: np.random.Generator,
        drift_max: NDArray[np.float64] | float = np.inf,
    ) -> None:
        """`drift_max`: largest drift, counts, shape () or (fingers, 24)."""
        self._rng = rng
        self._drift_max = drift_max
        self._fingers = np.arange(fingers)
        self._spiked = rng.integers(0, ELECTRODES, fingers)

    def sweep(self, t_s: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return noise, counts, shape (fingers, 24). `t_s`: sample times, shape () or (24,)."""
        noise = self._rng.normal(0.0, NOISE_COUNTS, (self._fingers.size, ELECTRODES))
        drift = DRIFT_COUNTS_PER_S * np.minimum(t_s, WARM_UP_S)
        noise += np.minimum(drift, self._drift_max)
        spiking = self._rng.random(self._fingers.size) < SPIKE_PROBABILITY * ELECTRODES
        steps = self._rng.integers(1, ELECTRODES, self._fingers.size)
        self._spiked = (self._spiked + steps) % ELECTRODES
        depth = self._rng.uniform(*SPIKE_COUNTS, self._fingers.size)
        noise[self._fingers, self._spiked] -= spiking * depth
        return noise
