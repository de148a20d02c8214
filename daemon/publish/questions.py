"""Questions of grasp controllers whether they may lift, and what they report of their lifts."""

from __future__ import annotations

import json
import re
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Final, Literal

from daemon.publish.companion import CONTRADICTS, Requests
from daemon.publish.door import Message
from daemon.publish.messages import OBJECT_PATTERN
from daemon.trust.ledger import GRASPS_MAX, GraspId

JUDGE, LIFT = b"judge", b"lift"
"""Questions. The answer is the same, but only `lift` makes the peer the owner of the grasp."""
OUTCOME = b"outcome"
"""First word of `outcome <boot_id> <grasp> <stable|slip> [<object>]`."""
WAITING_MAX: Final = 256
"""Questions that wait for an answer, one of each peer. A newer one replaces the oldest."""
_REPORT = re.compile(
    rb"outcome ([0-9a-f]{32}) ([0-9]{1,15}) (stable|slip)(?: (%b))?" % OBJECT_PATTERN.encode()
)
MALFORMED = "malformed: outcome <boot_id> <grasp> <stable|slip> [<object>]"
NOT_YOURS = "not yours: another peer asks whether it may lift here"

Peer = bytes
"""Routing id of a connection."""
NAME_BYTES: Final = 16
"""A client with several connections begins their routing ids with the same 16 random bytes. It is
the owner of its grasps by them."""


@dataclass(frozen=True, slots=True)
class _Question:
    envelope: Message
    """Routing id, and the delimiter of a REQ socket."""
    due_ns: int
    lifts: bool


@dataclass(slots=True)
class _Lift:
    """A grasp that a peer wants to lift, or whose outcome was reported."""

    owner: Peer | None
    """Name of the first peer that was answered about it; None: no peer asked to lift it."""
    outcome: str | None = None


class LiftBook:
    """Which peer may report the outcome of which grasp, for the last `GRASPS_MAX` grasps."""

    def __init__(self) -> None:
        self._lifts: dict[GraspId, _Lift] = {}
        """Oldest first."""

    def own(self, grasp: GraspId, peer: Peer) -> None:
        """Make the peer the owner of a grasp that is not in the book yet."""
        self._entry(grasp, peer)

    def report(self, grasp: GraspId, outcome: str) -> None:
        """Note an outcome that was taken."""
        self._entry(grasp, None).outcome = outcome

    def objection(self, grasp: GraspId, peer: Peer, outcome: str) -> str | None:
        """Return why the peer may not report this outcome; None if it may.

        A grasp with an owner is reported by its owner. A grasp without one is reported by the
        owners of other grasps, or by all peers if there are no owners.
        """
        lift = self._lifts.get(grasp)
        if lift is None or lift.owner is None:
            owners = {each.owner for each in self._lifts.values() if each.owner is not None}
        else:
            owners = {lift.owner}
        if owners and peer not in owners:
            return NOT_YOURS
        if lift is not None and lift.outcome not in (None, outcome):
            return CONTRADICTS
        return None

    def _entry(self, grasp: GraspId, owner: Peer | None) -> _Lift:
        """Return the entry of a grasp; a new one gets this owner."""
        lift = self._lifts.setdefault(grasp, _Lift(owner))
        if len(self._lifts) > GRASPS_MAX:
            del self._lifts[next(iter(self._lifts))]
        return lift


class Questions:
    """Takes questions and outcomes, and answers them. A peer has one question at a time."""

    def __init__(self, send: Callable[[Sequence[bytes]], bool], patience_ns: int) -> None:
        """`send` returns False if it drops an answer. Questions wait at most `patience_ns`."""
        self.counters: Counter[str] = Counter()
        """`asked`, `answered`, `given_up`, `malformed`; `outcomes` that were taken, and kept where
        that is wanted, and `outcomes_refused`; `dropped` answers."""
        self._send = send
        self._patience_ns = patience_ns
        self._waiting: dict[Peer, _Question] = {}
        """Oldest first."""
        self._book = LiftBook()

    @property
    def waiting(self) -> int:
        """Number of questions without an answer."""
        return len(self._waiting)

    def take(self, messages: Iterable[Message], now_ns: int, requests: Requests) -> None:
        """Take the messages of peers, and pass on to `requests` what they want."""
        asked = 0
        for peer, *envelope, text in messages:
            well_formed = envelope in ([], [b""])
            if well_formed and text.partition(b" ")[0] == OUTCOME:
                self._take_outcome([peer, *envelope], text, requests)
            elif well_formed and text in (JUDGE, LIFT):
                due_ns = now_ns + self._patience_ns
                self._wait(peer, _Question([peer, *envelope], due_ns, text == LIFT))
                asked += 1
            else:
                self.counters["malformed"] += 1
        if asked:
            self.counters["asked"] += asked
            requests.ask()

    def _wait(self, peer: Peer, question: _Question) -> None:
        if self._waiting.pop(peer, None) is not None:
            self.counters["given_up"] += 1
        elif len(self._waiting) >= WAITING_MAX:
            del self._waiting[next(iter(self._waiting))]
            self.counters["given_up"] += 1
        self._waiting[peer] = question

    def _take_outcome(self, envelope: Message, text: bytes, requests: Requests) -> None:
        refusal = self._refusal(envelope[0], text, requests)
        answer = partial(self._answer_outcome, envelope)
        if refusal is None:
            requests.keep(answer)
        else:
            answer(refusal)

    def _refusal(self, peer: Peer, text: bytes, requests: Requests) -> str | None:
        """Pass an outcome on. Return None, or why it is refused."""
        report = _REPORT.fullmatch(text)
        if report is None:
            return MALFORMED
        outcome: Literal["stable", "slip"] = "slip" if report[3] == b"slip" else "stable"
        object_name = None if report[4] is None else report[4].decode()
        grasp = GraspId(report[1].decode(), int(report[2]))
        refusal = self._book.objection(grasp, peer[:NAME_BYTES], outcome)
        if refusal is None:
            refusal = requests.outcome(*grasp, outcome, object_name)
        if refusal is None:
            self._book.report(grasp, outcome)
        return refusal

    def _answer_outcome(self, envelope: Message, refusal: str | None) -> None:
        """Tell the peer whether its outcome was taken. A peer that has gone misses it."""
        refused = "malformed" if refusal == MALFORMED else "outcomes_refused"
        self.counters["outcomes" if refusal is None else refused] += 1
        said = {"v": 1, "ok": True} if refusal is None else {"v": 1, "ok": False, "why": refusal}
        self._answer(envelope, json.dumps(said, separators=(",", ":")).encode())

    def _answer(self, envelope: Message, payload: bytes) -> None:
        self.counters["dropped"] += not self._send((*envelope, payload))

    def answer(
        self, payload: bytes, now_ns: int | None = None, grasp: GraspId | None = None
    ) -> None:
        """Answer all questions, or with `now_ns` those that can wait no longer.

        `grasp` is the one that the answer is about: it gets its owner here.
        """
        for peer, question in list(self._waiting.items()):
            if now_ns is not None and question.due_ns > now_ns:
                return
            del self._waiting[peer]
            self.counters["answered"] += 1
            self._answer(question.envelope, payload)
            if question.lifts and grasp is not None and grasp.grasp:
                self._book.own(grasp, peer[:NAME_BYTES])
