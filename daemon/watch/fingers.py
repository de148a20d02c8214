"""Tactile images for the eye: how far each electrode is below where its finger rests.

Where a finger rests is not in the messages, so it is learned here, while the gate says that nothing
touches. Before that, and where there is no gate, an image shows how the finger's electrodes differ
from each other.
"""

from __future__ import annotations

from collections.abc import Collection

import msgspec
import numpy as np
from numpy.typing import NDArray

from models.layout import D1, ELECTRODES
from models.tactile_image import Fill, fill_matrix

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
_PIXELS = [row * WIDTH + column for row, column in zip(D1.rows, D1.columns, strict=True)]


class FingerMotion(msgspec.Struct, frozen=True, kw_only=True):
    """How a finger moves, in units of its own noise."""

    now: float | None
    """None: not known, which is not 0."""
    limit: float
    """What it is at most while the finger is still."""


class FingerImage(msgspec.Struct, frozen=True, kw_only=True):
    """What is drawn of one finger."""

    name: str
    touches: bool | None
    """None: not known."""
    from_rest: bool
    """Whether levels are falls below the rest; else deviations from the finger's own median."""
    levels: list[int]
    """By pixel, `HEIGHT` rows of `WIDTH`: 0 at rest, `FULL` pressed the most, below 0 risen."""
    deepest: int
    """Largest fall of an electrode, counts."""
    marked: list[int]
    """Pixels of the electrodes that are faulty or were repaired."""
    motion: FingerMotion | None
    """None where nobody says: each reading is a grasp of its own."""


class Rest:
    """Learns where the electrodes of one finger rest."""

    def __init__(self) -> None:
        """Without a reading."""
        self._mean: NDArray[np.float64] = np.zeros(ELECTRODES)
        self._number = 0

    @property
    def counts(self) -> NDArray[np.float64] | None:
        """Where each electrode rests, counts, shape (24,); None as long as it is not known."""
        return self._mean if self._number >= KNOWN_AFTER else None

    def learn(self, counts: NDArray[np.float64], sound: NDArray[np.bool_]) -> None:
        """Take in a reading of a finger that touches nothing; shapes (24,)."""
        self._number += 1
        share = max(1.0 / self._number, SHARE)
        strays = counts - self._mean
        if self.counts is not None:
            strays = np.clip(strays, -STRAY_COUNTS, STRAY_COUNTS)
        self._mean += np.where(sound, share * strays, 0.0)


def image(
    name: str,
    counts: NDArray[np.float64],
    sound: NDArray[np.bool_],
    rest: NDArray[np.float64] | None,
    *,
    touches: bool | None,
    repaired: Collection[str] = (),
    motion: FingerMotion | None = None,
) -> FingerImage:
    """The image of one reading of a finger; `counts`, `sound` and `rest` have shape (24,).

    Electrodes that are not `sound` are drawn as the median of the others, and marked.
    """
    marked = {_PIXELS[index] for index in np.flatnonzero(~sound)}
    marked |= {_PIXELS[number - 1] for number in range(1, 25) if f"{name}_{number}" in repaired}
    reference = np.median(counts[sound]) if rest is None and sound.any() else rest
    fall = np.zeros(ELECTRODES) if reference is None else reference - counts
    fall = np.where(sound, fall, np.median(fall[sound]) if sound.any() else 0.0)
    return FingerImage(
        name=name,
        touches=touches,
        from_rest=rest is not None,
        levels=_levels(fall, from_rest=rest is not None),
        deepest=round(float(fall.max())),
        marked=sorted(marked),
        motion=motion,
    )


def _levels(fall: NDArray[np.float64], *, from_rest: bool) -> list[int]:
    pixels = _FILL @ fall
    if from_rest:
        share = np.sign(pixels) * np.sqrt(np.abs(pixels) / FULL_COUNTS)
    else:
        share = pixels / max(FULL_DEVIATIONS * float(fall.std()), 1.0)
    levels: list[int] = np.clip(np.rint(FULL * share), -FULL, FULL).astype(int).tolist()
    return levels
