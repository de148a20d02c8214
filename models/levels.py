"""Levels of a tactile image for display: how far each electrode is below its resting count.

No message has the resting counts, so they are learned while the gate says that nothing touches.
Before that, and without a gate, levels show how a finger's electrodes differ from each other.
"""

from __future__ import annotations

from statistics import median  # the first call of numpy's loads modules

import numpy as np
from numpy.typing import NDArray

from graspd.biotac import ELECTRODES
from graspd.models.layout import D1
from graspd.models.tactile_image import Fill, fill_matrix

HEIGHT, WIDTH = D1.shape
FULL = 100
"""Level of the strongest colour."""
FULL_COUNTS = 1600.0
"""Fall of an electrode, counts, at level `FULL`; real grasps reach 1800.

Levels grow with the square root, so a touch of 20 counts has level 11.
"""
FULL_DEVIATIONS = 2.5
"""Fall below the finger's median, in its standard deviations, at `FULL` without resting counts."""
SHARE = 0.02
"""Weight of a new reading in the resting counts, which at 100 Hz follow within half a second."""
STRAY_COUNTS = 20.0
"""Limit of a deviation from rest in learning, counts; a larger one, perhaps a touch, is clipped."""
KNOWN_AFTER = 25
"""Number of an electrode's readings after which their mean counts as its resting count."""

_FILL = fill_matrix(D1, Fill.NEIGHBOUR_MEAN)[:, :ELECTRODES]
PIXELS = [row * WIDTH + column for row, column in zip(D1.rows, D1.columns, strict=True)]
"""Pixel of each electrode E1..E24: its index in the image in row-major order."""


class RestCounts:
    """Learn the resting counts of each finger's electrodes."""

    def __init__(self) -> None:
        self._means: dict[str, NDArray[np.float64]] = {}
        self._readings: dict[str, NDArray[np.int64]] = {}
        """Number of sound readings of each electrode; shape (24,)."""

    def of(self, finger: str) -> NDArray[np.float64] | None:
        """Return the resting counts of a finger, shape (24,), NaN where not known yet; None: none
        is known."""
        known = self._readings.get(finger, np.zeros(ELECTRODES)) >= KNOWN_AFTER
        return np.where(known, self._means[finger], np.nan) if known.any() else None

    def learn(self, finger: str, counts: NDArray[np.float64], sound: NDArray[np.bool_]) -> None:
        """Learn from counts of a finger without contact, where `sound` is True; shapes (24,)."""
        mean = self._means.setdefault(finger, np.zeros(ELECTRODES))
        readings = self._readings.setdefault(finger, np.zeros(ELECTRODES, np.int64))
        limit = np.where(readings < KNOWN_AFTER, np.inf, STRAY_COUNTS)
        readings += sound
        share = np.maximum(1.0 / np.maximum(readings, 1), SHARE)
        mean += np.where(sound, share * np.clip(counts - mean, -limit, limit), 0.0)


def fall_of(
    counts: NDArray[np.float64], sound: NDArray[np.bool_], rest: NDArray[np.float64] | None
) -> NDArray[np.float64]:
    """Return how far each electrode of a finger is below its resting counts; all shapes (24,).

    `rest` None: below the median of the `sound` electrodes. Electrodes that are not sound, or whose
    rest is NaN, get the median fall of the others; 0 without any.
    """
    reference = median(counts[sound]) if rest is None and sound.any() else rest
    fall = np.zeros(ELECTRODES) if reference is None else reference - counts
    sound = sound & ~np.isnan(fall)
    if sound.all():
        return fall
    return np.where(sound, fall, median(fall[sound]) if sound.any() else 0.0)


def levels_of(fall: NDArray[np.float64], *, from_rest: bool) -> NDArray[np.int64]:
    """Return levels, shape (`HEIGHT` * `WIDTH`,): 0 at rest, up to `FULL` pressed, below 0 risen.

    `fall`: the result of `fall_of`. `from_rest`: True if `fall_of` had a `rest`.
    """
    pixels = _FILL @ fall
    if from_rest:
        share = np.sign(pixels) * np.sqrt(np.abs(pixels) / FULL_COUNTS)
    else:
        share = pixels / max(FULL_DEVIATIONS * float(fall.std()), 1.0)
    levels: NDArray[np.int64] = np.clip(np.rint(FULL * share), -FULL, FULL).astype(np.int64)
    return levels
