"""Whether the hand's joints keep still, as far as they are heard of."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from daemon.judge.reasons import Reason
from drivers.base import JointReading

ANGLES = 16
"""Angles remembered of a window; of faster readings, some are left out."""
LOST_MAX = 64
"""Names of lost joints that are remembered; a hand has 24."""
SOURCES_MAX = 8
"""Sets of joints that are told apart: a sender may send one finger at a time, not random names."""


@dataclass(frozen=True, slots=True)
class JointLimits:
    """When joints keep still, and how long they are waited for."""

    rad_per_s: float = 0.1
    """A joint that turns faster is moving. One count of a Hall sensor is 0.0006 rad, so noise in
    a window shows up to 0.02."""
    window_ns: int = 80_000_000
    """Speed is the difference to the angles at least so long ago, ns."""
    late_ns: int = 150_000_000
    """Angles that are older than this speak against settling, ns ..."""
    lost_ns: int = 1_000_000_000
    """... until they are this old, ns: then the stream is lost, and judging goes on without it."""


class JointMotion:
    """Follows the joints of one hand. Constant memory, no clock."""

    def __init__(self, limits: JointLimits = JointLimits()) -> None:
        """Nothing is known yet; the time for `lost_ns` runs from the first sweep on."""
        self._limits = limits
        self._past: dict[tuple[str, ...], deque[tuple[int, NDArray[np.float64]]]] = {}
        """Angles of each set of joints that is heard of."""
        self._latest_ns: dict[tuple[str, ...], int] = {}
        self._waits_since_ns: int | None = None
        """Since when no joint was heard of."""
        self._lost: set[str] = set()
        """Joints that came once, and no longer."""

    def observe(self, reading: JointReading, t_ns: int) -> None:
        """Take in the angles of `t_ns`, on the same clock as the sweeps.

        Joints whose angle is NaN are not heard: the others count as a sender of their own.
        """
        valid = ~np.isnan(reading.position_rad)
        if not valid.any():
            return
        names = tuple(
            name for name, is_valid in zip(reading.names, valid, strict=False) if is_valid
        )
        if names not in self._past and len(self._past) >= SOURCES_MAX:
            self._past.clear()
            self._latest_ns.clear()
        past = self._past.setdefault(names, deque(maxlen=ANGLES + 2))
        latest_ns = self._latest_ns.get(names, t_ns)
        if not 0 <= t_ns - latest_ns <= self._limits.late_ns:
            past.clear()  # time went back, or nobody knows what the joints did meanwhile
        self._latest_ns[names] = t_ns
        if not past or t_ns - past[-1][0] >= self._limits.window_ns // ANGLES:
            past.append((t_ns, reading.position_rad[valid]))

    def against(self, t_ns: int) -> Reason | None:
        """What the joints say against settling at `t_ns`; None if they are still, or are lost."""
        self._drop_lost(t_ns)
        if not self._past:
            if self._waits_since_ns is None or self._waits_since_ns > t_ns:
                self._waits_since_ns = t_ns
            return None if self.is_lost(t_ns) else Reason.JOINTS_LATE
        if any(t_ns - at_ns > self._limits.late_ns for at_ns in self._latest_ns.values()):
            return Reason.JOINTS_LATE
        return None if all(map(self._is_still, self._past.values())) else Reason.MOVING

    @property
    def some_lost(self) -> bool:
        """Whether judging goes on without a joint that came once."""
        return bool(self._lost.difference(*self._past))

    def is_lost(self, t_ns: int) -> bool:
        """Whether judging goes on without any joints at `t_ns`."""
        return (
            not self._past
            and self._waits_since_ns is not None
            and t_ns - self._waits_since_ns > self._limits.lost_ns
        )

    def _drop_lost(self, t_ns: int) -> None:
        """Forget joints that no longer come, and those of a time that has gone back."""
        for names, latest_ns in list(self._latest_ns.items()):
            if -self._limits.late_ns <= t_ns - latest_ns <= self._limits.lost_ns:
                continue
            del self._past[names], self._latest_ns[names]
            self._waits_since_ns = min(latest_ns, t_ns)
            if len(self._lost) < LOST_MAX:
                self._lost.update(names)

    def _is_still(self, past: deque[tuple[int, NDArray[np.float64]]]) -> bool:
        now_ns, now = past[-1]
        while len(past) > 2 and now_ns - past[1][0] >= self._limits.window_ns:
            past.popleft()
        if now_ns - past[0][0] < self._limits.window_ns:
            return False
        # Against every moment of the window: two alone would miss what swings.
        moved = np.abs(np.array([then for _, then in past]) - now).max(axis=1)
        ages_ns = [max(now_ns - at_ns, self._limits.window_ns) for at_ns, _ in past]
        return bool((moved <= self._limits.rad_per_s * np.array(ages_ns) / 1e9).all())
