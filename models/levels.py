"""Levels of a tactile image for the eye: how far each electrode is below where its finger rests.

Where a finger rests is in no message, so it is learned while the gate says that nothing touches.
Before that, and where there is no gate, levels show how the finger's electrodes differ from each
other.
"""

from __future__ import annotations

from collections import Counter

import numpy as np
from numpy.typing import NDArray

from graspd.models.layout import D1, ELECTRODES
from graspd.models.tactile_image import Fill, fill_matrix

HEIGHT, WIDTH = D1.shape
FULL = 100
"""Level of the strongest colour."""
FULL_COUNTS = 1600.0
"""Fall that has it, counts. Levels go with the square root: a touch begins at 20 counts, which is
level 11, and real grasps press single electrodes by up to 1800."""
FULL_DEVIATIONS = 2.5
"""The same for a finger whose rest is not known, in standard deviations of its own electrodes."""
SHARE = 0.02
"""Of a new reading in the rest: at 100 Hz it follows in half a second."""
STRAY_COUNTS = 20.0
"""No reading counts as further from the rest than a touch begins: one may be a touch already that
the gate has not seen yet."""
KNOWN_AFTER = 25
"""Readings after which the mean of what came is taken for the rest."""

_FILL = fill_matrix(D1, Fill.NEIGHBOUR_MEAN)[:, :ELECTRODES]
PIXELS = [row * WIDTH + column for row, column in zip(D1.rows, D1.columns, strict=True)]
"""Pixel of each electrode E1..E24."""


class RestCounts:
    """Learns where the electrodes of each finger rest."""

    def __init__(self) -> None:
        self._means: dict[str, NDArray[np.float64]] = {}
        self._readings: Counter[str] = Counter()

    def of(self, finger: str) -> NDArray[np.float64] | None:
        """Return the counts of a finger at rest, shape (24,); None: not known yet."""
        return self._means[finger] if self._readings[finger] >= KNOWN_AFTER else None

    def learn(self, finger: str, counts: NDArray[np.float64], sound: NDArray[np.bool_]) -> None:
        """Learn from a reading of a finger that touches nothing; shapes (24,)."""
        mean = self._means.setdefault(finger, np.zeros(ELECTRODES))
        strays = counts - mean
        if self.of(finger) is not None:
            strays = np.clip(strays, -STRAY_COUNTS, STRAY_COUNTS)
        self._readings[finger] += 1
        share = max(1.0 / self._readings[finger], SHARE)
        mean += np.where(sound, share * strays, 0.0)


def fall_of(
    counts: NDArray[np.float64], sound: NDArray[np.bool_], rest: NDArray[np.float64] | None
) -> NDArray[np.float64]:
    """Return how far each electrode of a finger is below `rest`, counts; all shapes (24,).
    Without a `rest`, that is the median of the `sound` ones. The others get the median fall."""
    reference = np.median(counts[sound]) if rest is None and sound.any() else rest
    fall = np.zeros(ELECTRODES) if reference is None else reference - counts
    if sound.all():
        return fall
    return np.where(sound, fall, np.median(fall[sound]) if sound.any() else 0.0)


def levels_of(fall: NDArray[np.float64], *, from_rest: bool) -> NDArray[np.int64]:
    """Return levels (`HEIGHT` * `WIDTH`,): 0 at rest, `FULL` pressed the most, below 0 risen.
    `fall` is what `fall_of` gives, and `from_rest` whether it knew where the finger rests."""
    pixels = _FILL @ fall
    if from_rest:
        share = np.sign(pixels) * np.sqrt(np.abs(pixels) / FULL_COUNTS)
    else:
        share = pixels / max(FULL_DEVIATIONS * float(fall.std()), 1.0)
    levels: NDArray[np.int64] = np.clip(np.rint(FULL * share), -FULL, FULL).astype(np.int64)
    return levels
