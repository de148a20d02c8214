"""Check that the joints which send angles keep still."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from graspd.daemon.judge.reasons import Reason
from graspd.drivers.base import JointReading

RAD_PER_S = 0.1
"""Largest speed of a joint that keeps still, rad/s.

One count of a Hall sensor is 0.0006 rad, so noise alone shows up to 0.02 rad/s.
"""
WINDOW_NS = 80_000_000
"""Shortest time between two angles from which a speed is computed, ns."""
LATE_NS = 150_000_000
"""Age of the angles above which the grasp cannot settle, ns."""
LOST_NS = 1_000_000_000
"""Age of the angles above which their stream is lost, ns: judging continues without it."""
FROZEN_NS = 1_000_000_000
"""Time without any change of any angle after which the angles are old ones sent again, ns.

The noise of a Hall sensor is one count, so even a single joint changes many times in it.
"""
ANGLES = 16
"""Number of readings of a set of joints that are kept per window; others are left out."""
LOST_MAX = 64
"""Most names of lost joints that are remembered; a hand has 24 joints."""
SOURCES_MAX = 8
"""Most sets of joints, such as those of one finger, that are followed; one more clears them."""


class JointMotion:
    """Follows the joints of one hand. Constant memory, no clock."""

    def __init__(self) -> None:
        """Start without angles; `LOST_NS` counts from the first sweep on."""
        self.past: dict[tuple[str, ...], list[tuple[int, NDArray[np.float64]]]] = {}
        """Times, ns, and angles, rad, shape (names,), of each set, oldest first.

        A set is the tuple of names of joints that are sent together, sorted: keys of a JSON object
        have no order.
        """
        self.latest_ns: dict[tuple[str, ...], int] = {}
        """Time of the last reading of each set, ns."""
        self.lost: list[str] = []
        """Joints whose angles no longer come."""
        self._waits_since_ns: int | None = None
        """Time since which no set is known. None: not noticed yet."""
        self._changed_ns: int | None = None
        """Time of the last change of any angle. None: no angle came yet."""

    def observe(self, reading: JointReading, t_ns: int) -> None:
        """Take in angles made at `t_ns`, on the same clock as the sweeps.

        A joint whose angle is NaN counts as not sent. If its last one is at most `LATE_NS` old, the
        whole message counts as not sent, so that its set is judged by the angles before and after.
        """
        valid = ~np.isnan(reading.position_rad)
        if not valid.any():
            return
        order = sorted(np.flatnonzero(valid).tolist(), key=reading.names.__getitem__)
        names = tuple(reading.names[place] for place in order)
        if len(names) < valid.size and self._lacks_some(names, reading.names, t_ns):
            return
        if names not in self.past and len(self.past) >= SOURCES_MAX:
            self.past.clear()
            self.latest_ns.clear()
        past = self.past.setdefault(names, [])
        latest_ns = self.latest_ns.get(names, t_ns)
        before = past[-1][1] if past else None
        if not 0 <= t_ns - latest_ns <= LATE_NS:
            past.clear()  # time went back, or the joints may have moved in a gap
        self.latest_ns[names] = t_ns
        if not past or t_ns - past[-1][0] >= WINDOW_NS // ANGLES:
            angles = reading.position_rad[order]
            past.append((t_ns, angles))
            del past[: -(ANGLES + 2)]  # one more at each end of the window
            # The first angles of a set are not a change, because sets may come and go.
            changed = before is not None and angles.tobytes() != before.tobytes()
            if changed or self._changed_ns is None or t_ns < self._changed_ns:
                self._changed_ns = t_ns

    def objection(self, t_ns: int) -> Reason | None:
        """Return why the joints forbid settling at `t_ns`. None: they are still, or lost."""
        self._drop_lost(t_ns)
        if not self.past:
            if self._waits_since_ns is None or self._waits_since_ns > t_ns:
                self._waits_since_ns = t_ns
            return None if self.is_lost(t_ns) else Reason.JOINTS_LATE
        if any(t_ns - at_ns > LATE_NS for at_ns in self.latest_ns.values()):
            return Reason.JOINTS_LATE
        if not all(map(self._is_still, self.past.values())):
            return Reason.MOVING
        return Reason.JOINTS_FROZEN if self.is_frozen else None

    def misses_some(self, t_ns: int) -> bool:
        """Return True if joints are missing at `t_ns` and judging continues without them."""
        # Angles that all come that late are forgotten at each sweep, and come again.
        late = any(t_ns - at_ns > LOST_NS for at_ns in self.latest_ns.values())
        return late or self.is_lost(t_ns) or bool(set(self.lost).difference(*self.past))

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

    def _lacks_some(self, names: tuple[str, ...], sent: tuple[str, ...], t_ns: int) -> bool:
        """Return True if a set that came shortly before `t_ns` is `sent`, but with NaN for some.

        `names`: the joints that have angles in the message.
        """
        return any(
            0 <= t_ns - latest_ns <= LATE_NS and set(names) < set(followed) <= set(sent)
            for followed, latest_ns in self.latest_ns.items()
        )

    def _drop_lost(self, t_ns: int) -> None:
        """Forget sets last read over `LOST_NS` before `t_ns`, or over `LATE_NS` after it."""
        for names, latest_ns in list(self.latest_ns.items()):
            if -LATE_NS <= t_ns - latest_ns <= LOST_NS:
                continue
            del self.past[names], self.latest_ns[names]
            self._waits_since_ns = min(latest_ns, t_ns)
            if len(self.lost) < LOST_MAX:
                self.lost += [name for name in names if name not in self.lost]

    def _is_still(self, past: list[tuple[int, NDArray[np.float64]]]) -> bool:
        now_ns, now = past[-1]
        while len(past) > 2 and now_ns - past[1][0] >= WINDOW_NS:
            del past[0]
        if now_ns - past[0][0] < WINDOW_NS:
            return False
        # Each angle of the window is compared with the newest: the ends alone would miss a swing.
        moved = np.abs(np.array([then for _, then in past]) - now).max(axis=1)
        ages_ns = [max(now_ns - at_ns, WINDOW_NS) for at_ns, _ in past]
        return bool((moved <= RAD_PER_S * np.array(ages_ns) / 1e9).all())
