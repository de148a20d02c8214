"""Questions in any order: who gets which answer, who may lift, and what is announced."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import (
    RuleBasedStateMachine,
    initialize,
    invariant,
    rule,
    run_state_machine_as_test,
)

from graspd.daemon.publish.companion import KEPT, Answer, Reply, Told
from graspd.daemon.publish.porter import Frames
from graspd.daemon.publish.questions import Questions
from graspd.daemon.trust.lift_book import GraspId, LiftBook, Peer, Report
from tests.daemon.fakes import sound
from tests.daemon.publish.doors import Asked, published

MOST = 3
"""Most questions that wait in this test."""
S = 1_000_000_000
ROBOT, STRANGER = b"user 1000", b"user 1001"
NAME, OTHER = b"controller-16byt", b"another-16-bytes"
PEERS = [
    Peer(NAME, ROBOT),
    Peer(NAME + b"2", ROBOT),
    Peer(OTHER, ROBOT),
    Peer(NAME, STRANGER),
    Peer(b"fifteen-bytes..", ROBOT),
]
ANYONE = st.sampled_from((*PEERS[:1] * 3, *PEERS))
READING = sound(np.zeros((3, 24), np.uint16))
OUTCOMES = st.sampled_from(("stable", "slip", "not-lifted"))
Said = tuple[Frames, object]
"""Frames before an answer, and its content as `plain` returns it."""


def named(grasp: int) -> GraspId:
    return GraspId("0" * 32, grasp)


@dataclass
class Waiting:
    """A question without an answer."""

    envelope: Frames
    lifts: bool
    due_ns: int
    offer: tuple[int, str] | None = None
    kept: bool | None = None


class Model:
    """Predicts the answers to peers, with the daemon's book of lifts, which has its own test."""

    def __init__(self, tells: Callable[[bytes], bool] | None) -> None:
        self.tells = tells
        self.book = LiftBook()
        self.last = "", 0  # name and time of the last verdict
        self.waiting: dict[Peer, Waiting] = {}  # oldest first
        self.lasts: dict[Peer, int | None] = {}  # grasp of the last `lift`, if it was an offer
        self.said: list[Said] = []

    def ask(self, peer: Peer, envelope: Frames, now_ns: int, *, lifts: bool) -> None:
        """Take in a question. Keep only a connection's newest; answer the oldest `unknown` if
        a fourth peer asks. `lifts`: asks if it may lift; else for a judgement."""
        if peer in self.waiting:
            self.withdraw(peer, self.waiting[peer])
            self.end(peer, self.waiting[peer])
        elif len(self.waiting) == MOST:
            self.give_up(next(iter(self.waiting)), "not-asked")
        self.waiting[peer] = Waiting(envelope, lifts, now_ns + S)

    def give_up(self, peer: Peer, *reasons: str) -> None:
        question = self.waiting[peer]
        self.withdraw(peer, question)
        self.end(peer, question)
        self.said.append((question.envelope, ("unknown", [*reasons])))

    def overdue(self, question: Waiting, now_ns: int) -> list[str]:
        """Return why a question that is due is answered `unknown`."""
        name, judged_ns = self.last
        if question.offer:
            return ["not-kept"]
        is_silent = now_ns - judged_ns > 100_000_000
        return ["stale"] if is_silent or name != "unknown" else ["moving", "settling"]

    def end(self, peer: Peer, question: Waiting) -> None:
        """Let a question wait no more; note what it offers if it is a `lift`."""
        del self.waiting[peer]
        if question.lifts:
            self.lasts[peer] = question.offer[0] if question.offer else None

    def withdraw(self, peer: Peer, question: Waiting) -> None:
        """Take back the offer of a lift that a question has; the grasp then has no owner."""
        offer, question.offer, question.kept = question.offer, None, None
        if offer is not None and self.book.offered(peer) == named(offer[0]):
            self.book.take_back(named(offer[0]))

    def verdict(self, grasp: int, name: str, now_ns: int | None, *, supervised: bool) -> None:
        """Answer waiting questions by the verdict `name` on `grasp`. `now_ns`: only those that are
        due then or wait for the disk; None: all."""
        for peer, question in list(self.waiting.items()):
            if now_ns is None or question.offer or question.due_ns <= now_ns:
                answer = self.answer(peer, question, grasp, name, supervised=supervised)
                if answer is not None:
                    self.end(peer, question)
                    self.said.append((question.envelope, answer))

    def answer(
        self, peer: Peer, question: Waiting, grasp: int, name: str, *, supervised: bool
    ) -> object:
        offer = (grasp, name) if question.lifts and (name == "stable" or supervised) else None
        if question.offer not in (None, offer):
            self.withdraw(peer, question)
        if offer is None:
            return name
        if question.offer is None:
            if not (self.may_lift(peer) and self.book.claim(named(grasp), peer)):
                return name, "another", False
            question.offer = offer
        self.book.announce()
        if question.kept is False:
            self.withdraw(peer, question)
            return "unknown", ["not-kept"]
        owner = "you" if self.book.owns(named(grasp), peer) else "another"
        return (name, owner, supervised) if question.kept else None

    def may_lift(self, peer: Peer) -> bool:
        """Return True for a peer whose credential the scene names; if it names none, for the
        credential that lifted first. The peer's routing id must have 16 bytes.
        """
        lifter = self.book.lifter
        is_same = lifter is None or lifter.credential == peer.credential
        allowed = is_same if self.tells is None else self.tells(peer.credential)
        return allowed and len(peer.routing_id) >= 16


class Loop(Asked):
    """Stand-in for the loop that accepts outcomes from peers that may report them."""

    def __init__(self) -> None:
        super().__init__()
        self.lifts = LiftBook()

    def outcome(self, report: Report, answer: Answer) -> None:
        ok = take(self.lifts, report)
        answer(KEPT if ok else Reply(Told.NOT_YOURS))


def take(lifts: LiftBook, report: Report) -> bool:
    if not lifts.may_report(report.grasp, report.peer):
        return False
    if report.outcome == "not-lifted":
        return lifts.take_back(report.grasp)
    return lifts.tell(report.grasp, slipped=report.outcome == "slip")[0] == "taken"


def plain(payload: bytes) -> object:
    """Return what `Model` predicts of an answer: `ok` of an outcome; `said` or (verdict, owner,
    supervised) of a verdict; (verdict, reasons) if it is `unknown` without an owner."""
    found: dict[str, Any] = json.loads(payload)
    if "ok" in found:
        return found["ok"]
    if "said" in found:
        return found["said"]
    if "owner" in found:
        return found["verdict"], found["owner"], found["supervised"]
    assert (found["p_slip"], found["valid"], found["supervised"]) == (None, False, False)
    return found["verdict"], found["reasons"]


class Questioning(RuleBasedStateMachine):
    """Peers, a hand and a disk, in any order of their actions, compared with `Model`."""

    @initialize(tells=st.sampled_from((None, {ROBOT}.__contains__)))
    def start(self, tells: Callable[[bytes], bool] | None) -> None:
        self.said: list[Said] = []
        self.loop, self.model = Loop(), Model(tells)
        self.questions = Questions(self.send, S, tells)
        self.now_ns = self.grasp = 0
        self.disk: list[tuple[Answer, Waiting, tuple[int, str]]] = []
        self.judge("slip", supervised=False, is_new=True, is_answer=True)

    def send(self, frames: Sequence[bytes]) -> bool:
        self.said.append(([*frames[:-1]], plain(frames[-1])))
        return True

    def take(self, peer: Peer, text: bytes, delimiter: Frames) -> None:
        self.questions.take([[*peer, *delimiter, text]], self.now_ns, self.loop)

    @rule(peer=ANYONE, lifts=st.sampled_from((True, True, False)), is_req=st.booleans())
    def ask(self, peer: Peer, lifts: bool, is_req: bool) -> None:
        delimiter = [b""] if is_req else []
        self.take(peer, b"lift" if lifts else b"judge", delimiter)
        self.model.ask(peer, [peer.routing_id, *delimiter], self.now_ns, lifts=lifts)

    @rule(
        name=st.sampled_from(("stable", "stable", "slip", "unknown")),
        supervised=st.booleans(),
        is_new=st.booleans(),
        is_answer=st.booleans(),
    )
    def judge(self, name: str, supervised: bool, is_new: bool, is_answer: bool) -> None:
        supervised = supervised and name == "unknown"
        self.grasp += is_new
        for book in (self.loop.lifts, self.model.book):
            book.note(named(self.grasp), bytes(8), stable=name == "stable")
        now_ns = None if is_answer else self.now_ns
        waits: list[Answer] = []
        verdict = published(
            b'{"said":"%s"}' % name.encode(),
            name,
            self.loop.lifts,
            waits.append,
            self.grasp,
            supervised=supervised,
            reasons=["moving", "settling"] if name == "unknown" else [],
            t_mono_ns=self.now_ns,
        )
        self.model.last = name, self.now_ns
        self.questions.answer(verdict._replace(reading=READING), now_ns)
        before = {peer: each.offer for peer, each in self.model.waiting.items()}
        self.model.verdict(self.grasp, name, now_ns, supervised=supervised)
        offered = [
            (each, each.offer)
            for peer, each in self.model.waiting.items()
            if each.offer is not None and each.offer != before[peer]
        ]
        self.disk += [(a, *b) for a, b in zip(waits, offered, strict=True)]

    @rule(ok=st.sampled_from((True, True, False)), most=st.sampled_from((1, 99)))
    def the_disk_answers(self, ok: bool, most: int) -> None:
        for answer, question, offer in self.disk[:most]:
            answer(KEPT if ok else Reply(Told.NOT_KEPT, "full"))
            if question.offer == offer:
                question.kept = ok
        del self.disk[:most]

    @rule(
        peer=ANYONE,
        name=st.sampled_from(("stable", "unknown")),
        regrasps=st.booleans(),
        ok=st.none() | st.booleans(),
    )
    def lift(self, peer: Peer, name: str, regrasps: bool, ok: bool | None) -> None:
        """Ask to lift, judge, and have the disk answer `ok`; None: it does not answer.

        `regrasps`: another grasp is judged before the disk answers.
        """
        self.ask(peer, lifts=True, is_req=False)
        for is_new in (False, True)[: 1 + regrasps]:
            self.judge(name, supervised=True, is_new=is_new, is_answer=not is_new)
        if ok is not None:
            self.the_disk_answers(ok, 1 if regrasps else 99)
            self.judge(name, supervised=True, is_new=False, is_answer=False)

    @rule(
        peer=ANYONE,
        lifts=st.booleans(),
        name=st.sampled_from(("stable", "slip", "unknown", "unknown")),
        left_ns=st.sampled_from((1, S // 10, S // 10 + 1)),
    )
    def wait_in_vain(self, peer: Peer, lifts: bool, name: str, left_ns: int) -> None:
        """Ask, and have a verdict that does not answer, `left_ns` before the answer is due."""
        self.ask(peer, lifts=lifts, is_req=False)
        self.wait(S - left_ns)
        self.judge(name, supervised=False, is_new=False, is_answer=False)
        self.wait(left_ns)

    @rule(peer=ANYONE)
    def take_back(self, peer: Peer) -> None:
        self.take(peer, b"not-lifting", [])
        if peer in self.model.waiting:
            self.model.end(peer, self.model.waiting[peer])
        last = self.model.lasts.get(peer)
        owned = self.model.book.offered(peer)
        if owned is not None and owned.grasp == last:
            take(self.model.book, Report(owned, "not-lifted", peer=peer))
        self.model.said.append(([peer.routing_id], True))

    @rule(peer=ANYONE, outcome=OUTCOMES, back=st.sampled_from((0, 0, 1, 2)))
    def tell(self, peer: Peer, outcome: str, back: int) -> None:
        grasp = max(self.grasp - back, 0)
        self.take(peer, b"outcome %s %d %s" % (b"0" * 32, grasp, outcome.encode()), [])
        ok = take(self.model.book, Report(named(grasp), outcome, peer=peer))
        self.model.said.append(([peer.routing_id], ok))

    @rule(after_ns=st.sampled_from((1, S // 2, S - 1, S)))
    def wait(self, after_ns: int) -> None:
        """Let `after_ns` pass without a reading: questions that are due are answered `unknown`."""
        self.now_ns += after_ns
        next_ns = self.questions.serve([], self.now_ns, self.loop)
        for peer, question in list(self.model.waiting.items()):
            if question.due_ns <= self.now_ns:
                self.model.give_up(peer, *self.model.overdue(question, self.now_ns))
        assert next_ns == min((each.due_ns for each in self.model.waiting.values()), default=None)

    @invariant()
    def all_is_as_expected(self) -> None:
        assert self.said == self.model.said
        assert set(self.questions.waiting) == set(self.model.waiting)
        assert self.loop.lifts.state() == self.model.book.state()
        assert self.loop.lifts.lifter == self.model.book.lifter


def test_questions_in_any_order_are_answered_as_a_simulation_predicts(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("graspd.daemon.publish.questions.WAITING_MAX", MOST)
    run_state_machine_as_test(
        Questioning, settings=settings(derandomize=True, max_examples=100, stateful_step_count=40)
    )
