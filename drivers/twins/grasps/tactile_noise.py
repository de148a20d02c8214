"""Noise of untouched electrodes: the measured model, or residuals of a recording played again."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from drivers.base import ELECTRODES
from drivers.twins.grasps.grasps import (
    DRIFT_COUNTS_PER_S,
    NOISE_COUNTS,
    SPIKE_COUNTS,
    SPIKE_PROBABILITY,
)

WARM_UP_S = 300.0
"""Drift stops here, s. Not measured: the recordings are shorter. It keeps an endless stream within
the range of a sensor: 210 counts in all."""
PALM_ROWS = 7
"""Rows of 10 ms in which a palm's rounds of 14 ms come round again, ..."""
PALM_STALE_ROWS = 2
"""... and how many of them repeat an electrode: 28.57 %, verified in the untouched recording."""


class TactileNoise(Protocol):
    """What is added to a sweep."""

    def sweep(self, t_s: NDArray[np.float64]) -> NDArray[np.float64]:
        """Noise in counts, shape (fingers, 24), of electrodes sampled at `t_s`, () or (24,)."""


class MeasuredNoise:
    """Gaussian noise, isolated downward spikes of single electrodes, and the warm-up drift.

    Values and their source: `drivers.twins.grasps.grasps`. In a sweep one electrode of a finger
    spikes at most, and never twice in a row; the recordings show no other kind.
    """

    def __init__(self, fingers: int, rng: np.random.Generator) -> None:
        self._rng = rng
        self._fingers = np.arange(fingers)
        self._spiked = rng.integers(0, ELECTRODES, fingers)

    def sweep(self, t_s: NDArray[np.float64]) -> NDArray[np.float64]:
        """See `TactileNoise`."""
        noise = self._rng.normal(0.0, NOISE_COUNTS, (self._fingers.size, ELECTRODES))
        noise += DRIFT_COUNTS_PER_S * np.minimum(t_s, WARM_UP_S)
        spiking = self._rng.random(self._fingers.size) < SPIKE_PROBABILITY * ELECTRODES
        steps = self._rng.integers(1, ELECTRODES, self._fingers.size)
        self._spiked = (self._spiked + steps) % ELECTRODES
        depth = self._rng.uniform(*SPIKE_COUNTS, self._fingers.size)
        noise[self._fingers, self._spiked] -= spiking * depth
        return noise


class PlayedNoise:
    """Residuals played in a loop, one row per sweep, from a random start; nothing is added."""

    def __init__(self, residuals: NDArray[np.float64], rng: np.random.Generator) -> None:
        """`residuals`: counts, shape (rows, fingers, 24), at least one row."""
        self._residuals = residuals
        self._next = int(rng.integers(len(residuals)))

    def sweep(self, t_s: NDArray[np.float64]) -> NDArray[np.float64]:
        """See `TactileNoise`; the time does not matter."""
        row: NDArray[np.float64] = self._residuals[self._next]
        self._next = (self._next + 1) % len(self._residuals)
        return row


def fresh_residuals(held: NDArray[np.uint16]) -> NDArray[np.float64]:
    """Noise of a palm's untouched recording: fresh samples only, without level and drift.

    `held`: counts, shape (rows, fingers, 24), 100 Hz, five new values in seven rows. The result has
    five rows for seven. Level and drift are the straight line through an electrode's samples, moved
    so that the median residual is zero: the spikes, all downward, would pull a mean.
    Raises `ValueError` for less than 70 rows, too few to tell which rows repeat.
    """
    rounds = len(held) // PALM_ROWS
    if rounds < 10:
        raise ValueError(f"{len(held)} rows are too few to tell which ones repeat")
    rows = held[: rounds * PALM_ROWS].astype(np.float64)
    # All fingers are sampled together, so that a row repeats an electrode on all of them at once.
    repeats = (np.diff(rows, axis=0, prepend=np.nan) == 0.0).all(axis=1)
    stale = repeats.reshape(rounds, PALM_ROWS, ELECTRODES).sum(axis=0)
    fresh_places = np.sort(np.argsort(stale, axis=0, kind="stable")[:-PALM_STALE_ROWS], axis=0)
    blocks = rows.reshape(rounds, PALM_ROWS, -1, ELECTRODES)
    fresh = np.take_along_axis(blocks, fresh_places[np.newaxis, :, np.newaxis], axis=1)
    samples = fresh.reshape(rounds * len(fresh_places), -1)
    times = np.arange(len(samples))
    slope, level = np.polyfit(times, samples, 1)
    residuals = samples - np.outer(times, slope) - level
    residuals -= np.median(residuals, axis=0)
    return np.asarray(residuals.reshape(len(samples), -1, ELECTRODES), dtype=np.float64)
