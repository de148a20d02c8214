"""The gate: the moment between "the fingers have closed" and "the hand lifts", as a state machine.

    idle -> closing -> settled -> judged
              ^           |         |     moved, changed, lost a finger, or a gap in the readings:
              +-----------+---------+     back to closing; asked again: from judged to settled
    closing, settled, judged -> released -> idle   (or, touched at once again, -> closing)

A grasp begins with the first touch and ends when nothing touches any more. It is judged once, when
all fingers touch and everything has kept still for the hold time, and again when it has changed.
Times are those of the readings, so a stall or a burst of old readings settles nothing.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from daemon.judge.reasons import GateCause, GateState, Reason
from daemon.judge.stillness import Stillness, mean_distance

CHANGES_MAX = 64
"""Changes kept until somebody takes them; a reading makes three at most."""


@dataclass(frozen=True, slots=True)
class GateLimits:
    """When a grasp has settled, and when it is another one. Times in ns, counts raw."""

    hold_ns: int = 60_000_000
    """Touch and stillness must last so long."""
    rate_window_ns: int = 80_000_000
    """Motion is the difference to the sweep so long ago."""
    rate_counts_per_s: float = 120.0
    """A finger whose electrodes change faster than this in the mean is moving. Three untouched
    sensors, whose noise counts as motion too, showed 75 at most in 9.8 s."""
    change_counts: float = 40.0
    """A finger whose electrodes are so far from where they were judged, in the mean, is another
    grasp."""
    gap_ns: int = 100_000_000
    """After so long without a usable reading the grasp must settle anew."""
    release_ns: int = 100_000_000
    """`released` lasts so long."""
    request_ns: int = 1_000_000_000
    """A request that cannot be met by then is dropped."""


@dataclass(frozen=True, slots=True)
class GateChange:
    """The gate went from one state to another."""

    t_ns: int
    """Time of the reading that made it, ns."""
    grasp: int
    former: GateState
    state: GateState
    cause: GateCause


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
        self._stillness = Stillness(limits.rate_window_ns, len(required))
        self._reference: NDArray[np.float32] | None = None
        self._last_ns: int | None = None
        self._held_since_ns: int | None = None
        self._released_ns = 0
        self._asked = False
        self._asked_until_ns: int | None = None
        """None until the first reading after the question."""
        self.state = GateState.IDLE
        self.grasp = 0
        """Touches so far; the number of the grasp at hand."""
        self.in_contact = False
        """Whether all required fingers touch."""
        self._against: tuple[Reason, ...] = (Reason.NO_CONTACT,)
        self._changes: list[GateChange] = []

    @property
    def settled(self) -> bool:
        """Whether the grasp at hand has settled, was judged, and still keeps still."""
        return self.state is GateState.JUDGED and not self._against

    @property
    def reasons(self) -> tuple[Reason, ...]:
        """Why it is not so; none if it is."""
        if self._against or self.state is GateState.JUDGED:
            return self._against
        return (Reason.SETTLING if self._is_asked else Reason.NOT_ASKED,)

    @property
    def wants_judgement(self) -> bool:
        """Whether the reading at hand is the one to judge."""
        return self.state is GateState.SETTLED and not self._against and self._is_asked

    @property
    def _is_asked(self) -> bool:
        return self._asked or not self._on_request

    def ask(self) -> None:
        """The controller wants a judgement of what settles within `request_ns` of the next reading.

        A grasp that was judged is judged again.
        """
        self._asked = True
        self._asked_until_ns = None

    def judged(self, t_ns: int, median: NDArray[np.uint16]) -> None:
        """The settled grasp was judged, by the reading of `t_ns` with these counts."""
        self._reference = median.astype(np.float32)
        self._asked = False
        self._enter(GateState.JUDGED, t_ns, GateCause.JUDGED)

    def take_changes(self) -> list[GateChange]:
        """Changes since the last call, oldest first."""
        changes, self._changes = self._changes, []
        return changes

    def skip(self, t_ns: int) -> None:
        """A reading came that cannot be used."""
        if self._last_ns is not None and not 0 <= t_ns - self._last_ns <= self._limits.gap_ns:
            self.restart(t_ns)

    def step(
        self,
        t_ns: int,
        median: NDArray[np.uint16],
        usable: NDArray[np.bool_],
        touching: NDArray[np.bool_],
        against: tuple[Reason, ...] = (),
    ) -> None:
        """Take in one usable reading of `t_ns`: its `FreshMedian` and which fingers touch.

        `against` speaks against settling for reasons of others: no tare, joints that move.
        """
        self.skip(t_ns)
        self._last_ns = t_ns
        self._follow_question(t_ns)
        counts = median.astype(np.float32)
        self._stillness.add(t_ns, counts)
        touches = touching.tolist()
        self.in_contact = all(touches[finger] for finger in self._required)
        reasons = self._disturbances(t_ns, counts, usable, against)
        self._follow_contact(t_ns, any(touches))
        if self.state is GateState.JUDGED:
            self._follow_judged(t_ns, counts, usable)
        elif self.state is GateState.SETTLED and reasons:
            cause = GateCause.MOVED if self.in_contact else GateCause.CONTACT_LOST
            self._enter(GateState.CLOSING, t_ns, cause)
        self._against = (*reasons, *self._hold(t_ns, bool(reasons)))

    def _follow_question(self, t_ns: int) -> None:
        if not self._asked:
            return
        if self._asked_until_ns is None:
            self._asked_until_ns = t_ns + self._limits.request_ns
            if self._on_request and self.state is GateState.JUDGED:
                self._enter(GateState.SETTLED, t_ns, GateCause.ASKED)
        elif t_ns > self._asked_until_ns:
            self._asked = False

    def _disturbances(
        self,
        t_ns: int,
        counts: NDArray[np.float32],
        usable: NDArray[np.bool_],
        against: tuple[Reason, ...],
    ) -> tuple[Reason, ...]:
        if not self.in_contact:
            return (
                *(reason for reason in against if reason is Reason.NOT_TARED),
                Reason.NO_CONTACT,
            )
        rate = self._stillness.rate(t_ns, counts, usable)
        if rate is None:
            return (*against, Reason.SEQUENCE_GAP)
        if not max(rate.tolist()) <= self._limits.rate_counts_per_s:
            return (*against, Reason.MOVING)
        return against

    def _follow_contact(self, t_ns: int, touches: bool) -> None:
        if self.state is GateState.RELEASED and t_ns - self._released_ns >= self._limits.release_ns:
            self._enter(GateState.IDLE, t_ns, GateCause.TIME)
        if touches and self.state in (GateState.IDLE, GateState.RELEASED):
            self.grasp += 1
            self._enter(GateState.CLOSING, t_ns, GateCause.CONTACT)
        if not touches and self.state not in (GateState.IDLE, GateState.RELEASED):
            self._released_ns = t_ns
            self._enter(GateState.RELEASED, t_ns, GateCause.CONTACT_LOST)

    def _follow_judged(
        self, t_ns: int, counts: NDArray[np.float32], usable: NDArray[np.bool_]
    ) -> None:
        if not self.in_contact:
            self._enter(GateState.CLOSING, t_ns, GateCause.CONTACT_LOST)
        elif self._reference is None or self._has_changed(counts, usable, self._reference):
            self._enter(GateState.CLOSING, t_ns, GateCause.CHANGED)

    def _has_changed(
        self,
        counts: NDArray[np.float32],
        usable: NDArray[np.bool_],
        reference: NDArray[np.float32],
    ) -> bool:
        distance = mean_distance(counts, reference, usable)
        return bool(max(distance.tolist()) > self._limits.change_counts)

    def _hold(self, t_ns: int, disturbed: bool) -> tuple[Reason, ...]:
        """Wait for the hold time; what speaks against settling besides what disturbs."""
        if disturbed:
            self._held_since_ns = None
            return ()
        if self.state is not GateState.CLOSING:
            return ()
        if self._held_since_ns is None:
            self._held_since_ns = t_ns
        if t_ns - self._held_since_ns < self._limits.hold_ns:
            return (Reason.SETTLING,)
        self._enter(GateState.SETTLED, t_ns, GateCause.STILL)
        return ()

    def restart(self, t_ns: int) -> None:
        """Nobody knows what happened meanwhile, or time went back."""
        if self._last_ns is not None and t_ns < self._last_ns:
            self._released_ns = t_ns
            self._asked_until_ns = None
        self._last_ns = t_ns
        self._held_since_ns = None
        self._stillness.reset()
        self._against = (Reason.SEQUENCE_GAP,)
        if self.state in (GateState.SETTLED, GateState.JUDGED):
            self._enter(GateState.CLOSING, t_ns, GateCause.GAP)

    def _enter(self, state: GateState, t_ns: int, cause: GateCause) -> None:
        if len(self._changes) < CHANGES_MAX:
            self._changes.append(GateChange(t_ns, self.grasp, self.state, state, cause))
        self.state = state
        if state is GateState.CLOSING:
            self._held_since_ns = None
            self._reference = None
