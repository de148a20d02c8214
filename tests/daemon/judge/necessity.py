"""The conditions that a verdict must meet by the documentation, followed without the judge.

All bounds are necessary conditions. Where the judge remembers more than is followed here (which
electrodes jump or are dead), conditions that depend on it are not checked.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray

from graspd.drivers.base import JointReading, TactileReading

MS = 1_000_000
AGE_MAX_MS = 100
GAP_MS = 100
STILL_MS, EARLY_MS = 240, 100
"""Least time of touch and stillness, ms; the second where a grasp may be judged early."""
WINDOW_MS = 80
"""Length of the window of joint motion, ms."""
MOVED_COUNTS = 15.0
"""A finger whose electrodes are in the mean this far from where they were a short while ago has
moved: the speed of nine held touches in ten stays below 20 counts/s, noise here is 1.4 counts."""
TOUCH_COUNTS, LET_GO = 20.0, 0.6
"""A finger touches while its third deepest electrode has fallen further than its median electrode
by this share, the second number, of `TOUCH_COUNTS`."""
TARE_COUNTS = 5.0
"""Largest error of the judge's tare, which follows the rest and has noise, counts."""
LET_GO_COUNTS = LET_GO * TOUCH_COUNTS - TARE_COUNTS
JOINT_RAD_PER_S = 0.1
JOINTS_LATE_MS, JOINTS_LOST_MS = 150, 1000
JOINTS_FROZEN_MS = 1000
LEFT_OUT_NS = WINDOW_MS * MS // 16
"""Time after an angle within which the judge may leave out the next one, ns."""
REPAIRABLE_BITS = 1 | 2 | 4 | 8
BROKEN_MAX, BROKEN_FINGER_MAX = 12, 8
DEAD_AFTER = 16
SWEEPS_REMEMBERED = 128
SICK_FOR = 24
"""Number of readings for which an electrode that was broken may still count as one that jumps."""
DOUBT_FOR = 40
"""Number of readings that are not checked after one that the judge may or may not have used."""
NEAREST, FURTHEST = 3, 5
"""Of the last 3 values at least two are fresh, of the last 5 three, because at most every other
value repeats the one before."""
STEP_MS, STEP_SWEEPS_MAX = 5, 10
"""Length of a step, ms, and most sweeps in it. The judge uses their mean."""
REMEMBERED = FURTHEST + 2 * STEP_SWEEPS_MAX + 2
KEPT_MS = STILL_MS + GAP_MS + 60
"""Age above which readings and angles are forgotten, ms."""


@dataclass(frozen=True, slots=True, eq=False)
class _Used:
    """A reading that the judge used."""

    t_ns: int
    depth: float
    """Largest possible fall of the required finger that touches least, counts."""
    low: NDArray[np.float64]
    high: NDArray[np.float64]
    """Largest median of each electrode, shape (fingers, 24); `low`: the smallest."""

    def __deepcopy__(self, _memo: object) -> Self:
        return self


@dataclass(frozen=True, slots=True, eq=False)
class _Angles:
    t_ns: int
    angles_rad: NDArray[np.float64]


class Necessity:
    """Says what a verdict on the last reading lacks. The test gives the resting counts."""

    def __init__(
        self,
        rest: NDArray[np.int64],
        fingers: Sequence[str],
        required: Sequence[str],
        still_ms: int = STILL_MS,
        *,
        moved_counts: float = MOVED_COUNTS,
    ) -> None:
        """`rest`: resting counts, shape (fingers, 24), also those before the first reading.
        `required`: fingers that must touch. `still_ms`: least time of touch and stillness, ms.
        `moved_counts`: mean change of a finger's counts that is certainly motion.

        A gap has one limit, `GAP_MS`: no key of a scene changes that.
        """
        self._moved_counts = moved_counts
        self._still_ns = still_ms * MS
        self._rest = rest
        self._required = [fingers.index(finger) for finger in required]
        self._values = np.repeat(rest[np.newaxis].astype(np.float64), REMEMBERED, axis=0)
        """Last values of each electrode, newest first."""
        self._previous: NDArray[np.uint16] | None = None
        self._before: deque[list[bytes | None]] = deque(maxlen=SWEEPS_REMEMBERED)
        """Last sweeps, by finger; None where an electrode was flagged."""
        self._unchanged = np.zeros(rest.shape, dtype=np.int64)
        self._sick = np.zeros(rest.shape, dtype=np.int64)
        self._doubt = 0
        self._together = 0
        """Readings that the judge used within the last two steps, before the last one."""
        self._used: list[_Used] = []
        """The last ones, between which time continues and no gap is."""
        self._joints: dict[bytes, list[_Angles]] = {}
        """Last angles, by which are valid: time rises between them without a gap."""
        self._changed_ns: int | None = None
        """When some angle had another value than before; nothing is remembered of other joints."""
        self._without_joints_since_ns: int | None = None
        self._unusable: list[str] = []

    def observe_joints(self, reading: JointReading) -> None:
        """Take in angles."""
        valid = ~np.isnan(reading.position_rad)
        if not valid.any():
            return
        t_ns = reading.t_ns
        before = self._joints.get(valid.tobytes(), [])
        # Also from those shortly before the last, for some may be left out.
        angles_rad = reading.position_rad[valid]
        is_new = not before or any((one.angles_rad != angles_rad).any() for one in before)
        if is_new or self._changed_ns is None or t_ns < self._changed_ns:
            self._changed_ns = t_ns
        if before and not 0 <= t_ns - before[-1].t_ns <= JOINTS_LATE_MS * MS:
            before = []
        kept = [one for one in before if t_ns - one.t_ns <= KEPT_MS * MS]
        self._joints[valid.tobytes()] = [*kept, _Angles(t_ns, angles_rad)]

    def observe(self, reading: TactileReading) -> None:
        """Take in a reading."""
        self._doubt = max(self._doubt - 1, 0)
        self._unusable = []
        counts, faults = reading.counts, reading.faults
        if counts.shape != self._rest.shape:
            self._unusable = ["the fingers of the model"]
            return
        broken = (faults != 0) | (counts == 0) | (counts >= 4095)
        if (faults & ~np.uint8(REPAIRABLE_BITS)).any():
            self._unusable.append("flags that can be repaired")
        if self._is_same(counts, faults != 0):
            self._unusable.append("a finger that does not repeat itself")
        if self._comes_again(counts, faults != 0):
            self._unusable.append("fingers of which none sends an old sweep")
        if _too_many(broken):
            self._unusable.append("no more broken electrodes than can be repaired")
        self._sick = np.where(broken | (self._unchanged >= DEAD_AFTER), SICK_FOR, self._sick - 1)
        if self._unusable:
            return
        if _too_many(broken | (self._sick > 0)):
            self._doubt = DOUBT_FOR
        self._use(reading, ~broken)

    def lacks(self) -> list[str]:
        """Return unmet conditions of a verdict on the last reading, in words; empty: none known."""
        lacks = [*self._unusable]
        if not lacks and not self._doubt:
            lacks += self._lacks_contact() + self._lacks_stillness() + self._lacks_joints()
        return lacks

    def _is_same(self, counts: NDArray[np.uint16], flagged: NDArray[np.bool_]) -> bool:
        if self._previous is None:
            same = np.zeros(counts.shape, dtype=np.bool_)
        else:
            same = counts == self._previous
        self._previous = counts
        self._unchanged = np.where(same, self._unchanged + 1, 0)
        # A flagged electrode neither repeats anything nor hides that the others do.
        return bool(((same | flagged).all(axis=1) & ~flagged.all(axis=1)).any())

    def _comes_again(self, counts: NDArray[np.uint16], flagged: NDArray[np.bool_]) -> bool:
        """Return True if any finger without flags has exactly its counts of a recent sweep."""
        now = [
            None if flags.any() else sweep.tobytes()
            for sweep, flags in zip(counts, flagged, strict=True)
        ]
        before = zip(*self._before, strict=True)
        again = any(sweep and sweep in old for sweep, old in zip(now, before, strict=False))
        self._before.append(now)
        return again

    def _use(self, reading: TactileReading, valid: NDArray[np.bool_]) -> None:
        shifted = np.concatenate([reading.counts[np.newaxis], self._values[:-1]])
        self._values = np.where(valid, shifted, self._values)
        depth = float(self._depths()[self._required].min())
        t_ns = reading.t_ns
        if self._used and not 0 <= t_ns - self._used[-1].t_ns <= GAP_MS * MS:
            self._used.clear()
        self._together = sum(t_ns - used.t_ns < 2 * STEP_MS * MS for used in self._used)
        values = self._values[: FURTHEST + self._together]
        low, high = values.min(axis=0), values.max(axis=0)
        low, high = np.where(self._sick > 0, 0, low), np.where(self._sick > 0, 4095, high)
        self._used = [used for used in self._used if t_ns - used.t_ns <= KEPT_MS * MS]
        self._used.append(_Used(t_ns, depth, low, high))
        self._drop_joints(t_ns)

    def _depths(self) -> NDArray[np.float64]:
        """Return how far the third deepest electrode of each finger may at most be below its median
        one, counts, shape (fingers,)."""
        nearest = self._values[:NEAREST]
        most, least = self._rest - nearest.min(axis=0), self._rest - nearest.max(axis=0)
        third = np.sort(np.where(self._sick > 0, np.inf, most), axis=1)[:, -3]
        middle = np.sort(np.where(self._sick > 0, -np.inf, least), axis=1)[:, 12]
        depths: NDArray[np.float64] = third - middle
        return depths

    def _lacks_contact(self) -> list[str]:
        now_ns = self._used[-1].t_ns
        for used in self._used:
            if used.t_ns > now_ns - self._still_ns and used.depth < LET_GO_COUNTS:
                return ["contact of all required fingers for as long as it must be still"]
        return []

    def _lacks_stillness(self) -> list[str]:
        now = self._used[-1]
        if self._together > REMEMBERED - FURTHEST:
            return ["no more sweeps at once than can be told apart"]
        if now.t_ns - self._used[0].t_ns < self._still_ns:
            return ["readings without a gap for as long as it must be still"]
        for then in self._used:
            if now.t_ns - then.t_ns < self._still_ns:
                distance = np.maximum(now.low - then.high, then.low - now.high).clip(min=0.0)
                if (distance.mean(axis=1) > self._moved_counts).any():
                    return ["electrodes that are still"]
        return []

    def _drop_joints(self, t_ns: int) -> None:
        """Forget joints that are lost, or whose angles are later than `t_ns` by far."""
        for valid, angles in list(self._joints.items()):
            age_ns = t_ns - angles[-1].t_ns
            if not -JOINTS_LATE_MS * MS <= age_ns <= JOINTS_LOST_MS * MS:
                del self._joints[valid]
                self._without_joints_since_ns = min(angles[-1].t_ns, t_ns)
        if self._without_joints_since_ns is not None:
            self._without_joints_since_ns = min(self._without_joints_since_ns, t_ns)

    def _lacks_joints(self) -> list[str]:
        t_ns = self._used[-1].t_ns
        since_ns = self._without_joints_since_ns
        if not self._joints and since_ns is not None and t_ns - since_ns <= JOINTS_LOST_MS * MS:
            return ["joint angles, or to have waited for them"]
        for angles in self._joints.values():
            if t_ns - angles[-1].t_ns > JOINTS_LATE_MS * MS:
                return ["joint angles in time"]
            if not _may_be_still(angles):
                return ["joints that are still"]
        latest_ns = max((one[-1].t_ns for one in self._joints.values()), default=0)
        changed_ns = latest_ns if self._changed_ns is None else self._changed_ns
        if latest_ns - changed_ns > (JOINTS_FROZEN_MS + KEPT_MS) * MS:
            return ["angles of which some change"]
        return []


def _may_be_still(angles: Sequence[_Angles]) -> bool:
    last_ns = angles[-1].t_ns
    before = [one for one in angles if last_ns - one.t_ns >= WINDOW_MS * MS]
    lately = [one for one in angles if last_ns - one.t_ns < LEFT_OUT_NS]
    then = [one for one in before if before[-1].t_ns - one.t_ns < 2 * LEFT_OUT_NS]
    return any(
        np.abs(now.angles_rad - one.angles_rad).max()
        <= JOINT_RAD_PER_S * (now.t_ns - one.t_ns + LEFT_OUT_NS) / 1e9
        for one in then
        for now in lately
    )


def _too_many(broken: NDArray[np.bool_]) -> bool:
    return bool(broken.sum() > BROKEN_MAX or broken.sum(axis=1).max() > BROKEN_FINGER_MAX)
