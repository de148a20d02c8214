"""The last three fresh values of every electrode: what repeats, and their median.

A palm that is asked for two electrodes at a time repeats 2 of 7 values of a stream at 100 Hz; one
spike in a hundred values is 25 to 150 counts deep. The median of three fresh values takes spikes
out, and costs one sweep of delay.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from daemon.judge.findings import all_of
from daemon.judge.recurrence import NO_COUNT

VALUES = 3


@dataclass(slots=True, eq=False)
class MedianMemory:
    """The values of every electrode; arrays have shape (fingers, 24)."""

    oldest: NDArray[np.uint16]
    middle: NDArray[np.uint16]
    newest: NDArray[np.uint16]
    last: NDArray[np.uint16]
    """The last one, fresh or not."""
    held: NDArray[np.bool_]
    """Whether that repeated the one before."""
    number: NDArray[np.uint8]
    """How many are fresh, up to three."""
    all_full: bool
    """Whether it is three of each."""
    counts: NDArray[np.uint16]
    """Median of the three; 0 where there is none."""


class FreshMedian:
    """Keeps three fresh values per electrode; constant memory, no clock."""

    def __init__(self, shape: tuple[int, int]) -> None:
        """`shape` is (fingers, 24)."""
        oldest, middle, newest, counts = np.zeros((4, *shape), dtype=np.uint16)
        self.memory = MedianMemory(
            oldest=oldest,
            middle=middle,
            newest=newest,
            last=np.full(shape, NO_COUNT, dtype=np.uint16),
            held=np.zeros(shape, dtype=np.bool_),
            number=np.zeros(shape, dtype=np.uint8),
            all_full=False,
            counts=counts,
        )
        self._same, self._fresh = np.zeros((2, *shape), dtype=np.bool_)
        self._low, self._high = np.zeros((2, *shape), dtype=np.uint16)

    @property
    def counts(self) -> NDArray[np.uint16]:
        """Median of the last three fresh values, shape (fingers, 24); 0 where there is none."""
        return self.memory.counts

    def reset(self) -> None:
        """Forget everything: what comes next does not continue what came before."""
        memory = self.memory
        memory.last = np.full_like(memory.last, NO_COUNT)
        memory.held.fill(False)
        memory.number.fill(0)
        memory.all_full = False

    def push(self, counts: NDArray[np.uint16], usable: NDArray[np.bool_]) -> None:
        """Take in one sweep, shape (fingers, 24); what is not `usable` is forgotten.

        A value that repeats the one before is taken for held, so not fresh; the next one counts
        again: a held value of 71.43 Hz data is never held twice, and a quiet electrode repeats
        itself in one sweep of ten without being held.
        """
        memory = self.memory
        oldest, middle, newest = memory.oldest, memory.middle, memory.newest
        same = np.equal(counts, memory.last, out=self._same)
        held = np.greater(same, memory.held, out=memory.held)  # same, and not held before
        fresh = np.logical_not(held, out=self._fresh)
        all_usable = all_of(usable)
        if not all_usable:
            fresh &= usable
        np.putmask(oldest, fresh, middle)
        np.putmask(middle, fresh, newest)
        np.putmask(newest, fresh, counts)
        if not (all_usable and memory.all_full):
            self._fill(counts, usable, fresh)
        memory.last = counts if all_usable else np.where(usable, counts, memory.last)
        low = np.minimum(oldest, middle, out=self._low)
        high = np.maximum(oldest, middle, out=self._high)
        # A new array each time: what was handed out stays.
        memory.counts = np.maximum(low, np.minimum(high, newest, out=high))

    def _fill(
        self, counts: NDArray[np.uint16], usable: NDArray[np.bool_], fresh: NDArray[np.bool_]
    ) -> None:
        """Count the fresh values; until there are three, the first stands for those missing."""
        memory = self.memory
        memory.number[~usable] = 0
        first = fresh & (memory.number == 0)
        np.copyto(memory.oldest, counts, where=first)
        np.copyto(memory.middle, counts, where=first)
        memory.number += fresh & (memory.number < VALUES)
        memory.all_full = all_of(memory.number == VALUES)

    def is_full(self, usable: NDArray[np.bool_]) -> bool:
        """Whether each `usable` electrode, shape (fingers, 24), has three fresh values."""
        memory = self.memory
        return memory.all_full or bool((memory.number[usable] == VALUES).all())
