"""How fast the electrodes change: now against a moment ago, so that noise is not taken for motion.

The window is remembered in few sweeps however fast they come, so memory is constant.
"""

from __future__ import annotations

from collections import deque

import numpy as np
from numpy.typing import NDArray

SWEEPS = 16
"""Sweeps remembered of a window; of faster readings, some are left out."""


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
        """Mean change of each finger's `usable` electrodes, counts/s, shape (fingers,).

        Against the latest sweep that is at least a window old; None while there is none.
        """
        former = None
        while self._past and t_ns - self._past[0][0] >= self._window_ns:
            former = self._past.popleft()
        if former is None:
            return None
        self._past.appendleft(former)
        then_ns, then = former
        distance = np.abs(median.astype(np.int32) - then) * usable
        number = np.maximum(np.count_nonzero(usable, axis=1), 1)
        rate: NDArray[np.float64] = distance.sum(axis=1) / number / ((t_ns - then_ns) / 1e9)
        return rate
