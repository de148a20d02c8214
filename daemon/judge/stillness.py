"""How fast the electrodes change: now against the last moments, so that noise is no motion.

The window is remembered in few sweeps however fast they come, so memory is constant.
"""

from __future__ import annotations

from collections import deque

import numpy as np
from numpy.typing import NDArray

SWEEPS = 16
"""Sweeps remembered of a window; of faster readings, some are left out."""


def mean_distance(
    one: NDArray[np.uint16], other: NDArray[np.uint16], usable: NDArray[np.bool_]
) -> NDArray[np.float64]:
    """Of the `usable` electrodes (fingers, 24), counts, shape (..., fingers).

    Counts of shape (..., fingers, 24).
    """
    distance = np.abs(one.astype(np.int32) - other) * usable
    number = np.maximum(usable.sum(axis=1), 1)
    mean: NDArray[np.float64] = distance.sum(axis=-1) / number
    return mean


class Stillness:
    """Remembers the medians of the last window."""

    def __init__(self, window_ns: int) -> None:
        """`window_ns` is how far back a sweep is compared with, at least, ns."""
        self._window_ns = window_ns
        self._past: deque[tuple[int, NDArray[np.uint16]]] = deque(maxlen=SWEEPS + 2)

    def reset(self) -> None:
        """Forget: what comes next does not continue what came before."""
        self._past.clear()

    def add(self, t_ns: int, median: NDArray[np.uint16]) -> None:
        """Take in the median of `t_ns`, shape (fingers, 24)."""
        if self._past and t_ns - self._past[-1][0] < self._window_ns // SWEEPS:
            return
        self._past.append((t_ns, median))

    def rate(
        self, t_ns: int, median: NDArray[np.uint16], usable: NDArray[np.bool_]
    ) -> NDArray[np.float64] | None:
        """How far each finger's `usable` electrodes were away, counts/s, shape (fingers,).

        The largest mean distance to any sweep of the window, over the window, and to the latest one
        before it, over its age: two moments alone would miss what swings. None while no sweep is
        that old.
        """
        while len(self._past) > 1 and t_ns - self._past[1][0] >= self._window_ns:
            self._past.popleft()
        if not self._past or t_ns - self._past[0][0] < self._window_ns:
            return None
        then = np.array([past for _, past in self._past])
        distance = mean_distance(then, median, usable)
        ages_ns = np.array([max(t_ns - at_ns, self._window_ns) for at_ns, _ in self._past])
        rates = distance / (ages_ns[:, np.newaxis] / 1e9)
        rate: NDArray[np.float64] = rates.max(axis=0)
        return rate
