"""The last three fresh values of every electrode: what repeats, and their median.

A palm that is asked for two electrodes at a time repeats 2 of 7 values of a stream at 100 Hz; one
spike in a hundred values is 25 to 150 counts deep. The median of three fresh values takes spikes
out, and costs one sweep of delay.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from daemon.judge.health import NO_COUNT

VALUES = 3


class FreshMedian:
    """Keeps three fresh values per electrode; constant memory, no clock."""

    def __init__(self, shape: tuple[int, int]) -> None:
        """`shape` is (fingers, 24)."""
        self._oldest, self._middle, self._newest = np.zeros((3, *shape), dtype=np.uint16)
        self._last = np.zeros(shape, dtype=np.uint16)
        self._held = np.zeros(shape, dtype=np.bool_)
        self._number = np.zeros(shape, dtype=np.uint8)
        self.counts = np.zeros(shape, dtype=np.uint16)
        """Median of the last three fresh values, shape (fingers, 24); 0 where there is none."""
        self.reset()

    def reset(self) -> None:
        """Forget everything: what comes next does not continue what came before."""
        self._last.fill(NO_COUNT)
        self._held.fill(False)
        self._number.fill(0)
        self._all_full = False

    def push(self, counts: NDArray[np.uint16], usable: NDArray[np.bool_]) -> None:
        """Take in one sweep, shape (fingers, 24); what is not `usable` is forgotten.

        A value that repeats the one before is taken for held, so not fresh; the next one counts
        again: a held value of 71.43 Hz data is never held twice, and a quiet electrode repeats
        itself in one sweep of ten without being held.
        """
        self._held = (counts == self._last) & ~self._held
        fresh = ~self._held
        all_usable = np.count_nonzero(usable) == usable.size
        if not all_usable:
            fresh &= usable
        np.copyto(self._oldest, self._middle, where=fresh)
        np.copyto(self._middle, self._newest, where=fresh)
        np.copyto(self._newest, counts, where=fresh)
        if not (all_usable and self._all_full):
            self._fill(counts, usable, fresh)
        np.copyto(self._last, counts, where=usable)
        # A new array each time: what was handed out stays.
        low = np.minimum(self._oldest, self._middle)
        high = np.maximum(self._oldest, self._middle)
        self.counts = np.maximum(low, np.minimum(high, self._newest))

    def _fill(
        self, counts: NDArray[np.uint16], usable: NDArray[np.bool_], fresh: NDArray[np.bool_]
    ) -> None:
        """Count the fresh values; until there are three, the first stands for those missing."""
        self._number[~usable] = 0
        first = fresh & (self._number == 0)
        np.copyto(self._oldest, counts, where=first)
        np.copyto(self._middle, counts, where=first)
        self._number += fresh & (self._number < VALUES)
        self._all_full = bool((self._number == VALUES).all())

    def is_full(self, usable: NDArray[np.bool_]) -> bool:
        """Whether each `usable` electrode, shape (fingers, 24), has three fresh values."""
        return self._all_full or bool((self._number[usable] == VALUES).all())
