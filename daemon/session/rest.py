"""Resting counts of a hand's electrodes, which differ between sensors without serial numbers."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

Rest = NDArray[np.float64]
"""Resting counts, shape (fingers, 24); 0: not known."""

MOVED_COUNTS: Final = 50.0
"""Smallest change of a finger's pattern, counts, that means another sensor, not drift.

It is the median over the electrodes, after subtracting the change that all share. By the upper
tail of the published grasps it is 4 to 23 between the halves of a day, 80 to 154 for the first
finger between two days, and 26 to 122 between the sensors of one hand. An untouched sensor
changes by 1 in ten seconds.
"""
KNOWN_MIN: Final = 12
"""Fewest electrodes of a finger with known rest both times."""
FOLLOWED_COUNTS: Final = 5.0
"""Smallest change of an electrode, counts, that is saved; each save writes to the disk."""


def moved_fingers(before: Rest, now: Rest) -> list[int]:
    """Return the fingers whose resting pattern changed more than drift explains."""
    moved = []
    for finger, (old, new) in enumerate(zip(before, now, strict=True)):
        both_known = (old > 0.0) & (new > 0.0)
        if np.count_nonzero(both_known) < KNOWN_MIN:
            continue
        step = new[both_known] - old[both_known]
        if np.median(np.abs(step - np.median(step))) > MOVED_COUNTS:
            moved.append(finger)
    return moved


def has_drifted(before: Rest, now: Rest) -> bool:
    """Return True if an electrode has drifted enough to be saved."""
    return bool((np.abs(now - before) > FOLLOWED_COUNTS).any())
