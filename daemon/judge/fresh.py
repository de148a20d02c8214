"""The last three fresh values of every electrode: what repeats, and their median.

A palm that is asked for two electrodes at a time repeats 2 of 7 values of a stream at 100 Hz; one
spike in a hundred values is 25 to 150 counts deep. The median of three fresh values takes spikes
out, and costs one sweep of delay.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from daemon.judge.health import NO_COUNT


class FreshMedian:
    """Keeps three fresh values per electrode; constant memory, no clock."""

    def __init__(self, shape: tuple[int, int]) -> None:
        """`shape` is (fingers, 24)."""
        self._values = np.zeros((3, *shape), dtype=np.uint16)
        self._last = np.zeros(shape, dtype=np.uint16)
        self._held = np.zeros(shape, dtype=np.bool_)
        self._number = np.zeros(shape, dtype=np.uint8)
        self.reset()

    def reset(self) -> None:
        """Forget everything: what comes next does not continue what came before."""
        self._last.fill(NO_COUNT)
        self._held.fill(False)
        self._number.fill(0)

    def push(self, counts: NDArray[np.uint16], usable: NDArray[np.bool_]) -> None:
        """Take in one sweep, shape (fingers, 24); what is not `usable` is forgotten.

        A value that repeats the one before is taken for held, so not fresh; the next one counts
        again: a held value of 71.43 Hz data is never held twice, and a quiet electrode repeats
        itself in one sweep of ten without being held.
        """
        self._held = (counts == self._last) & ~self._held
        fresh = usable & ~self._held
        self._number[~usable] = 0
        oldest, middle, newest = self._values
        first = fresh & (self._number == 0)
        np.copyto(oldest, middle, where=fresh)
        np.copyto(middle, newest, where=fresh)
        np.copyto(newest, counts, where=fresh)
        # Until there are three, the first one stands for those that are missing.
        np.copyto(oldest, counts, where=first)
        np.copyto(middle, counts, where=first)
        self._number += fresh & (self._number < len(self._values))
        np.copyto(self._last, counts, where=usable)

    def is_full(self, usable: NDArray[np.bool_]) -> bool:
        """Whether each `usable` electrode, shape (fingers, 24), has three fresh values."""
        return bool((self._number[usable] == len(self._values)).all())

    @property
    def counts(self) -> NDArray[np.uint16]:
        """Median of the last three fresh values, shape (fingers, 24); 0 where there is none."""
        oldest, middle, newest = self._values
        low, high = np.minimum(oldest, middle), np.maximum(oldest, middle)
        median: NDArray[np.uint16] = np.maximum(low, np.minimum(high, newest))
        return median
