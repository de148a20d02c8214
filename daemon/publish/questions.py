"""The socket on which a grasp controller asks whether it may lift, and tells how lifts ended."""

from __future__ import annotations

import json
import re
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Final, Literal

from daemon.publish.binding import Binding, Peer
from daemon.publish.bound import Bound
from daemon.publish.companion import CONTRADICTS, Answer
from daemon.publish.messages import OBJECT_PATTERN
from daemon.publish.zmtp import Message, Role
from daemon.trust.ledger import GRASPS_MAX, GraspId

QUESTION = b"judge"
TELLING = b"outcome"
"""First word of `outcome <boot_id> <grasp> <stable|slip> [<object>]`."""
MESSAGE_MAX_BYTES = 128
"""The longest outcome; a peer that sends more asks nothing and is disconnected."""
WAITING_MAX: Final = 256
"""Questions that wait for an answer, one of each peer; the oldest is given up for a newer one."""
QUEUE_MAX = 16
"""Answers queued per peer."""
_TOLD = re.compile(
    rb"outcome ([0-9a-f]{32}) ([0-9]{1,15}) (stable|slip)(?: (%b))?" % OBJECT_PATTERN.encode()
)
MALFORMED = "malformed: outcome <boot_id> <grasp> <stable|slip> [<object>]"
NOBODY = "nobody takes outcomes here"
TOO_EARLY = "too early: who asked about this grasp is still there"
HELD_MAX = 16
"""Outcomes that are held because they are too early."""
GRACE_NS = 100_000_000
"""For how long: who asks, closes, connects again and tells may be heard of in another order."""
NOT_YOURS = "not yours: somebody else asks about grasps here"

TakeOutcome = Callable[[str, int, Literal["stable", "slip"], str | None], str | None]
"""Takes a boot id, a grasp, how its lift ended, and the object if it was named; None, or why it
does not."""
Keep = Callable[[Answer], None]
"""Calls the answer once what was told is kept, or is known not to be."""


def at_once(answer: Answer) -> None:
    """Keep nothing: what was told is answered as it is told."""
    answer(None)


@dataclass(frozen=True, slots=True)
class _Question:
    envelope: Message
    due_ns: int


@dataclass(frozen=True, slots=True)
class _Told:
    peer: Peer
    envelope: Message
    text: bytes
    due_ns: int
    """When it is no longer held, monotonic ns."""


@dataclass(slots=True)
class _Lift:
    """A grasp that was asked about, or whose outcome was told."""

    owner: Peer | None
    """Who asked first; None: nobody."""
    outcome: str | None = None


class Questions(Bound):
    """Takes questions and answers them; never blocks.

    A peer has one question at a time; another one replaces it. Who was first to get an answer about
    a grasp is the one who tells its outcome: nobody else may, unless it stands for who is gone.
    What was told stays.
    """

    def __init__(self, endpoint: str, patience_ns: int, binding: Binding | None = None) -> None:
        """Bind to `endpoint`; a question waits `patience_ns` at most. Raises `PublishError`."""
        super().__init__(endpoint, Role.ROUTER, QUEUE_MAX, binding)
        self._counted: Counter[str] = Counter()
        self._patience_ns = patience_ns
        self._waiting: dict[Peer, _Question] = {}
        """Oldest first."""
        self._lifts: dict[GraspId, _Lift] = {}
        """Oldest first, as many as outcomes are taken of."""
        self._held: list[_Told] = []

    @property
    def counters(self) -> Counter[str]:
        """`asked`, `answered`, `given_up`, `malformed`; `outcomes` that were taken, and kept where
        that is wanted, and `outcomes_refused`; and what the door counts."""
        return self._with_the_doors(self._counted)

    @property
    def waiting(self) -> int:
        """Questions without an answer."""
        return len(self._waiting)

    def due_ns(self) -> int | None:
        """When the oldest question must be answered, monotonic ns."""
        return next(iter(self._waiting.values())).due_ns if self._waiting else None

    def take(self, now_ns: int, outcome: TakeOutcome | None = None, keep: Keep = at_once) -> int:
        """Take in what has come; how many questions it was.

        Outcomes go to `outcome`; those that it takes are answered when `keep` says so.
        """
        taken = 0
        held, self._held = self._held, []
        for told in held:
            self._take_outcome(told, outcome, keep)
        for peer, message in self.door.receive():
            *envelope, question = message
            well = envelope in ([], [b""])
            if well and question.partition(b" ")[0] == TELLING:
                due_ns = time.monotonic_ns() + GRACE_NS
                self._take_outcome(_Told(peer, envelope, question, due_ns), outcome, keep)
            elif well and question == QUESTION:
                self._wait(peer, _Question(envelope, now_ns + self._patience_ns))
                taken += 1
            else:
                self._counted["malformed"] += 1
        self._counted["asked"] += taken
        return taken

    def _take_outcome(self, told: _Told, outcome: TakeOutcome | None, keep: Keep) -> None:
        why = self._pass_on(told.peer, told.text, outcome)
        if why == TOO_EARLY:
            if len(self._held) < HELD_MAX and time.monotonic_ns() < told.due_ns:
                self._held.append(told)
                return
            why = NOT_YOURS
        answer = partial(self._answer_outcome, told.peer, told.envelope)
        if why is None:
            keep(answer)
        else:
            answer(why)

    def _wait(self, peer: Peer, question: _Question) -> None:
        if self._waiting.pop(peer, None) is not None:
            self._counted["given_up"] += 1
        elif len(self._waiting) >= WAITING_MAX:
            gone = (each for each in self._waiting if not each.is_open)
            del self._waiting[next(gone, next(iter(self._waiting)))]
            self._counted["given_up"] += 1
        self._waiting[peer] = question

    def _pass_on(self, peer: Peer, text: bytes, take_outcome: TakeOutcome | None) -> str | None:
        """Pass on how a lift ended; None, or why that is of no use."""
        told = _TOLD.fullmatch(text)
        if told is None:
            return MALFORMED
        if take_outcome is None:
            return NOBODY
        outcome: Literal["stable", "slip"] = "slip" if told[3] == b"slip" else "stable"
        named = None if told[4] is None else told[4].decode()
        grasp = GraspId(told[1].decode(), int(told[2]))
        owners = self._owners(grasp)
        if owners and not any(map(peer.stands_for, owners)):
            return TOO_EARLY if any(map(peer.may_follow, owners)) else NOT_YOURS
        lift = self._lifts.get(grasp)
        if lift is not None and lift.outcome not in (None, outcome):
            return CONTRADICTS
        why = take_outcome(*grasp, outcome, named)
        if why is None:
            self._lift(grasp, None).outcome = outcome
        return why

    def _owners(self, grasp: GraspId) -> set[Peer]:
        """Who asked about a grasp; if nobody has, whoever asks here; nobody if nobody does."""
        lift = self._lifts.get(grasp)
        if lift is not None and lift.owner is not None:
            return {lift.owner}
        return {each.owner for each in self._lifts.values() if each.owner is not None}

    def _lift(self, grasp: GraspId, owner: Peer | None) -> _Lift:
        """What is known of a grasp; it gets this owner if nothing is."""
        if grasp not in self._lifts and len(self._lifts) >= GRASPS_MAX:
            del self._lifts[next(iter(self._lifts))]
        return self._lifts.setdefault(grasp, _Lift(owner))

    def _answer_outcome(self, peer: Peer, envelope: Message, why: str | None) -> None:
        """Say whether an outcome was of use. Whoever is gone misses it."""
        refused = "malformed" if why == MALFORMED else "outcomes_refused"
        self._counted["outcomes" if why is None else refused] += 1
        said = {"v": 1, "ok": True} if why is None else {"v": 1, "ok": False, "why": why}
        answer = json.dumps(said, separators=(",", ":")).encode()
        self.door.send(peer, (*envelope, answer))

    def answer(
        self, payload: bytes, now_ns: int | None = None, grasp: GraspId | None = None
    ) -> None:
        """Answer all questions, or with `now_ns` those that can wait no longer.

        `grasp` is the one that the answer is about. Whoever is gone misses it.
        """
        answered = []
        for peer, question in self._waiting.items():
            if now_ns is not None and question.due_ns > now_ns:
                break
            self.door.send(peer, (*question.envelope, payload))
            answered.append(peer)
        if not answered:
            return
        for peer in answered:
            del self._waiting[peer]
        self._counted["answered"] += len(answered)
        if grasp is not None and grasp.grasp:
            self._lift(grasp, answered[0])
