"""Answer grasp controllers that ask for a verdict, and take the outcomes of their lifts."""

from __future__ import annotations

import json
import logging
import re
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Final

from msgspec.structs import replace

from graspd.daemon.judge.reasons import Decision, Reason
from graspd.daemon.publish.companion import KEPT, PublishedVerdict, Reply, Requests, Told
from graspd.daemon.publish.messages import OBJECT_PATTERN, Owner, encode, withheld
from graspd.daemon.publish.porter import Frames
from graspd.daemon.trust.lift_book import LIFTS_MAX, NAME_BYTES, GraspId, LiftBook, Peer, Report

log = logging.getLogger("graspd")

JUDGE, LIFT = b"judge", b"lift"
"""Texts that ask for a verdict. `lift` also reserves the grasp's outcome for the peer."""
NOT_LIFTING = b"not-lifting"
"""Text that takes back the last `lift` of this connection, answered or not; no earlier one."""
CLOCK = b"clock"
"""Text that asks for the daemon's monotonic time, to compare with a remote client's clock."""
OUTCOME = b"outcome"
WAITING_MAX: Final = 256
"""Most questions that wait, one of each connection. A newer one replaces the oldest."""
_REPORT = re.compile(
    rb"outcome ([0-9a-f]{32}) ([0-9]{1,15}) (stable|slip|not-lifted)(?: (%b))?"
    % OBJECT_PATTERN.encode()
)
FORM = "outcome <boot_id> <grasp> <stable|slip|not-lifted> [<object>]"
REFUSED = frozenset(Told) - {Told.KEPT, Told.REPEATED}


@dataclass(slots=True)
class Question:
    """A question that waits for an answer."""

    envelope: Frames
    """Frames before the answer's text: routing id, and the delimiter of a REQ socket."""
    due_ns: int
    """Time by which the question is answered, monotonic ns."""
    lifts: bool
    """True for `lift`, False for `judge`."""
    offer: tuple[GraspId, Decision] | None = None
    """Grasp that the peer may lift, and its verdict, which is not sent yet. None: no offer."""
    kept: bool | None = None
    """True: the offer is on the disk. False: it cannot be saved. None: not known yet."""

    def keep(self, offer: tuple[GraspId, Decision], reply: Reply) -> None:
        """Note by `reply` whether this `offer` is on the disk; ignore an outdated offer."""
        if offer == self.offer:
            self.kept = reply.told is Told.KEPT


class Questions:
    """Takes questions and outcomes of peers, and answers them."""

    def __init__(
        self,
        send: Callable[[Sequence[bytes]], bool],
        patience_ns: int,
        tells: Callable[[bytes], bool] | None = None,
    ) -> None:
        """`send`: sends an answer's frames; returns False if it drops them.

        `patience_ns`: longest time until a question is answered. `tells`: returns True if a
        credential may lift and report outcomes; None: only the first credential that lifts may.
        """
        self.counters: Counter[str] = Counter()
        """Number of questions and outcomes by their result; `dropped` counts answers."""
        self._send = send
        self._patience_ns = patience_ns
        self._tells = tells
        self.waiting: dict[Peer, Question] = {}
        """Questions without an answer; the oldest first."""
        self._last: PublishedVerdict | None = None
        self._last_lifts: dict[Peer, GraspId | None] = {}
        """Grasp that the last `lift` of a connection offered; None: it was no offer. Only of those
        that own a grasp without outcome; the oldest first, `LIFTS_MAX` at most."""

    def serve(self, messages: Iterable[Frames], now_ns: int, requests: Requests) -> int | None:
        """Handle messages that arrived by `now_ns`; answer questions that are due by then.

        Return the latest time of the next answer, monotonic ns; None: no question waits.
        """
        if messages:
            self.take(messages, now_ns, requests)
        if self.waiting:
            self._expire(now_ns, requests)
        return next((question.due_ns for question in self.waiting.values()), None)

    def take(self, messages: Iterable[Frames], now_ns: int, requests: Requests) -> None:
        """Take messages of peers that arrived by `now_ns`; pass them on to `requests`.

        A message is a routing id, a credential, maybe the delimiter of a REQ socket, and a text.
        """
        asked = 0
        for routing_id, credential, *delimiter, text in messages:
            peer = Peer(routing_id, credential or routing_id[:NAME_BYTES])
            envelope, well_formed = [routing_id, *delimiter], delimiter in ([], [b""])
            if well_formed and text.partition(b" ")[0] == OUTCOME:
                self._take_outcome(envelope, peer, text, requests)
            elif well_formed and text in (JUDGE, LIFT):
                self._wait(peer, Question(envelope, now_ns + self._patience_ns, text == LIFT))
                asked += 1
            elif well_formed and text == NOT_LIFTING:
                self._take_back(envelope, peer, requests)
            elif well_formed and text == CLOCK:
                # The question came before `now_ns`, so an age computed by it is never too small.
                self._answer(envelope, b'{"v":1,"t_mono_ns":%d}' % now_ns)
                self.counters["clocks"] += 1
            else:
                self.counters["malformed"] += 1
        if asked:
            self.counters["asked"] += asked
            requests.ask()

    def _wait(self, peer: Peer, question: Question) -> None:
        if peer in self.waiting:
            self._withdraw(peer, self.waiting[peer])
            self._end(peer)
            self.counters["given_up"] += 1
        elif len(self.waiting) >= WAITING_MAX:
            self._give_up(next(iter(self.waiting)), Reason.NOT_ASKED)
        self.waiting[peer] = question

    def _give_up(self, peer: Peer, *reasons: Reason) -> None:
        """Answer the peer's question `unknown`, for `reasons`; before any verdict only drop it."""
        question = self.waiting[peer]
        self._withdraw(peer, question)
        self._end(peer)
        self.counters["given_up"] += 1
        if self._last is not None:
            self._answer(question.envelope, withheld(self._last.verdict, *reasons))

    def _end(self, peer: Peer) -> None:
        """Let the peer's question wait no more; if it is a `lift`, remember what it offered."""
        question = self.waiting.pop(peer)
        if not question.lifts or self._last is None:
            return
        self._last_lifts.pop(peer, None)
        if self._last.lifts.offered(peer) is not None:
            self._remember(peer, None if question.offer is None else question.offer[0])

    def _remember(self, peer: Peer, offered: GraspId | None) -> None:
        self._last_lifts[peer] = offered
        if len(self._last_lifts) > LIFTS_MAX:
            del self._last_lifts[next(iter(self._last_lifts))]

    def _withdraw(self, peer: Peer, question: Question) -> None:
        """Clear the offer of a question, if it has one: the peer no longer owns that grasp."""
        offer, question.offer, question.kept = question.offer, None, None
        lifts = None if self._last is None else self._last.lifts
        if lifts is not None and offer is not None and lifts.offered(peer) == offer[0]:
            lifts.take_back(offer[0])

    def _take_back(self, envelope: Frames, peer: Peer, requests: Requests) -> None:
        answer = partial(self._answer_outcome, envelope)
        if peer in self.waiting:
            self._end(peer)
        grasp = None if self._last is None else self._last.lifts.offered(peer)
        # A connection that has not asked since the start may take back what it owns from before.
        if grasp is None or grasp != self._last_lifts.get(peer, grasp):
            answer(KEPT)
        else:
            self._remember(peer, grasp)
            requests.outcome(Report(grasp, "not-lifted", peer=peer), answer)

    def _take_outcome(self, envelope: Frames, peer: Peer, text: bytes, requests: Requests) -> None:
        told = _REPORT.fullmatch(text)
        if told is None:
            self._answer_outcome(envelope, Reply(Told.MALFORMED, FORM))
            return
        report = Report(
            grasp=GraspId(told[1].decode(), int(told[2])),
            outcome=told[3].decode(),
            object_name=None if told[4] is None else told[4].decode(),
            peer=peer,
        )
        requests.outcome(report, partial(self._answer_outcome, envelope))

    def _answer_outcome(self, envelope: Frames, reply: Reply) -> None:
        answer: dict[str, object] = {"v": 1, "ok": reply.told not in REFUSED}
        counter = "malformed" if reply.told is Told.MALFORMED else "outcomes_refused"
        if reply.told in REFUSED:
            answer["why"] = f"{reply.told}: {reply.detail}"
        else:
            counter = "outcomes"
        if reply.told is Told.REPEATED:
            answer["repeated"] = True
        self.counters[counter] += 1
        self._answer(envelope, json.dumps(answer, separators=(",", ":")).encode())

    def _answer(self, envelope: Frames, payload: bytes) -> None:
        self.counters["dropped"] += not self._send((*envelope, payload))

    def _expire(self, now_ns: int, requests: Requests) -> None:
        """Answer `unknown` to questions that are due, though nothing was judged for them."""
        due = [peer for peer, question in self.waiting.items() if question.due_ns <= now_ns]
        if due and self._last is None:
            requests.silence()
        for peer in due:
            if peer in self.waiting:
                offer = self.waiting[peer].offer
                self._give_up(peer, *([Reason.NOT_KEPT] if offer else self._why_not(now_ns)))

    def _why_not(self, now_ns: int) -> list[Reason]:
        """Return why nothing was judged: the last verdict's reasons, or `stale` if it has none, if
        it reports silence, or if its reading is so old that it is silence by now."""
        if self._last is not None and self._last.reading is not None:
            verdict = self._last.verdict
            if verdict.reasons and now_ns - verdict.t_mono_ns <= verdict.silence_ms * 1e6:
                return verdict.reasons
        return [Reason.STALE]

    def answer(self, published: PublishedVerdict, now_ns: int | None = None) -> None:
        """Answer waiting questions with this verdict; permit a lift only once that is on the disk.

        `now_ns`: answer only questions that are due by then or wait for the disk; None: answer all.
        """
        self._last = published
        for peer, question in list(self.waiting.items()):
            if now_ns is None or question.offer or question.due_ns <= now_ns:
                payload = self._payload(peer, question, published)
                if payload is not None:
                    self._end(peer)
                    self.counters["answered"] += 1
                    self._answer(question.envelope, payload)

    def _payload(self, peer: Peer, question: Question, published: PublishedVerdict) -> bytes | None:
        """Offer the grasp if it may be lifted; return the answer; None: the disk has to reply."""
        verdict, lifts = published.verdict, published.lifts
        is_stable = verdict.verdict is Decision.STABLE
        is_offer = question.lifts and (is_stable or verdict.supervised)
        offer = (published.grasp, verdict.verdict) if is_offer else None
        if offer != question.offer:
            self._withdraw(peer, question)
        if offer is None:
            return published.payload
        is_new = question.offer is None
        if is_new and not (self._may_lift(peer, lifts) and lifts.claim(published.grasp, peer)):
            early = verdict.early and verdict.valid
            return encode(replace(verdict, supervised=False, early=early, owner="another"))
        lifts.announce()
        if is_new:
            question.offer = offer
            published.keep(partial(question.keep, offer))
        if question.kept is False:
            self._withdraw(peer, question)
            return withheld(verdict, Reason.NOT_KEPT)
        if not question.kept:
            return None
        owner: Owner = "you" if lifts.owns(published.grasp, peer) else "another"
        return encode(replace(verdict, owner=owner))

    def _may_lift(self, peer: Peer, lifts: LiftBook) -> bool:
        if self._tells is not None:
            tells = self._tells(peer.credential)
        else:
            tells = lifts.lifter is None or lifts.lifter.credential == peer.credential
        if tells and len(peer.routing_id) >= NAME_BYTES:
            return True
        if not self.counters["not_theirs"]:
            who = peer.credential.decode(errors="replace")
            why = f"its routing id has under {NAME_BYTES} bytes" if tells else "[ask] tell"
            log.warning("%r asks `lift` and may not: %s, deploy/wire/README.md", who, why)
        self.counters["not_theirs"] += 1
        return False
