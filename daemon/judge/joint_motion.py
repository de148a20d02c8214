"""Check that the joints which send angles keep still."""

from __future__ import annotations

import math

from graspd.daemon.judge.decision import JOINTS_LATE_NS
from graspd.daemon.judge.reasons import Reason
from graspd.drivers.base import JointReading

RAD_PER_S = 0.1
"""Largest speed of a joint that keeps still, rad/s.

One count of a Hall sensor is 0.0006 rad, so noise alone shows up to 0.02 rad/s.
"""
WINDOW_NS = 80_000_000
"""Shortest time between two angles from which a speed is computed, ns."""
LOST_NS = 1_000_000_000
"""Age of the angles above which their stream is lost, ns: judging continues without it."""
FROZEN_NS = 1_000_000_000
"""Time without any change of any angle after which the angles are old ones sent again, ns.

The noise of a Hall sensor is one count, so even a single joint changes many times in it.
"""
ANGLES = 16
"""Number of angles of a joint that are kept per window; others are left out."""
JOINTS_MAX = 64
"""Most joints that are followed, one more clears them, and most names of lost joints that are
remembered; a hand has 24 joints."""


class JointMotion:
    """Follows the joints of one hand, however messages group them. Constant memory, no clock."""

    def __init__(self) -> None:
        """Start without angles; `LOST_NS` counts from the first sweep on."""
        self.past: dict[str, list[tuple[int, float]]] = {}
        """Times, ns, and angles, rad, of each joint, oldest first."""
        self.latest_ns: dict[str, int] = {}
        """Time of the last angle of each joint, ns."""
        self.lost: list[str] = []
        """Joints whose angles stopped coming at some time; they may have come back."""
        self._waits_since_ns: int | None = None
        """Time since which no joint is known. None: not noticed yet."""
        self._changed_ns: int | None = None
        """Time of the last change of any angle. None: no angle came yet."""

    def observe(self, reading: JointReading) -> None:
        """Take in angles, whose time is on the same clock as the sweeps'.

        A joint whose angle is NaN counts as not sent: it is judged by the angles before and after.
        """
        t_ns = reading.made_ns
        for name, angle in zip(reading.names, reading.position_rad.tolist(), strict=True):
            if not math.isnan(angle):
                self._take(name, angle, t_ns)

    def _take(self, name: str, angle: float, t_ns: int) -> None:
        if name not in self.past and len(self.past) >= JOINTS_MAX:
            self.past.clear()
            self.latest_ns.clear()
        past = self.past.setdefault(name, [])
        before = past[-1][1] if past else None
        if not 0 <= t_ns - self.latest_ns.get(name, t_ns) <= JOINTS_LATE_NS:
            past.clear()  # time went back, or the joint may have moved in a gap
        self.latest_ns[name] = t_ns
        if not past or t_ns - past[-1][0] >= WINDOW_NS // ANGLES:
            past.append((t_ns, angle))
            del past[: -(ANGLES + 2)]  # one more at each end of the window
            # The first angle of a joint is not a change, because joints may come and go.
            changed = before is not None and angle != before
            if changed or self._changed_ns is None or t_ns < self._changed_ns:
                self._changed_ns = t_ns

    def objection(self, t_ns: int) -> Reason | None:
        """Return why the joints forbid settling at `t_ns`. None: they are still, or lost."""
        self._drop_lost(t_ns)
        if not self.past:
            if self._waits_since_ns is None or self._waits_since_ns > t_ns:
                self._waits_since_ns = t_ns
            return None if self.is_lost(t_ns) else Reason.JOINTS_LATE
        if any(t_ns - at_ns > JOINTS_LATE_NS for at_ns in self.latest_ns.values()):
            return Reason.JOINTS_LATE
        if not all(map(self._is_still, self.past.values())):
            return Reason.MOVING
        return Reason.JOINTS_FROZEN if self.is_frozen else None

    def misses_some(self, t_ns: int) -> bool:
        """Return True if joints are missing at `t_ns` and judging continues without them."""
        # Angles that all come that late are forgotten at each sweep, and come again.
        late = any(t_ns - at_ns > LOST_NS for at_ns in self.latest_ns.values())
        return late or self.is_lost(t_ns) or not self.past.keys() >= set(self.lost)

    @property
    def is_frozen(self) -> bool:
        """True if angles have come for over `FROZEN_NS` without any change."""
        if self._changed_ns is None or not self.latest_ns:
            return False
        return max(self.latest_ns.values()) - self._changed_ns > FROZEN_NS

    def is_lost(self, t_ns: int) -> bool:
        """Return True if no joint angle has come for over `LOST_NS` at `t_ns`."""
        return (
            not self.past
            and self._waits_since_ns is not None
            and t_ns - self._waits_since_ns > LOST_NS
        )

    def _drop_lost(self, t_ns: int) -> None:
        """Forget joints read over `LOST_NS` before `t_ns`, or over `JOINTS_LATE_NS` after it."""
        for name, latest_ns in list(self.latest_ns.items()):
            if -JOINTS_LATE_NS <= t_ns - latest_ns <= LOST_NS:
                continue
            del self.past[name], self.latest_ns[name]
            self._waits_since_ns = min(latest_ns, t_ns)
            if name not in self.lost and len(self.lost) < JOINTS_MAX:
                self.lost.append(name)

    def _is_still(self, past: list[tuple[int, float]]) -> bool:
        now_ns, now = past[-1]
        while len(past) > 2 and now_ns - past[1][0] >= WINDOW_NS:
            del past[0]
        if now_ns - past[0][0] < WINDOW_NS:
            return False
        # Each angle of the window is compared with the newest: the ends alone would miss a swing.
        most = RAD_PER_S * WINDOW_NS / 1e9
        for _, angle in past[1:]:
            if not abs(angle - now) <= most:
                return False
        oldest_ns, oldest = past[0]
        return abs(oldest - now) <= RAD_PER_S * (now_ns - oldest_ns) / 1e9
