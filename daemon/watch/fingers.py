"""What is drawn of a finger: its tactile image for the eye, what is wrong in it, how it moves."""

from __future__ import annotations

from collections.abc import Collection

import msgspec
import numpy as np
from numpy.typing import NDArray

from models.levels import FULL as FULL
from models.levels import HEIGHT as HEIGHT
from models.levels import PIXELS, fall_of, levels_of
from models.levels import WIDTH as WIDTH
from models.levels import Rest as Rest


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
    marked = {PIXELS[index] for index in np.flatnonzero(~sound)}
    marked |= {PIXELS[number - 1] for number in range(1, 25) if f"{name}_{number}" in repaired}
    fall = fall_of(counts, sound, rest)
    return FingerImage(
        name=name,
        touches=touches,
        from_rest=rest is not None,
        levels=levels_of(fall, from_rest=rest is not None).tolist(),
        deepest=round(float(fall.max())),
        marked=sorted(marked),
        motion=motion,
    )
