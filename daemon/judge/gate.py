"""The gate: the moment between "the fingers have closed" and "the hand lifts", as a state machine.

A grasp lasts from the first touch until nothing touches. It is judged when all fingers touch and
have kept still until nothing can slide unseen; with `early`, first when nothing moves fast. It
settles by the strict limit of motion and continues by the loose one, so that the verdict on a hand
that holds does not come and go. From then on it is refreshed many times a second and when the
controller asks. It counts time by the readings' own times, so a stall or a burst of old readings
settles nothing. `phase.TRANSITIONS` has all ways from one state to the next.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from graspd.biotac import ELECTRODES, Finger
from graspd.daemon.judge import phase as ways
from graspd.daemon.judge.decision import HandLimits
from graspd.daemon.judge.motion_limits import MotionLimits
from graspd.daemon.judge.phase import Phase, Transition
from graspd.daemon.judge.reasons import FingerState, GateState, Moment, Reason
from graspd.daemon.judge.stillness import ONES, Motion
from graspd.daemon.judge.windows import LONG_NS, SHORT_NS

REFRESH_NS = 50_000_000
"""Age at which a verdict is refreshed, ns: half of `STANDS_NS`, so that it is never older than
that, even with slow readings of which one is lost."""
STANDS_NS = 100_000_000
"""Largest age of a verdict, ns. After it a reading is judged even if fresh values are missing."""
CHANGE_COUNTS = 40.0
"""Largest mean change of a finger's electrodes since the first judgement after settling, counts.
Above it the grasp must settle again."""
RELEASE_NS = 100_000_000
"""How long the gate stays in `released` before `idle`, ns."""
JUST_SHORT_NS = LONG_NS - 1_000_000
"""Longest stillness that counts while slow slides are not excluded, ns."""


class Stillness:
    """Measures for how long all required fingers have touched and kept still."""

    def __init__(self) -> None:
        self.touches = False
        """True if all required fingers touch."""
        self.lasts_ns = 0
        """Duration of touch and stillness, ns; below `LONG_NS` unless slow slides are excluded."""
        self.sure = False
        """True if the grasp settled with slow slides excluded, so that the loose limit holds."""
        self.early = False
        """True if it was judged before slow slides were excluded. It is judged again, unasked."""
        self.moved_since_ns: int | None = None
        """Time since which a judged grasp has moved. None: it does not move."""
        self._touched_ns = 0
        """Time from which on all required fingers touch; meaningless unless `touches`."""
        self._since_ns: int | None = None
        """Time since which touch and stillness have lasted. None: something moves."""

    def touch(self, t_ns: int, touches: bool) -> None:
        """Take in whether all required fingers touch."""
        if touches and not self.touches:
            self._touched_ns = t_ns
        self.touches = touches

    def follow(self, t_ns: int, disturbed: bool, is_sure: bool) -> None:
        """Update `lasts_ns` for the reading of `t_ns`.

        `disturbed`: something moves or forbids settling, so counting starts again. `is_sure`: slow
        slides are excluded. Counting begins a window's length back, but not before the touch.
        """
        if disturbed:
            self._since_ns, self.lasts_ns = None, 0
            return
        since_ns = self._since_ns
        if since_ns is None:
            since_ns = max(t_ns - SHORT_NS, self._touched_ns)
        if is_sure:
            since_ns = min(since_ns, max(t_ns - LONG_NS, self._touched_ns))
        else:
            since_ns = max(since_ns, t_ns - JUST_SHORT_NS)
        self._since_ns, self.lasts_ns = since_ns, max(t_ns - since_ns, 0)

    def settle(self) -> None:
        """Use the loose limit from now on if slow slides are excluded."""
        self.sure = self.sure or self.lasts_ns >= LONG_NS

    def unsettle(self) -> None:
        """Have the grasp settle again by the strict limit."""
        self.sure = self.early = False
        self.moved_since_ns = None

    def restart(self, t_ns: int) -> None:
        """Start to count stillness again at a reading of `t_ns`, whose time may have gone back."""
        self._since_ns, self.lasts_ns = None, 0
        self._touched_ns = min(self._touched_ns, t_ns)


class Question:
    """Says when the network must judge: the controller asks, or the verdict grows old."""

    def __init__(self, on_request: bool, lasts_ns: int) -> None:
        """`on_request`: settled grasps are first judged when asked for. `lasts_ns`: time until a
        question is dropped, ns."""
        self._on_request = on_request
        self._lasts_ns = lasts_ns
        self.asked = False
        """True while the controller waits for a judgement."""
        self._until_ns: int | None = None
        """Time at which the question is dropped, ns. None: no reading came since the question."""
        self._judged_ns = 0
        """Time of the last judgement."""

    def ask(self) -> None:
        """Note a question of the controller. Its timeout runs from the next reading on."""
        self.asked, self._until_ns = True, None

    def follow(self, t_ns: int) -> None:
        """Drop the question if it has timed out by `t_ns`. Call it while `asked`."""
        if self._until_ns is None:
            self._until_ns = t_ns + self._lasts_ns
        elif t_ns > self._until_ns:
            self.asked = False

    @property
    def is_asked(self) -> bool:
        """True if a settled grasp is to be judged."""
        return self.asked or not self._on_request

    def is_due(self, t_ns: int, fresh: bool) -> bool:
        """Return True if a judged grasp is to be judged again by the reading of `t_ns`.

        `fresh`: each usable electrode has three fresh values.
        """
        age_ns = t_ns - self._judged_ns
        return age_ns > STANDS_NS or (fresh and (self.asked or age_ns >= REFRESH_NS))

    def answer(self, t_ns: int, *, first: bool) -> bool:
        """Note a judgement at `t_ns`, the `first` after settling or a later one.

        Return True for the first, and with `on_request` if it answers a question; else False.
        """
        answers = first or (self.asked and self._on_request)
        self._judged_ns, self.asked = t_ns, False
        return answers

    def restart(self) -> None:
        """Restart the timeout of a question at the next reading. Call it where time went back."""
        self._until_ns = None


class Gate:
    """State machine of one hand's grasps: says which reading of a grasp is to be judged."""

    def __init__(self, fingers: Sequence[Finger], limits: HandLimits, motion: Motion) -> None:
        """`fingers`: the rows of a reading. `motion`: their motion, which the caller updates."""
        required = fingers if limits.required is None else limits.required
        self._fingers = tuple(fingers)
        self.required = frozenset(fingers).intersection(required)
        """Fingers that must touch."""
        self._settles_ns = SHORT_NS if limits.gate.early else LONG_NS
        self._motion = motion
        self.phase, self._still = Phase(), Stillness()
        self._question = Question(limits.on_request, limits.gate.request_ns)
        self._reference = np.zeros((len(fingers), ELECTRODES), dtype=np.float32)
        """Counts at the first judgement after settling, shape (fingers, 24); meaningless before."""
        self._last_ns: int | None = None
        """Time of the last reading."""
        self._opened_ns = 0
        """Time of the end of the last touch."""
        self._objections: tuple[Reason, ...] = (Reason.NO_CONTACT,)
        """Reasons of the last reading against settling."""
        unknown: dict[Finger, float | None] = dict.fromkeys(fingers)
        self._not_looked = unknown, dict.fromkeys(fingers, 1.0)

    def ask(self) -> None:
        """Ask for a judgement. The request is dropped if no grasp settles in `request_ns` from the
        next reading."""
        self._question.ask()

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
        """Take in a reading of `t_ns`, after `motion` has; return the state of the grasp.

        `median`: counts, shape (fingers, 24). `usable`: electrodes that can be used, same shape;
        None: all. `objections` of other parts, such as moving joints, keep the grasp from settling.
        `in_time`: the reading is not late; only then it is judged. `fresh`: each usable electrode
        has three fresh values (`FreshMedian`); else the reading is judged only if the verdict is
        older than `STANDS_NS`. `fingers` goes into the moment as it is.
        """
        phase, still, motion = self.phase, self._still, self._motion
        self._last_ns = t_ns
        if self._question.asked:
            self._question.follow(t_ns)
        still.touch(t_ns, self.required.issubset(touching))
        limits = motion.loose if still.sure else motion.strict
        reasons = self._disturbances(objections, limits)
        still.follow(t_ns, bool(reasons), limits.sure)
        self._follow_contact(t_ns, bool(touching))
        is_still = still.lasts_ns >= self._settles_ns
        if phase.state is GateState.JUDGED:
            reasons += self._follow_judged(t_ns, median, usable, limits)
        elif phase.state is GateState.SETTLED and (reasons or not is_still):
            self._go(ways.MOVED if still.touches else ways.LET_GO, t_ns)
        elif phase.state is GateState.CLOSING and not reasons and is_still:
            self._go(ways.STILL, t_ns)
        if phase.state is GateState.CLOSING and not reasons:
            reasons = (Reason.MOVING if motion.slides else Reason.SETTLING,)
        self._objections = reasons
        judges = judged = False
        if in_time and not reasons and self._is_due(t_ns, fresh):
            judges, judged = True, self._judge(t_ns, median)
        return self.moment(touching, fingers, judges=judges, judged=judged)

    def moment(
        self,
        touching: tuple[Finger, ...],
        fingers: dict[Finger, FingerState | None] | None = None,
        *,
        judges: bool = False,
        judged: bool = False,
    ) -> Moment:
        """Return the state of the grasp, with the changes of the gate since the last call.

        The arguments go into the moment as they are.
        """
        phase, still = self.phase, self._still
        is_judged, reasons = phase.state is GateState.JUDGED, self._objections
        if not (reasons or is_judged):
            is_asked = still.early or self._question.is_asked
            reasons = (Reason.SETTLING if is_asked else Reason.NOT_ASKED,)
        changes, phase.changes = phase.changes, []
        looked, strict = self._motion.looked, self._motion.strict
        motion, motion_limits = self._nearest_to_limit() if looked else self._not_looked
        return Moment(
            grasp=phase.grasp,
            state=phase.state,
            judges=judges,
            judged=judged,
            in_contact=still.touches,
            settled=is_judged and not reasons,
            reasons=reasons,
            touching=touching,
            changes=tuple(changes),
            still_ms=still.lasts_ns / 1e6,
            early=is_judged and still.early,
            steady=strict.early if still.early else strict.sure,
            motion=motion,
            motion_limits=motion_limits,
            fingers=fingers,
        )

    def restart(self, t_ns: int) -> None:
        """Have the grasp settle again, and forget the motion.

        Call it before the next reading, of `t_ns`, if readings are missing or time went back.
        """
        if self._last_ns is not None and t_ns < self._last_ns:
            self._opened_ns = t_ns
            self._question.restart()
        self._last_ns = t_ns
        self._still.restart(t_ns)
        self._motion.reset()
        self._objections = (Reason.SEQUENCE_GAP,)
        self._go(ways.GAP, t_ns)

    def _go(self, way: Transition, t_ns: int) -> None:
        if self.phase.take(way, t_ns):
            if way.to in (GateState.SETTLED, GateState.JUDGED):
                self._still.settle()
            else:
                self._still.unsettle()

    def _disturbances(
        self, objections: tuple[Reason, ...], limits: MotionLimits
    ) -> tuple[Reason, ...]:
        if not self._still.touches:
            not_tared = (Reason.NOT_TARED,) if Reason.NOT_TARED in objections else ()
            return (*not_tared, Reason.NO_CONTACT)
        if not self._motion.known:
            return (*objections, Reason.SEQUENCE_GAP)
        return objections if limits.early else (*objections, Reason.MOVING)

    def _follow_contact(self, t_ns: int, touches: bool) -> None:
        phase = self.phase
        if phase.state is GateState.RELEASED and t_ns - self._opened_ns >= RELEASE_NS:
            self._go(ways.FORGOTTEN, t_ns)
        if touches and phase.state in ways.TOUCHED.states:
            phase.grasp += 1
            self._go(ways.TOUCHED, t_ns)
        elif not touches and phase.state in ways.OPENED.states:
            self._opened_ns = t_ns
            self._go(ways.OPENED, t_ns)

    def _follow_judged(
        self,
        t_ns: int,
        median: NDArray[np.uint16],
        usable: NDArray[np.bool_] | None,
        limits: MotionLimits,
    ) -> tuple[Reason, ...]:
        """Leave `judged` if one of its transitions is due; return further reasons against a
        verdict now: `MOVING` if only the slow motion is too large."""
        still = self._still
        if not still.touches:
            self._go(ways.LET_GO, t_ns)
            return ()
        # Whole numbers below 2**16: float32 adds 24 of them exactly.
        distance = np.abs(median.astype(np.float32) - self._reference)
        if usable is not None:
            distance *= usable * (ELECTRODES / np.maximum(usable.sum(axis=1, keepdims=True), 1))
        if max(distance.dot(ONES).tolist()) > CHANGE_COUNTS * ELECTRODES:
            self._go(ways.CHANGED, t_ns)
            return ()
        if limits.early if still.early else limits.sure:
            still.moved_since_ns = None
            if still.early and still.lasts_ns >= LONG_NS:
                self._go(ways.SURE, t_ns)
            return ()
        if still.moved_since_ns is None:
            still.moved_since_ns = t_ns
        elif t_ns - still.moved_since_ns >= 2 * LONG_NS:
            self._go(ways.MOVED, t_ns)
        return (Reason.MOVING,) if limits.early else ()

    def _is_due(self, t_ns: int, fresh: bool) -> bool:
        """Return True if this reading is the one to judge; `fresh`: as of `step`."""
        if self.phase.state is GateState.JUDGED:
            return self._question.is_due(t_ns, fresh)
        is_asked = self._still.early or self._question.is_asked
        return fresh and is_asked and self.phase.state is GateState.SETTLED

    def _judge(self, t_ns: int, median: NDArray[np.uint16]) -> bool:
        """Enter `judged`, or stay there; return False if this only refreshes the verdict."""
        first = self.phase.state is not GateState.JUDGED
        if first:
            # A later judgement keeps it. Otherwise a grasp that creeps would never count as
            # changed.
            self._reference = median.astype(np.float32)
            self._still.early = self._still.lasts_ns < LONG_NS
            self._still.moved_since_ns = None
            self._go(ways.ANSWERED, t_ns)
        return self._question.answer(t_ns, first=first)

    def _nearest_to_limit(self) -> tuple[dict[Finger, float | None], dict[Finger, float]]:
        """Return each finger's motion and limit in the window whose motion is nearer to its limit.

        None: the motion is not known.
        """
        motion: dict[Finger, float | None] = {}
        limits: dict[Finger, float] = {}
        now, most = self._motion, self._motion.loose if self._still.sure else self._motion.strict
        windows = now.fast, most.fast, now.slow, most.slow
        for finger, moves, limit, slides, slide_limit in zip(self._fingers, *windows, strict=True):
            if slides < math.inf and slides * limit > moves * slide_limit:
                moves, limit = slides, slide_limit
            # This takes a third of the time of `round` to two digits.
            motion[finger] = round(100.0 * moves) / 100.0 if moves < math.inf else None
            limits[finger] = round(100.0 * limit) / 100.0
        return motion, limits
