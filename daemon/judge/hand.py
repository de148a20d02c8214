"""One hand, reading by reading: median of fresh values, contact, joints and gate.

One value in a hundred is a spike, 25 to 150 counts deep. A palm repeats 2 of 7 values at 100 Hz.
The median of three fresh values removes spikes, and delays by one sweep.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import compress
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from graspd.biotac import ELECTRODES, Finger
from graspd.daemon.judge.contact import Contact
from graspd.daemon.judge.decision import HandLimits
from graspd.daemon.judge.gate import Gate
from graspd.daemon.judge.health import NO_COUNT, Checked
from graspd.daemon.judge.reasons import OPEN, FingerState, GateState, Moment, Reason
from graspd.daemon.judge.stillness import Motion
from graspd.drivers.base import JointReading

if TYPE_CHECKING:
    from graspd.daemon.judge.joint_motion import JointMotion

MEDIAN_SWEEPS = 3
"""Fresh sweeps whose median is judged: a value that is wrong in one of them does not count."""
GAP_NS = 100_000_000
"""Time without a usable reading after which the grasp must settle again, ns. No verdict rests on
readings with a longer silence between them."""
OUTAGE_NS = 1_000_000_000
"""Time without a usable reading after which tare and noise are forgotten, ns.

The sensors may have been exchanged or switched off. The same holds where time goes back by more.
"""
SLIDE_AFTER_NS = 20_000_000
"""Time for which a still finger must move before its state is `slide`, ns.

A real hold passes the limit of motion for moments; a quarter of them are shorter.
"""


class FreshMedian:
    """Median of each electrode's last three fresh values; repeated ones are not fresh."""

    def __init__(self, shape: tuple[int, int]) -> None:
        """`shape` is (fingers, 24)."""
        self.counts = np.zeros(shape, dtype=np.uint16)
        """Median of the last three fresh values, shape (fingers, 24); 0 where none ever was."""
        self._fresh = np.zeros((MEDIAN_SWEEPS, *shape), dtype=np.uint16)
        """The last three fresh values, oldest first, shape (3, fingers, 24)."""
        self._last = np.full(shape, NO_COUNT, dtype=np.uint16)
        """The last value of each electrode, fresh or not."""
        self._held = np.zeros(shape, dtype=np.bool_)
        """True where the last value repeated the one before."""
        self._number = np.zeros(shape, dtype=np.uint8)
        """Number of fresh values in `_fresh`, up to three."""
        self._all_full = False
        """True if `_number` is three for all electrodes."""

    def reset(self) -> None:
        """Forget everything: what comes next does not continue what came before."""
        self._last = np.full_like(self._last, NO_COUNT)
        self._held.fill(False)
        self._number.fill(0)
        self._all_full = False

    def push(self, counts: NDArray[np.uint16], usable: NDArray[np.bool_] | None) -> None:
        """Take in one sweep, shape (fingers, 24).

        `usable`: False for electrodes to ignore, whose fresh values are forgotten; None: all can
        be used. A value that repeats the last one is not fresh. A third equal value is fresh,
        because data of a palm at 71.43 Hz never repeat twice.
        """
        oldest, middle, newest = self._fresh
        fresh = (counts != self._last) | self._held
        self._held = ~fresh
        if usable is not None:
            fresh &= usable
        np.putmask(oldest, fresh, middle)
        np.putmask(middle, fresh, newest)
        np.putmask(newest, fresh, counts)
        if usable is not None or not self._all_full:
            self._fill(counts, usable, fresh)
        self._last = counts if usable is None else np.where(usable, counts, self._last)
        low, high = np.minimum(oldest, middle), np.maximum(oldest, middle)
        self.counts = np.maximum(low, np.minimum(high, newest))

    def is_full(self, usable: NDArray[np.bool_] | None) -> bool:
        """Return True if each `usable` electrode (None: all) has three fresh values.

        They are counted since a `reset`, and since the electrode was last not usable.
        """
        if self._all_full or usable is None:
            return self._all_full
        return bool((self._number[usable] == MEDIAN_SWEEPS).all())

    def _fill(
        self,
        counts: NDArray[np.uint16],
        usable: NDArray[np.bool_] | None,
        fresh: NDArray[np.bool_],
    ) -> None:
        """Count each electrode's fresh values; the first one stands for those still missing."""
        if usable is not None:
            self._number[~usable] = 0
        first = fresh & (self._number == 0)
        np.copyto(self._fresh, counts, where=first)
        self._number += fresh & (self._number < MEDIAN_SWEEPS)
        self._all_full = bool((self._number == MEDIAN_SWEEPS).all())


@dataclass(slots=True)
class FingerWord:
    """Finds the state of one finger by its motion in the current touch."""

    was_still: bool = False
    """True if the finger has kept still at some time of this touch."""
    moves_since_ns: int | None = None
    """Time since which the finger moves. None: it does not."""

    def touch(self, t_ns: int, moves: bool | None) -> FingerState | None:
        """Return the state at `t_ns` of a finger that touches; None if `moves` is None.

        `moves`: True if it moves more than a finger that holds; None: not known.
        """
        if moves is None:
            self.let_go()
            return None
        if not moves:
            self.was_still, self.moves_since_ns = True, None
            return FingerState.TOUCH
        if self.moves_since_ns is None:
            self.moves_since_ns = t_ns
        is_short = 0 <= t_ns - self.moves_since_ns < SLIDE_AFTER_NS
        return FingerState.TOUCH if self.was_still and is_short else FingerState.SLIDE

    def let_go(self) -> None:
        """Forget the touch."""
        self.was_still, self.moves_since_ns = False, None


class HandTracker:
    """Follows contact, joints and gate of one hand, and says when a grasp is to be judged."""

    def __init__(self, fingers: Sequence[Finger], limits: HandLimits) -> None:
        """`fingers`: the rows of a reading."""
        self._fingers = tuple(fingers)
        self._fresh = FreshMedian((len(fingers), ELECTRODES))
        self._contact = Contact(len(fingers))
        self._joints: JointMotion | None = None
        if limits.joints:
            from graspd.daemon.judge.joint_motion import JointMotion  # only where it is needed

            self._joints = JointMotion()
        self.on_request = limits.on_request
        self.motion = Motion(len(fingers), limits.gate.false_alarms, early=limits.gate.early)
        self.gate = Gate(fingers, limits, self.motion)
        self._words = [FingerWord() for _ in fingers]
        self._last_ns: int | None = None
        """Time of the last usable reading."""
        self._interrupted = False
        """True if readings are missing before the next one."""

    @property
    def tared(self) -> tuple[Finger, ...]:
        """Fingers whose baseline is known."""
        return self._named(self._contact.tared)

    @property
    def state(self) -> GateState:
        """State of the gate."""
        return self.gate.phase.state

    @property
    def grasp(self) -> int:
        """Number of the current grasp; 0 before the first."""
        return self.gate.phase.grasp

    def read_rest(self) -> NDArray[np.float64]:
        """Return the resting counts, shape (fingers, 24); 0: not known."""
        contact = self._contact
        known = np.isfinite(contact.baseline) & np.array(contact.tared)[:, np.newaxis]
        return np.where(known, contact.baseline, 0.0)

    def health(self) -> dict[str, Reason]:
        """Return the current problem of each finger without a tare, and of `joints`."""
        tared, joints, last_ns = self.tared, self._joints, self._last_ns
        findings: dict[str, Reason] = {
            finger: Reason.NOT_TARED for finger in self._fingers if finger not in tared
        }
        if joints is not None and joints.is_frozen:
            findings["joints"] = Reason.JOINTS_FROZEN
        elif joints is not None and last_ns is not None and joints.misses_some(last_ns):
            findings["joints"] = Reason.JOINTS_LATE
        return findings

    def forget(self) -> None:
        """Forget tare and noise, so that the grasp ends with the next usable reading. Call when
        sensors were exchanged, or may have been."""
        self._contact.forget()
        self.motion.forget()
        self._fresh.reset()
        self.restart()

    def count_from(self, grasp: int) -> None:
        """Give the next grasp the number `grasp` + 1, unless a grasp is held now."""
        if self.gate.phase.state in OPEN:
            self.gate.phase.grasp = grasp

    def ask(self) -> None:
        """Ask for a judgement of the current grasp once it has settled."""
        self.gate.ask()

    def restart(self) -> None:
        """Have the current grasp settle again, from the last reading on."""
        if self._last_ns is not None:
            self.gate.restart(self._last_ns)

    def interrupt(self) -> None:
        """Have the current grasp settle again. Call when readings before the next are missing."""
        self._interrupted = True

    def observe_joints(self, reading: JointReading) -> None:
        """Take in joint angles."""
        if self._joints is not None:
            self._joints.observe(reading)

    def step(
        self,
        t_ns: int,
        counts: NDArray[np.uint16],
        checked: Checked,
        *,
        in_time: bool = True,
    ) -> tuple[Moment, NDArray[np.uint16] | None]:
        """Take in the counts of a reading, shape (fingers, 24), made at `t_ns`.

        `checked`: result of `Health.check`. `in_time`: False if the reading is late. Return the
        state of the grasp and the counts to judge; None in their place: judge nothing.
        """
        if checked.reasons:
            if self._is_after_gap(t_ns):
                self.gate.restart(t_ns)
            return self._now(), None
        self._follow_time(t_ns)
        usable = None if checked.broken is None else ~checked.broken
        self._fresh.push(counts, usable)
        median, fresh = self._fresh.counts, self._fresh.is_full(usable)
        self._contact.observe(t_ns, counts, median, usable)
        touching = self._contact.touching
        objections = () if self.gate.required.issubset(self.tared) else (Reason.NOT_TARED,)
        joints = None if self._joints is None else self._joints.objection(t_ns)
        if joints is not None:
            objections = (*objections, joints)
        self.motion.add(t_ns, counts, usable, wanted=any(touching) or not self.gate.required)
        moment = self.gate.step(
            t_ns,
            median,
            usable,
            self._named(touching),
            objections,
            fingers=self._feel(t_ns),
            in_time=in_time,
            fresh=fresh,
        )
        return moment, median if moment.judges else None

    def silent(self) -> Moment:
        """Return the state of the grasp when no reading comes; its motion is not known."""
        return self._now()._replace(still_ms=None, motion=None, motion_limits=None)

    def _now(self) -> Moment:
        touching = self._named(self._contact.touching)
        return self.gate.moment(touching, dict.fromkeys(self._fingers))

    def _feel(self, t_ns: int) -> dict[Finger, FingerState | None]:
        """Return the state of each finger at the reading just observed; None: not known."""
        motion, loose, contact = self.motion, self.motion.loose, self._contact
        feelings: dict[Finger, FingerState | None] = {}
        for place, finger in enumerate(self._fingers):
            word = self._words[place]
            if not contact.touching[place]:
                word.let_go()
                feelings[finger] = FingerState.FREE if contact.tared[place] else None
                continue
            fast, slow = motion.fast[place], motion.slow[place]
            is_known = fast < math.inf and slow < math.inf
            if loose.fast[place] < fast < math.inf or loose.slow[place] < slow < math.inf:
                feelings[finger] = word.touch(t_ns, True)
            else:  # all motion that is known is within its limit
                feelings[finger] = word.touch(t_ns, False if is_known else None)
        return feelings

    def _follow_time(self, t_ns: int) -> None:
        """Have the grasp settle again if the usable reading of `t_ns` comes after a gap or after
        `interrupt`; after an outage, forget the tare and the noise too."""
        last_ns = self._last_ns
        if last_ns is not None and not -OUTAGE_NS <= t_ns - last_ns <= OUTAGE_NS:
            self._contact.forget()
            self.motion.forget()
        if self._interrupted or self._is_after_gap(t_ns):
            self._interrupted = False
            self._fresh.reset()
            self.gate.restart(t_ns)
        self._last_ns = t_ns

    def _is_after_gap(self, t_ns: int) -> bool:
        """Return True if a reading of `t_ns` does not continue the last usable one."""
        return self._last_ns is not None and not 0 <= t_ns - self._last_ns <= GAP_NS

    def _named(self, which: list[bool]) -> tuple[Finger, ...]:
        return tuple(compress(self._fingers, which))
