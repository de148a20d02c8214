"""The gate: the moment between "the fingers have closed" and "the hand lifts", as a state machine.

    idle -> closing -> settled -> judged
              ^           |         |     moved, changed, lost a finger, or a gap in the readings:
              +-----------+---------+     back to closing
    closing, settled, judged -> released -> idle   (or, touched at once again, -> closing)

A grasp begins with the first touch and ends when nothing touches any more. It is judged when all
fingers touch and everything has kept still for so long that nothing can slide unseen; where `early`
is wanted, first as soon as nothing moves fast. From then on it is judged anew, without leaving
`judged`, many times a second and when somebody asks. When it has changed or moved on it must settle
anew. Times are those of the readings, so a stall or a burst of old readings settles nothing.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from daemon.judge.limits import GateLimits
from daemon.judge.reasons import GateCause, GateChange, GateState, Reason
from daemon.judge.stillness import Motion, mean_distance
from daemon.judge.windows import LONG_NS, SHORT_NS
from drivers.base import ELECTRODES

RENEWED_NS = 50_000_000
"""A standing verdict is judged anew when it is so old, ns: half of what it may be, so that it never
is older, however slow the readings are, and though one of them is lost."""
STANDS_NS = 100_000_000
"""A verdict does not stand longer without being judged anew, ns."""
CHANGES_MAX = 64
"""Changes kept until somebody takes them; a reading makes three at most."""


@dataclass(slots=True, eq=False)
class GateMemory:
    """The grasp at hand; but changes that nobody took yet are not for another judge to tell."""

    reference: NDArray[np.float32]
    """Shape (fingers, 24): counts where it had settled; means nothing before."""
    judged_ns: int = 0
    """When it was judged last."""
    last_ns: int | None = None
    """Time of the last reading."""
    touched_ns: int = 0
    """Since when all required fingers touch, if they do."""
    still_since_ns: int | None = None
    """Since when touch and stillness have lasted, as far as that can be told; None if something
    moves."""
    moved_since_ns: int | None = None
    """Since when a judged grasp has moved; None if it does not."""
    early: bool = False
    """Whether a grasp that was judged had then only not moved fast: the sure one comes unasked."""
    released_ns: int = 0
    """When nothing touched any more."""
    asked: bool = False
    """Whether somebody waits for a judgement."""
    asked_until_ns: int | None = None
    """None until the first reading after the question."""
    state: GateState = GateState.IDLE
    grasp: int = 0
    """Touches so far; the number of the grasp at hand."""
    in_contact: bool = False
    """Whether all required fingers touch."""
    against: tuple[Reason, ...] = (Reason.NO_CONTACT,)
    """What the last reading said against settling."""


class Gate:
    """Follows the grasps of one hand."""

    def __init__(
        self, required: NDArray[np.bool_], limits: GateLimits, *, on_request: bool = False
    ) -> None:
        """`required`, shape (fingers,), are the fingers that must touch.

        With `on_request` a settled grasp waits until somebody asks.
        """
        self._required: list[int] = np.flatnonzero(required).tolist()
        self._limits = limits
        self._on_request = on_request
        self.motion = Motion(len(required), limits.false_alarms, early=limits.early)
        self.memory = GateMemory(np.zeros((len(required), ELECTRODES), dtype=np.float32))
        self._changes: list[GateChange] = []

    @property
    def state(self) -> GateState:
        """Where in a grasp the hand is."""
        return self.memory.state

    @property
    def grasp(self) -> int:
        """Number of the grasp at hand, from 1; 0 before the first."""
        return self.memory.grasp

    @property
    def in_contact(self) -> bool:
        """Whether all required fingers touch."""
        return self.memory.in_contact

    @property
    def still_ns(self) -> int:
        """For how long the hand has touched and kept still, ns; 0 if something moves.

        Less than the long window as long as something may slide slowly.
        """
        memory = self.memory
        if memory.still_since_ns is None or memory.last_ns is None:
            return 0
        return max(memory.last_ns - memory.still_since_ns, 0)

    @property
    def early(self) -> bool:
        """Whether the grasp was judged while something might still slide slowly."""
        return self.memory.state is GateState.JUDGED and self.memory.early

    @property
    def settled(self) -> bool:
        """Whether the grasp at hand has settled, was judged, and still keeps still."""
        return self.memory.state is GateState.JUDGED and not self.memory.against

    @property
    def reasons(self) -> tuple[Reason, ...]:
        """Why it is not so; none if it is."""
        if self.memory.against or self.memory.state is GateState.JUDGED:
            return self.memory.against
        return (Reason.SETTLING if self._is_asked else Reason.NOT_ASKED,)

    @property
    def wants_judgement(self) -> bool:
        """Whether the reading at hand is the one to judge."""
        memory = self.memory
        if memory.against:
            return False
        if memory.state is GateState.JUDGED:
            return memory.asked or self._judged_before_ns >= RENEWED_NS
        return memory.state is GateState.SETTLED and self._is_asked

    @property
    def renews(self) -> bool:
        """Whether to judge now only keeps a verdict new that stands already."""
        asked = self.memory.asked and self._on_request
        return self.memory.state is GateState.JUDGED and not asked

    @property
    def overdue(self) -> bool:
        """Whether the verdict of a judged grasp is too old to stand: judge what there is."""
        return self.memory.state is GateState.JUDGED and self._judged_before_ns > STANDS_NS

    @property
    def _is_asked(self) -> bool:
        return self.memory.asked or self.memory.early or not self._on_request

    @property
    def _judged_before_ns(self) -> int:
        """How long before the last reading the grasp was judged, ns."""
        return (self.memory.last_ns or 0) - self.memory.judged_ns

    def ask(self) -> None:
        """The controller wants a judgement of what settles within `request_ns` of the next reading.

        A grasp that was judged is judged again.
        """
        self.memory.asked = True
        self.memory.asked_until_ns = None

    def judged(self, t_ns: int, median: NDArray[np.uint16]) -> None:
        """The grasp was judged, by the reading of `t_ns` with these counts; maybe anew.

        It is still the same as long as it is near to where it settled, and not to where it was
        judged last: what creeps would never be another.
        """
        self.memory.judged_ns = t_ns
        self.memory.asked = False
        if self.memory.state is GateState.JUDGED:
            return
        self.memory.reference = median.astype(np.float32)
        self.memory.early = self.still_ns < LONG_NS
        self.memory.moved_since_ns = None
        self._enter(GateState.JUDGED, t_ns, GateCause.JUDGED)

    def take_changes(self) -> list[GateChange]:
        """Changes since the last call, oldest first."""
        changes, self._changes = self._changes, []
        return changes

    def skip(self, t_ns: int) -> None:
        """Take in the time of a reading that cannot be used, ns."""
        last_ns = self.memory.last_ns
        if last_ns is not None and not 0 <= t_ns - last_ns <= self._limits.gap_ns:
            self.restart(t_ns)

    def step(
        self,
        t_ns: int,
        counts: NDArray[np.uint16],
        median: NDArray[np.uint16],
        usable: NDArray[np.bool_],
        touching: NDArray[np.bool_],
        against: tuple[Reason, ...] = (),
    ) -> None:
        """Take in one usable reading of `t_ns`, its `FreshMedian` and which fingers touch.

        `against` speaks against settling for reasons of others: no tare, joints that move.
        """
        memory = self.memory
        self.skip(t_ns)
        memory.last_ns = t_ns
        self._follow_question(t_ns)
        touches = touching.tolist()
        in_contact = all(touches[finger] for finger in self._required)
        self.motion.add(t_ns, counts, usable, wanted=in_contact or any(touches))
        if in_contact and not memory.in_contact:
            memory.touched_ns = t_ns
        memory.in_contact = in_contact
        reasons = self._disturbances(against)
        self._follow_stillness(t_ns, bool(reasons))
        self._follow_contact(t_ns, any(touches))
        if memory.state is GateState.JUDGED:
            reasons += self._follow_judged(t_ns, median.astype(np.float32), usable)
        elif memory.state is GateState.SETTLED and (reasons or not self._is_still):
            cause = GateCause.MOVED if memory.in_contact else GateCause.CONTACT_LOST
            self._enter(GateState.CLOSING, t_ns, cause)
        memory.against = (*reasons, *self._settle(t_ns, bool(reasons)))

    def _follow_question(self, t_ns: int) -> None:
        memory = self.memory
        if not memory.asked:
            return
        if memory.asked_until_ns is None:
            memory.asked_until_ns = t_ns + self._limits.request_ns
        elif t_ns > memory.asked_until_ns:
            memory.asked = False

    def _disturbances(self, against: tuple[Reason, ...]) -> tuple[Reason, ...]:
        if not self.memory.in_contact:
            return (
                *(reason for reason in against if reason is Reason.NOT_TARED),
                Reason.NO_CONTACT,
            )
        if not self.motion.known:
            return (*against, Reason.SEQUENCE_GAP)
        return against if self.motion.early else (*against, Reason.MOVING)

    @property
    def _is_still(self) -> bool:
        """Whether it is for long enough to judge."""
        return self.still_ns >= (SHORT_NS if self._limits.early else LONG_NS)

    def _follow_stillness(self, t_ns: int, disturbed: bool) -> None:
        """The windows say for how long nothing has moved; the touch must have lasted as long."""
        memory = self.memory
        if disturbed:
            memory.still_since_ns = None
            return
        since_ns = memory.still_since_ns
        if since_ns is None:
            since_ns = max(t_ns - SHORT_NS, memory.touched_ns)
        if self.motion.sure:
            since_ns = min(since_ns, max(t_ns - LONG_NS, memory.touched_ns))
        else:
            since_ns = max(since_ns, t_ns - LONG_NS + 1_000_000)  # a ms short of it
        memory.still_since_ns = since_ns

    def _follow_contact(self, t_ns: int, touches: bool) -> None:
        memory, release_ns = self.memory, self._limits.release_ns
        if memory.state is GateState.RELEASED and t_ns - memory.released_ns >= release_ns:
            self._enter(GateState.IDLE, t_ns, GateCause.TIME)
        if touches and memory.state in (GateState.IDLE, GateState.RELEASED):
            memory.grasp += 1
            self._enter(GateState.CLOSING, t_ns, GateCause.CONTACT)
        if not touches and memory.state not in (GateState.IDLE, GateState.RELEASED):
            memory.released_ns = t_ns
            self._enter(GateState.RELEASED, t_ns, GateCause.CONTACT_LOST)

    def _follow_judged(
        self, t_ns: int, counts: NDArray[np.float32], usable: NDArray[np.bool_]
    ) -> tuple[Reason, ...]:
        """Whether the judged grasp is still the same; what else is against it."""
        memory = self.memory
        if not memory.in_contact:
            self._enter(GateState.CLOSING, t_ns, GateCause.CONTACT_LOST)
            return ()
        distance = mean_distance(counts, memory.reference, usable)
        if max(distance.tolist()) > self._limits.change_counts:
            self._enter(GateState.CLOSING, t_ns, GateCause.CHANGED)
            return ()
        if self.motion.early if memory.early else self.motion.sure:
            memory.moved_since_ns = None
            if memory.early and self.still_ns >= LONG_NS:
                self._enter(GateState.SETTLED, t_ns, GateCause.STILL)
            return ()
        if memory.moved_since_ns is None:
            memory.moved_since_ns = t_ns
        elif t_ns - memory.moved_since_ns >= 2 * LONG_NS:
            self._enter(GateState.CLOSING, t_ns, GateCause.MOVED)
        return (Reason.MOVING,) if self.motion.early else ()

    def _settle(self, t_ns: int, disturbed: bool) -> tuple[Reason, ...]:
        """Settle once everything is still; what speaks against it besides what disturbs."""
        if disturbed or self.memory.state is not GateState.CLOSING:
            return ()
        if not self._is_still:
            return (Reason.MOVING if self.motion.slides else Reason.SETTLING,)
        self._enter(GateState.SETTLED, t_ns, GateCause.STILL)
        return ()

    def restart(self, t_ns: int) -> None:
        """Have the grasp settle anew: readings are missing, or time went back."""
        memory = self.memory
        if memory.last_ns is not None and t_ns < memory.last_ns:
            memory.released_ns = t_ns
            memory.asked_until_ns = None
        memory.last_ns = t_ns
        memory.still_since_ns = None
        memory.touched_ns = min(memory.touched_ns, t_ns)
        self.motion.reset()
        memory.against = (Reason.SEQUENCE_GAP,)
        if memory.state in (GateState.SETTLED, GateState.JUDGED):
            self._enter(GateState.CLOSING, t_ns, GateCause.GAP)

    def _enter(self, state: GateState, t_ns: int, cause: GateCause) -> None:
        memory = self.memory
        if len(self._changes) < CHANGES_MAX:
            self._changes.append(GateChange(t_ns, memory.grasp, memory.state, state, cause))
        memory.state = state
        if state not in (GateState.SETTLED, GateState.JUDGED):
            memory.early, memory.moved_since_ns = False, None
