"""The gate: the moment between "the fingers have closed" and "the hand lifts", as a state machine.

    idle -> closing -> settled -> judged
              ^           |         |     moved, changed, lost a finger, or a gap in the readings:
              +-----------+---------+     back to closing
    closing, settled, judged -> released -> idle   (or, touched at once again, -> closing)

A grasp lasts from the first touch until nothing touches. It is judged when all fingers touch and
have kept still until nothing can slide unseen; with `early`, first when nothing moves fast. It
settles by the strict limit of motion and goes on by the loose one, so that the verdict on a hand
that holds does not come and go. From then on it is refreshed many times a second and when the
controller asks. Times are those of the readings, so a stall or a burst of old readings settles
nothing.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from graspd.biotac import ELECTRODES, Finger
from graspd.daemon.judge.decision import HandLimits
from graspd.daemon.judge.reasons import (
    FingerState,
    GateCause,
    GateChange,
    GateState,
    Moment,
    Reason,
)
from graspd.daemon.judge.stillness import ONES, Motion, MotionLimits
from graspd.daemon.judge.windows import LONG_NS, SHORT_NS

REFRESH_NS = 50_000_000
"""Age at which a verdict is refreshed, ns: half of `STANDS_NS`, so that it never grows older,
however slow the readings are, and though one of them is lost."""
STANDS_NS = 100_000_000
"""Age above which a verdict no longer stands, ns."""


class Gate:
    """Follows the grasps of one hand."""

    def __init__(self, fingers: Sequence[Finger], limits: HandLimits) -> None:
        """`fingers` are those of the readings, in their order."""
        required = fingers if limits.required is None else limits.required
        self._fingers = tuple(fingers)
        self.required = frozenset(fingers).intersection(required)
        """Fingers that must touch."""
        self._limits = limits.gate
        self._on_request = limits.on_request
        self.motion = Motion(len(fingers), self._limits.false_alarms, early=self._limits.early)
        self.state = GateState.IDLE
        self.grasp = 0
        """Touches until now; the number of the current grasp."""
        self.in_contact = False
        """True if all required fingers touch."""
        self._reference = np.zeros((len(fingers), ELECTRODES), dtype=np.float32)
        """Shape (fingers, 24): counts where it had settled; means nothing before."""
        self._judged_ns = 0
        """Time of the last judgement."""
        self._last_ns: int | None = None
        """Time of the last reading."""
        self._touched_ns = 0
        """Time at which all required fingers touched; means nothing unless `in_contact`."""
        self._still_since_ns: int | None = None
        """Time since which touch and stillness have lasted. None: something moves."""
        self._moved_since_ns: int | None = None
        """Time since which a judged grasp has moved. None: it does not move."""
        self._sure = False
        """True if it has settled with slow slides excluded: the loose limit holds from then on."""
        self._early = False
        """True if it was judged while something might slide slowly: it is judged again, unasked."""
        self._released_ns = 0
        """Time of the end of the last touch."""
        self._asked = False
        """True while the controller waits for a judgement."""
        self._asked_until_ns: int | None = None
        """None until the first reading after the question."""
        self._objections: tuple[Reason, ...] = (Reason.NO_CONTACT,)
        """Reasons of the last reading against settling."""
        self._changes: list[GateChange] = []
        """Those since the last moment: three of a reading, and one of a restart before it."""
        unknown: dict[Finger, float | None] = dict.fromkeys(fingers)
        self._not_looked = unknown, dict.fromkeys(fingers, 1.0)

    def ask(self) -> None:
        """Judge, maybe again, the grasp that settles within `request_ns` of the next reading."""
        self._asked = True
        self._asked_until_ns = None

    def skip(self, t_ns: int) -> None:
        """Take in the time of a reading that cannot be used, ns."""
        last_ns = self._last_ns
        if last_ns is not None and not 0 <= t_ns - last_ns <= self._limits.gap_ns:
            self.restart(t_ns)

    def observe(
        self,
        t_ns: int,
        counts: NDArray[np.uint16],
        usable: NDArray[np.bool_] | None,
        *,
        touches: bool,
    ) -> None:
        """Take in the motion of a reading of `t_ns`, before `step`; `counts`: shape (fingers, 24).

        `usable`: electrodes that can be used, shape (fingers, 24); None: all. `touches` is True if
        any finger touches.
        """
        self.skip(t_ns)
        self._last_ns = t_ns
        self.motion.add(t_ns, counts, usable, wanted=touches or not self.required)

    def step(
        self,
        t_ns: int,
        median: NDArray[np.uint16],
        usable: NDArray[np.bool_] | None,
        touching: tuple[Finger, ...],
        objections: tuple[Reason, ...] = (),
        *,
        fingers: dict[Finger, FingerState | None] | None = None,
        in_time: bool = True,
        fresh: bool = True,
    ) -> Moment:
        """Take in the median of the reading just observed; return where in a grasp it is.

        `objections` of other parts keep the grasp from settling: no tare, joints that move. The
        grasp is judged only `in_time` and by `fresh` values, or by the newest once the verdict is
        too old to stand. `fingers` goes into the moment as it is.
        """
        self._follow_question(t_ns)
        in_contact = self.required.issubset(touching)
        if in_contact and not self.in_contact:
            self._touched_ns = t_ns
        self.in_contact = in_contact
        reasons = self._disturbances(objections)
        self._follow_stillness(t_ns, bool(reasons))
        self._follow_contact(t_ns, bool(touching))
        state = self.state
        if state is GateState.JUDGED:
            reasons += self._follow_judged(t_ns, median.astype(np.float32), usable)
        elif state is GateState.SETTLED and (reasons or not self._is_still):
            cause = GateCause.MOVED if self.in_contact else GateCause.CONTACT_LOST
            self._enter(GateState.CLOSING, t_ns, cause)
        elif state is GateState.CLOSING and not reasons and self._is_still:
            self._enter(GateState.SETTLED, t_ns, GateCause.STILL)
        if self.state is GateState.CLOSING and not reasons:
            reasons = (Reason.MOVING if self.motion.slides else Reason.SETTLING,)
        self._objections = reasons
        if in_time and self._wants_judgement(fresh=fresh):
            judged = self._judge(t_ns, median)
            return self.moment(touching, fingers, judges=True, judged=judged)
        return self.moment(touching, fingers)

    def moment(
        self,
        touching: tuple[Finger, ...],
        fingers: dict[Finger, FingerState | None] | None = None,
        *,
        judges: bool = False,
        judged: bool = False,
    ) -> Moment:
        """Return where in a grasp the hand is, and forget the changes that led there."""
        is_judged, reasons = self.state is GateState.JUDGED, self._objections
        if not (reasons or is_judged):
            reasons = (Reason.SETTLING if self._is_asked else Reason.NOT_ASKED,)
        changes, self._changes = self._changes, []
        motion, motion_limits = self._nearest_to_limit()
        return Moment(
            grasp=self.grasp,
            state=self.state,
            judges=judges,
            judged=judged,
            in_contact=self.in_contact,
            settled=is_judged and not reasons,
            reasons=reasons,
            touching=touching,
            changes=tuple(changes),
            still_ms=self._still_ns / 1e6,
            early=is_judged and self._early,
            steady=self._keeps_to(self.motion.strict),
            motion=motion,
            motion_limits=motion_limits,
            fingers=fingers,
        )

    def restart(self, t_ns: int) -> None:
        """Have the grasp settle again: readings are missing, or time went back."""
        if self._last_ns is not None and t_ns < self._last_ns:
            self._released_ns = t_ns
            self._asked_until_ns = None
        self._last_ns = t_ns
        self._still_since_ns = None
        self._touched_ns = min(self._touched_ns, t_ns)
        self.motion.reset()
        self._objections = (Reason.SEQUENCE_GAP,)
        if self.state in (GateState.SETTLED, GateState.JUDGED):
            self._enter(GateState.CLOSING, t_ns, GateCause.GAP)

    @property
    def _is_asked(self) -> bool:
        return self._asked or self._early or not self._on_request

    @property
    def _still_ns(self) -> int:
        """Time of touch and stillness, ns; less than the long window if something may slide."""
        if self._still_since_ns is None or self._last_ns is None:
            return 0
        return max(self._last_ns - self._still_since_ns, 0)

    @property
    def _is_still(self) -> bool:
        """True if the hand has kept still for long enough to be judged."""
        return self._still_ns >= (SHORT_NS if self._limits.early else LONG_NS)

    @property
    def _motion_limits(self) -> MotionLimits:
        """Limits of motion now: loose once the grasp is sure, else strict."""
        return self.motion.loose if self._sure else self.motion.strict

    def _keeps_to(self, limits: MotionLimits) -> bool:
        """Return True if nothing moves by which a judged grasp would not stand."""
        return limits.early if self._early else limits.sure

    def _wants_judgement(self, *, fresh: bool) -> bool:
        """Return True if this reading is the one to judge."""
        if self._objections:
            return False
        if self.state is GateState.JUDGED:
            age_ns = (self._last_ns or 0) - self._judged_ns
            return age_ns > STANDS_NS or (fresh and (self._asked or age_ns >= REFRESH_NS))
        return fresh and self.state is GateState.SETTLED and self._is_asked

    def _judge(self, t_ns: int, median: NDArray[np.uint16]) -> bool:
        """Enter `judged`, or stay there; return False if that only refreshes a judgement."""
        refreshes = self.state is GateState.JUDGED and not (self._asked and self._on_request)
        self._judged_ns = t_ns
        self._asked = False
        if self.state is not GateState.JUDGED:
            # Kept when it is judged again: else a grasp that creeps would never be another.
            self._reference = median.astype(np.float32)
            self._early = self._still_ns < LONG_NS
            self._moved_since_ns = None
            self._enter(GateState.JUDGED, t_ns, GateCause.JUDGED)
        return not refreshes

    def _nearest_to_limit(self) -> tuple[dict[Finger, float | None], dict[Finger, float]]:
        """Per finger: motion in the window closer to its limit, and that limit."""
        motion: dict[Finger, float | None] = {}
        limits: dict[Finger, float] = {}
        now, most = self.motion, self._motion_limits
        if not now.looked:
            return self._not_looked
        windows = now.fast, most.fast, now.slow, most.slow
        for finger, moves, limit, slides, slide_limit in zip(self._fingers, *windows, strict=True):
            if slides < math.inf and slides * limit > moves * slide_limit:
                moves, limit = slides, slide_limit
            motion[finger] = round(moves, 2) if moves < math.inf else None
            limits[finger] = round(limit, 2)
        return motion, limits

    def _follow_question(self, t_ns: int) -> None:
        if not self._asked:
            return
        if self._asked_until_ns is None:
            self._asked_until_ns = t_ns + self._limits.request_ns
        elif t_ns > self._asked_until_ns:
            self._asked = False

    def _disturbances(self, objections: tuple[Reason, ...]) -> tuple[Reason, ...]:
        if not self.in_contact:
            not_tared = tuple(reason for reason in objections if reason is Reason.NOT_TARED)
            return (*not_tared, Reason.NO_CONTACT)
        if not self.motion.known:
            return (*objections, Reason.SEQUENCE_GAP)
        return objections if self._motion_limits.early else (*objections, Reason.MOVING)

    def _follow_stillness(self, t_ns: int, disturbed: bool) -> None:
        """The windows say for how long nothing has moved; the touch must have lasted as long."""
        if disturbed:
            self._still_since_ns = None
            return
        since_ns = self._still_since_ns
        if since_ns is None:
            since_ns = max(t_ns - SHORT_NS, self._touched_ns)
        if self._motion_limits.sure:
            since_ns = min(since_ns, max(t_ns - LONG_NS, self._touched_ns))
        else:
            since_ns = max(since_ns, t_ns - LONG_NS + 1_000_000)  # a ms short of it
        self._still_since_ns = since_ns

    def _follow_contact(self, t_ns: int, touches: bool) -> None:
        release_ns = self._limits.release_ns
        if self.state is GateState.RELEASED and t_ns - self._released_ns >= release_ns:
            self._enter(GateState.IDLE, t_ns, GateCause.TIME)
        if touches and self.state in (GateState.IDLE, GateState.RELEASED):
            self.grasp += 1
            self._enter(GateState.CLOSING, t_ns, GateCause.CONTACT)
        if not touches and self.state not in (GateState.IDLE, GateState.RELEASED):
            self._released_ns = t_ns
            self._enter(GateState.RELEASED, t_ns, GateCause.CONTACT_LOST)

    def _follow_judged(
        self, t_ns: int, counts: NDArray[np.float32], usable: NDArray[np.bool_] | None
    ) -> tuple[Reason, ...]:
        """Check that the judged grasp is still the same; return what else is against it."""
        if not self.in_contact:
            self._enter(GateState.CLOSING, t_ns, GateCause.CONTACT_LOST)
            return ()
        distance = _mean_distance(counts, self._reference, usable)
        if max(distance.tolist()) > self._limits.change_counts:
            self._enter(GateState.CLOSING, t_ns, GateCause.CHANGED)
            return ()
        limits = self._motion_limits
        if self._keeps_to(limits):
            self._moved_since_ns = None
            if self._early and self._still_ns >= LONG_NS:
                self._enter(GateState.SETTLED, t_ns, GateCause.STILL)
            return ()
        if self._moved_since_ns is None:
            self._moved_since_ns = t_ns
        elif t_ns - self._moved_since_ns >= 2 * LONG_NS:
            self._enter(GateState.CLOSING, t_ns, GateCause.MOVED)
        return (Reason.MOVING,) if limits.early else ()

    def _enter(self, state: GateState, t_ns: int, cause: GateCause) -> None:
        self._changes.append(GateChange(t_ns, self.grasp, self.state, state, cause))
        self.state = state
        if state in (GateState.SETTLED, GateState.JUDGED):
            self._sure = self._sure or self._still_ns >= LONG_NS
        else:
            self._early, self._sure, self._moved_since_ns = False, False, None


def _mean_distance(
    one: NDArray[np.float32], other: NDArray[np.float32], usable: NDArray[np.bool_] | None
) -> NDArray[np.float64]:
    """Return the mean distance of each finger's `usable` electrodes, counts, shape (fingers,).

    Counts, shape (fingers, 24), are whole numbers below 2**16: float32 adds 24 of them exactly.
    """
    distance = np.abs(one - other)
    if usable is None:
        return np.asarray((distance @ ONES) / np.float64(ELECTRODES))
    return np.asarray((distance * usable) @ ONES / np.maximum(usable.sum(axis=1), 1))
