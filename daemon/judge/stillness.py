"""How fast the electrodes change: now against the last moments, so that noise is no motion.

The window is remembered in few sweeps however fast they come, so memory is constant.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from daemon.judge.findings import Number
from drivers.base import ELECTRODES

SWEEPS = 16
"""Sweeps remembered of a window; of faster readings, some are left out."""
KEPT = SWEEPS + 2
"""And one at each end of the window."""
ONES = np.ones(ELECTRODES, dtype=np.float32)


def mean_distance(
    one: NDArray[np.float32], other: NDArray[np.float32], usable: NDArray[np.bool_]
) -> NDArray[np.float64]:
    """Of the `usable` electrodes (fingers, 24), counts, shape (..., fingers).

    Counts of shape (..., fingers, 24), whole numbers below 2**16: float32 adds 24 of them exactly.
    """
    distance = one - other
    np.abs(distance, out=distance)
    if np.count_nonzero(usable) == usable.size:
        return (distance @ ONES).astype(np.float64) / ELECTRODES
    distance *= usable
    mean: NDArray[np.float64] = (distance @ ONES) / np.maximum(usable.sum(axis=1), 1)
    return mean


@dataclass(slots=True, eq=False)
class StillnessMemory:
    """The medians of the last window."""

    times_ns: list[int]
    """Of the sweeps of the window, oldest first."""
    sweeps: NDArray[np.float32]
    """Shape (2 * KEPT, fingers, 24), twice as long as it must be: the window is a slice of it that
    moves to the right, and goes back to the left when it has come to the end."""
    first: Number
    """Where in `sweeps` the window begins."""

    def __post_init__(self) -> None:
        """Raise `ValueError` for what no window can be."""
        if self.first + len(self.times_ns) > len(self.sweeps):
            raise ValueError("the window is longer than what is remembered")


class Stillness:
    """Remembers the medians of the last window."""

    def __init__(self, window_ns: int, fingers: int) -> None:
        """`window_ns` is how far back a sweep is compared with, at least, ns."""
        self._window_ns = window_ns
        sweeps = np.zeros((2 * KEPT, fingers, ELECTRODES), dtype=np.float32)
        self.memory = StillnessMemory([], sweeps, 0)

    def reset(self) -> None:
        """Forget: what comes next does not continue what came before."""
        self.memory.times_ns.clear()
        self.memory.first = 0

    def add(self, t_ns: int, median: NDArray[np.float32]) -> None:
        """Take in the median of `t_ns`, shape (fingers, 24)."""
        memory = self.memory
        times_ns, sweeps = memory.times_ns, memory.sweeps
        if times_ns and t_ns - times_ns[-1] < self._window_ns // SWEEPS:
            return
        if len(times_ns) == KEPT:
            self._drop_oldest()
        place = memory.first + len(times_ns)
        if place == len(sweeps):
            sweeps[: len(times_ns)] = sweeps[memory.first :]
            memory.first, place = 0, len(times_ns)
        sweeps[place] = median
        times_ns.append(t_ns)

    def rate(
        self, t_ns: int, median: NDArray[np.float32], usable: NDArray[np.bool_]
    ) -> NDArray[np.float64] | None:
        """How far each finger's `usable` electrodes were away, counts/s, shape (fingers,).

        The largest mean distance to any sweep of the window, over the window, and to the latest one
        before it, over its age: two moments alone would miss what swings. None while no sweep is
        that old.
        """
        memory, window_ns = self.memory, self._window_ns
        times_ns = memory.times_ns
        while len(times_ns) > 1 and t_ns - times_ns[1] >= window_ns:
            self._drop_oldest()
        if not times_ns or t_ns - times_ns[0] < window_ns:
            return None
        past = memory.sweeps[memory.first : memory.first + len(times_ns)]
        rates = mean_distance(past, median, usable)
        rates[0] /= (t_ns - times_ns[0]) / 1e9
        rates[1:] /= window_ns / 1e9
        rate: NDArray[np.float64] = np.maximum.reduce(rates, axis=0)
        return rate

    def _drop_oldest(self) -> None:
        del self.memory.times_ns[0]
        self.memory.first += 1
