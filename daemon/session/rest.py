"""Where a hand's electrodes rest: other sensors rest in another pattern, whatever they tell."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

Rest = NDArray[np.float64]
"""Counts, shape (fingers, 24); 0 where it is not known."""

MOVED_COUNTS: Final = 50.0
"""Change of a finger's pattern that drift does not make: median over its electrodes, less what all
of them share. Estimated by the upper tail of the published grasps it is 4 to 23 between the halves
of a day, and 80 to 154 of the first finger between two days; among three sensors of one hand 26 to
122. An untouched sensor's is 1 in ten seconds."""
KNOWN_MIN: Final = 12
"""Electrodes that must be known both times."""
FOLLOWED_COUNTS: Final = 5.0
"""Smaller changes of an electrode are not kept: each one kept is a write to the disk."""


def moved_fingers(before: Rest, now: Rest) -> list[int]:
    """Return the fingers that rest in another pattern than drift explains."""
    moved = []
    for finger, (old, new) in enumerate(zip(before, now, strict=True)):
        known = (old > 0.0) & (new > 0.0)
        if np.count_nonzero(known) < KNOWN_MIN:
            continue
        step = new[known] - old[known]
        if np.median(np.abs(step - np.median(step))) > MOVED_COUNTS:
            moved.append(finger)
    return moved


def has_drifted(before: Rest, now: Rest) -> bool:
    """Return True if an electrode has drifted by more than is worth a write."""
    return bool((np.abs(now - before) > FOLLOWED_COUNTS).any())
