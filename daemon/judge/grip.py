"""How the hand holds: fresh values, contact, joints and gate of one hand, reading by reading."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import compress
from typing import TYPE_CHECKING, Annotated, Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from daemon.judge.contact import Contact
from daemon.judge.findings import Felt, Watched, all_of
from daemon.judge.gate import Gate
from daemon.judge.limits import MEDIAN_SWEEPS, GripLimits
from daemon.judge.median import FreshMedian
from daemon.judge.reasons import GateChange, GateState, Reason
from drivers.base import ELECTRODES, JointReading, TactileReading
from models.contract import Finger

if TYPE_CHECKING:
    from daemon.judge.joint_motion import JointMotion

OUTAGE_NS = 1_000_000_000
"""After so long without a usable reading the sensors may have been exchanged or powered anew."""


@dataclass(slots=True)
class GripMemory:
    """What its parts do not remember themselves."""

    last_ns: int | None = None
    """Time of the last usable reading."""
    unsettled: Annotated[int, msgspec.Meta(ge=0, le=MEDIAN_SWEEPS)] = 0
    """Readings to come whose median may be of values from before some that are missing."""


class Grip:
    """Follows contact, joints and gate of one hand, and says when a grasp is to be judged."""

    def __init__(self, fingers: Sequence[Finger], limits: GripLimits) -> None:
        """`fingers` are those of the readings, in their order."""
        required = fingers if limits.required is None else limits.required
        self.on_request = limits.on_request
        """Whether a settled grasp is judged only when somebody asks."""
        self._fingers = tuple(fingers)
        self._required = [place for place, finger in enumerate(fingers) if finger in required]
        self._gap_ns = limits.gate.gap_ns
        self._judges_median = limits.sweeps == MEDIAN_SWEEPS
        self._fresh = FreshMedian((len(fingers), ELECTRODES))
        self._contact = Contact(len(fingers), limits.contact)
        self._joints: JointMotion | None = None
        if limits.joints is not None:
            from daemon.judge.joint_motion import JointMotion  # only where it is needed

            self._joints = JointMotion(limits.joints)
        must_touch = np.array([finger in required for finger in fingers])
        self._gate = Gate(must_touch, limits.gate, on_request=limits.on_request)
        self.memory = GripMemory()
        nobody: dict[Finger, float | None] = dict.fromkeys(fingers)
        self._not_looked = nobody, dict.fromkeys(fingers, 1.0)

    @property
    def state(self) -> GateState:
        """State of the gate."""
        return self._gate.state

    @property
    def grasp(self) -> int:
        """Number of the grasp at hand, from 1; 0 before the first."""
        return self._gate.grasp

    @property
    def in_contact(self) -> bool:
        """Whether all required fingers touch."""
        return self._gate.in_contact

    @property
    def settled(self) -> bool:
        """Whether the grasp has settled, was judged, and still keeps still."""
        return self._gate.settled

    @property
    def reasons(self) -> tuple[Reason, ...]:
        """Why it has not."""
        return self._gate.reasons

    @property
    def renews(self) -> bool:
        """Whether to judge now only keeps a verdict new that stands already."""
        return self._gate.renews

    @property
    def touching(self) -> tuple[Finger, ...]:
        """Fingers that touch."""
        return self._names(self._contact.touching)

    @property
    def tared(self) -> tuple[Finger, ...]:
        """Fingers of which it is known where they rest."""
        return self._names(self._contact.tared)

    @property
    def joints_lost(self) -> bool:
        """Whether judging goes on without joint angles that should be there."""
        joints, last_ns = self._joints, self.memory.last_ns
        if joints is None or last_ns is None:
            return False
        return joints.is_lost(last_ns) or joints.some_lost

    @property
    def joints_frozen(self) -> bool:
        """Whether joint angles come that do not change by a bit."""
        return self._joints is not None and self._joints.is_frozen

    def ask(self) -> None:
        """Have the grasp at hand judged once it has settled; one that has, by the next reading."""
        self._gate.ask()

    def forget(self) -> None:
        """Forget tare and grasp: the sensors are others, or may be."""
        self._contact.forget()
        self._gate.motion.forget()
        self._fresh.reset()
        self.restart()

    def restart(self) -> None:
        """Let the grasp at hand settle anew, from the last reading on."""
        if self.memory.last_ns is not None:
            self._gate.restart(self.memory.last_ns)

    def interrupt(self) -> None:
        """Readings are missing before the next one: the grasp must settle anew."""
        self.memory.unsettled = MEDIAN_SWEEPS

    def memories(self) -> dict[str, dict[str, Any]]:
        """What the hand's parts remember, by the name of the part; see `Pipeline.memories`."""
        hand: dict[str, Any] = {
            "grip": self.memory,
            "fresh": self._fresh.memory,
            "contact": self._contact.memory,
            "gate": self._gate.memory,
            "motion": self._gate.motion.memory,
        }
        joints = {} if self._joints is None else {"joints": {"joints": self._joints.memory}}
        return {"hand": hand, **joints}

    def take_changes(self) -> list[GateChange]:
        """Changes of the gate since the last call, oldest first."""
        return self._gate.take_changes()

    def observe_joints(self, reading: JointReading) -> None:
        """Take in joint angles."""
        if self._joints is not None:
            self._joints.observe(reading, reading.made_ns)

    def observe(self, reading: TactileReading, watched: Watched) -> None:
        """Take in a reading of these fingers and what was found in it."""
        t_ns, last_ns = reading.made_ns, self.memory.last_ns
        if watched.reasons:
            self._gate.skip(t_ns)
            return
        if last_ns is not None and not 0 <= t_ns - last_ns <= self._gap_ns:
            self._fresh.reset()
            if t_ns - last_ns > OUTAGE_NS:
                self._contact.forget()
                self._gate.motion.forget()
        self.memory.last_ns = t_ns
        if self.memory.unsettled:
            self.memory.unsettled -= 1
            self._gate.restart(t_ns)
        usable = ~watched.broken
        self._fresh.push(reading.counts, usable)
        median = self._fresh.counts
        self._contact.observe(t_ns, reading.counts, median, usable)
        against = self._against(t_ns)
        self._gate.step(t_ns, reading.counts, median, usable, self._contact.touching, against)

    def counts_to_judge(
        self, reading: TactileReading, watched: Watched
    ) -> NDArray[np.uint16] | None:
        """Shape (fingers, 24), if this reading is the moment to judge the grasp; else None.

        That waits until all electrodes have three fresh values, but not for longer than a verdict
        may stand: where values get lost all the time, the newest ones are what there is.
        """
        gate, fresh = self._gate, self._fresh
        if not (gate.wants_judgement and (gate.overdue or fresh.is_full(~watched.broken))):
            return None
        return fresh.counts if self._judges_median else reading.counts

    def judged(self) -> None:
        """The grasp was judged by the last reading."""
        if self.memory.last_ns is not None:
            self._gate.judged(self.memory.last_ns, self._fresh.counts)

    def felt(self, counts: NDArray[np.uint16] | None, *, renews: bool = False) -> Felt:
        """How the hand holds now; `counts` are what is to be judged of it, shape (fingers, 24).

        `renews` says whether that only keeps a verdict new that stands already.
        """
        gate = self._gate
        return Felt(
            gate.grasp,
            counts,
            counts is not None and not renews,
            gate.in_contact,
            gate.settled,
            gate.reasons,
            gate.state,
            self.touching,
            tuple(gate.take_changes()),
            gate.still_ns,
            gate.early,
            *self._motion(),
        )

    def _motion(self) -> tuple[dict[Finger, float | None], dict[Finger, float]]:
        """How each finger moves in the window that shows more of it, and what it may there."""
        found: dict[Finger, float | None] = {}
        limits: dict[Finger, float] = {}
        now = self._gate.motion
        if not now.looked:
            return self._not_looked
        windows = now.fast, now.fast_limits, now.slow, now.slow_limits
        for finger, moves, limit, slides, its_limit in zip(self._fingers, *windows, strict=True):
            if slides < math.inf and slides * limit > moves * its_limit:
                moves, limit = slides, its_limit
            found[finger] = round(moves, 2) if moves < math.inf else None
            limits[finger] = round(limit, 2)
        return found, limits

    def _against(self, t_ns: int) -> tuple[Reason, ...]:
        against: list[Reason] = []
        tared = self._contact.tared
        if not all_of(tared) and not all_of(tared[self._required]):
            against.append(Reason.NOT_TARED)
        joints = None if self._joints is None else self._joints.against(t_ns)
        if joints is not None:
            against.append(joints)
        return tuple(against)

    def _names(self, which: NDArray[np.bool_]) -> tuple[Finger, ...]:
        return tuple(compress(self._fingers, which.tolist()))
