"""Lifts in any order: late, lost, told twice, contradicted, taken back, restarted, killed."""

from __future__ import annotations

from collections import Counter
from copy import deepcopy
from dataclasses import dataclass

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

from graspd.daemon.trust.lift_book import NOT_ASSESSED, LiftBook, Peer
from graspd.daemon.trust.trust import Trust, decode, encode
from graspd.models.trust.assessment import Assessment
from graspd.models.trust.learner import Learner, sigmoid
from graspd.models.trust.risk import Permission, RiskLimits
from tests.daemon.trust.grasps import INPUTS, inputs, named, trust

BOOK = 6
"""Most grasps in the book in the random test, so few that some leave it."""
ALPHAS = st.sampled_from((None, 0.001, 0.05, 0.1, 0.5))
PEERS = [
    Peer(name, user)
    for name in (b"controller-16byt1", b"controller-16byt2", b"controller-16by.1")
    for user in (b"user 1000", b"user 1001")
]
MARGINS = st.sampled_from((-9.0, -9.0, -4.0, -1.0, 3.0))
BACK = st.sampled_from((0, 0, 0, 1, 1, 2, 3, 5, 7))
"""How many grasps before the newest one; some have left the book."""


@dataclass
class Lift:
    """One grasp, as the book should have it."""

    stable: bool
    lesson: bytes | None
    """Features of the grasp; None once nothing is to be learned from it."""
    slipped: bool | None = None
    announced: bool = False
    owner: Peer | None = None


class Model:
    """Simulates the book of lifts, the budget of slips, and what is learned, in plain code."""

    def __init__(self, alpha: float | None) -> None:
        self.alpha, self.budget, self.proven = alpha, 5.0, 0
        self.lifts: dict[int, Lift] = {}  # oldest first
        self.lessons: list[tuple[bytes, bool]] = []
        self.slips: list[bool] = []  # of the `stable` lifts
        self.told: Counter[str] = Counter()
        self.announced = self.unreported = 0
        self.unkept: set[int] = set()
        self.lifter: Peer | None = None
        self.newest = 0, b""  # grasp and features of the judgement that an offer is for
        self.offered = 0  # grasp that was offered last

    def judged(self, number: int, lesson: bytes, *, stable: bool, settles: bool) -> None:
        """Enter a grasp by its features, `lesson`: those of its last offer count, else of its first
        `stable` verdict, else of the last one that `settles`, else of the first that has any."""
        if settles and lesson:
            self.newest = number, lesson
        lift = self.lifts.get(number)
        if lift is None:
            self.lifts[number], self.newest = Lift(stable, lesson), (number, lesson)
        elif lift.slipped is None:
            is_better = (stable and not lift.stable) or (lift.lesson == NOT_ASSESSED != lesson)
            if is_better or (settles and not lift.stable and lift.lesson and lesson):
                self.newest = number, lesson
                lift.stable = lift.stable or stable
                if number != self.offered or not lift.lesson:
                    lift.lesson = lesson
        if len(self.lifts) > BOOK:
            oldest = min(self.lifts)
            lost = self.lifts.pop(oldest)
            self.unkept.discard(oldest)
            self.unreported += lost.stable and lost.slipped is None
            if lost.announced and lost.slipped is None and self.alpha is not None:
                self.ended(slipped=True)

    def ended(self, *, slipped: bool) -> None:
        self.slips.append(slipped)
        if self.alpha is not None:
            self.budget = min(self.budget + self.alpha - slipped, 8.0)

    def tell(self, number: int, *, slipped: bool) -> str:
        lift = self.lifts.get(number)
        if lift is None:
            status = "unknown"
        elif lift.slipped is None:
            status, lift.slipped = "taken", slipped
            self.unkept.add(number)
            if lift.stable:
                self.ended(slipped=slipped)
            if lift.lesson:
                self.proven += 1
                self.lessons.append((lift.lesson, slipped))
            lift.lesson = None
        else:
            status = "repeated" if lift.slipped is slipped else "contradicts"
        self.told[status] += 1
        return status

    def may_report(self, lift: Lift, peer: Peer) -> bool:
        """True for the owner, by any connection; for the last lifter if no other user owns it."""
        names = [each and (each.routing_id[:16], each.credential) for each in (lift.owner, peer)]
        is_last = self.lifter and (self.lifter.routing_id[:16], self.lifter.credential) == names[1]
        is_heir = lift.owner is None or lift.owner.credential == peer.credential
        return names[0] == names[1] or bool(is_heir and is_last)

    def awaited(self) -> list[int]:
        return [n for n, lift in self.lifts.items() if lift.announced and lift.slipped is None]


class Lifts(RuleBasedStateMachine):
    """Random events for a `Trust`, its controllers, and the `Model` that must agree with it."""

    @initialize(alpha=ALPHAS, most=st.sampled_from((1, 2, 5)))
    def start(self, alpha: float | None, most: int) -> None:
        self.most, self.number, self.late = most, 0, 0
        self.model, self.part = Model(alpha), trust(RiskLimits(alpha, outstanding_max=most))
        self.heard, self.expected = list[object](), list[object]()
        self.part.lifts.on_announced = lambda *told: self.heard.append(told)
        self.save()

    @rule()
    def save(self) -> None:
        """Save the state, from which a restart after a kill continues."""
        for number in self.model.lifts:
            self.part.lifts.keep(named(number))
        self.model.unkept.clear()
        self.disk = encode(self.part.state()), deepcopy(self.model), self.late

    def say(self, number: int, margin: float, *, settles: bool = True) -> None:
        worth = self.part.judge(named(number), sigmoid(margin), margin, inputs(number))
        stable = worth.permission is Permission.ALLOWED and (worth.p_slip or 0.0) < 0.5
        if stable and self.model.alpha is not None:
            assert self.model.budget >= 1.0 - self.model.alpha - 1e-9
            assert len({*self.model.awaited()} - {number}) < self.most
        self.part.note(named(number), worth, stable=stable, judged=settles)
        self.model.judged(number, worth.features, stable=stable, settles=settles)

    @rule(margin=MARGINS, times=st.sampled_from((1, 1, 3)))
    def judge(self, margin: float, times: int = 1) -> None:
        for _ in range(times):
            self.number += 1
            self.say(self.number, margin)

    @rule(margin=MARGINS, back=BACK, settles=st.booleans())
    def judge_again(self, margin: float, back: int, settles: bool) -> None:
        if self.number - back in self.model.lifts:
            self.say(self.number - back, margin, settles=settles)

    @rule(stable=st.booleans(), margin=st.none() | MARGINS)
    def judge_what_cannot_be_assessed(self, stable: bool, margin: float | None) -> None:
        """Note a grasp, `stable` or not, without features; then judge it by `margin`, if any."""
        stable = stable and self.model.alpha is None
        self.number += 1
        self.part.note(named(self.number), Assessment(0), stable=stable)
        self.model.judged(self.number, NOT_ASSESSED, stable=stable, settles=True)
        if margin is not None:
            self.say(self.number, margin)

    @rule(back=BACK, peer=st.sampled_from(PEERS))
    def claim(self, back: int, peer: Peer) -> None:
        lift = self.model.lifts.get(self.number - back)
        user = lift and (lift.owner or peer).credential
        is_free = lift is not None and lift.slipped is None and user == peer.credential
        assert self.part.lifts.claim(named(self.number - back), peer) is is_free
        if lift is not None and is_free:
            lift.owner, self.model.lifter = lift.owner or peer, peer

    @rule()
    def announce(self) -> None:
        self.part.lifts.announce()
        lift = self.model.lifts.get(self.number)
        if lift is None or lift.slipped is not None:
            return
        before = self.model.offered, lift.lesson, lift.announced
        self.model.offered = self.number
        if lift.lesson is not None and self.model.newest[0] == self.number:
            lift.lesson = self.model.newest[1]
        lift.announced = lift.stable
        self.model.announced += lift.announced - before[2]
        self.expected += [(named(self.number), True)] * (
            before != (self.number, lift.lesson, lift.announced)
        )

    @rule(back=st.none() | BACK)
    def take_back(self, back: int | None) -> None:
        number = max(self.model.awaited(), default=0) if back is None else self.number - back
        lift = self.model.lifts.get(number)
        is_open = lift is not None and lift.slipped is None
        grasp = None if back is None else named(number)
        assert self.part.lifts.take_back(grasp) is is_open
        if lift is not None and is_open:
            self.model.announced -= lift.announced
            self.expected += [(named(number), False)] * lift.announced
            lift.announced, lift.owner = False, None

    @rule(back=BACK, slipped=st.booleans())
    def tell(self, back: int, slipped: bool) -> None:
        number = self.number - back
        lift = self.model.lifts.get(number)
        is_late = lift is not None and lift.slipped is None and lift.stable and not lift.announced
        self.late += is_late and slipped
        status = self.part.outcome(named(number), slipped=slipped)
        assert status == self.model.tell(number, slipped=slipped)

    @rule(slipped=st.booleans(), times=st.sampled_from((1, 2, 7)))
    def lift_announced(self, slipped: bool, times: int) -> None:
        for _ in range(times):
            self.judge(-9.0)
            self.announce()
            self.tell(0, slipped)

    @rule()
    def exchange_sensors(self) -> None:
        self.part.sensors_exchanged()
        model = self.model
        model.budget, model.proven, model.lessons = min(model.budget, 5.0), 0, []
        model.newest = 0, b""
        for lift in model.lifts.values():
            lift.lesson = None

    @rule(killed=st.sampled_from((False, False, True)))
    def restart(self, killed: bool) -> None:
        if not killed:
            self.save()
        data, model, self.late = self.disk
        self.model = deepcopy(model)
        self.number = max(self.model.lifts, default=0)
        self.begin(data)
        assert encode(self.part.state()) == data

    def begin(self, data: bytes) -> None:
        self.part = trust(RiskLimits(self.model.alpha, outstanding_max=self.most))
        self.part.restore(decode(data))
        self.part.lifts.on_announced = lambda *told: self.heard.append(told)
        self.model.lifter, self.model.newest, self.model.offered = None, (0, b""), 0

    @rule(alpha=ALPHAS)
    def restart_with_another_risk(self, alpha: float | None) -> None:
        model = self.model
        if alpha != model.alpha:
            model.alpha, model.budget, model.slips, model.announced = alpha, 5.0, [], 0
            for lift in model.lifts.values():
                lift.announced = False
            self.late = 0
        self.begin(encode(self.part.state()))
        self.save()

    @invariant()
    def book_is_as_expected(self) -> None:
        book, model = self.part.lifts, self.model
        stable = [lift for lift in model.lifts.values() if lift.stable]
        assert book.outstanding == sum(lift.slipped is None for lift in stable)
        assert (book.announced, book.awaited) == (model.announced, len(model.awaited()))
        assert (book.unreported, book.told) == (model.unreported, model.told)
        assert self.heard == self.expected
        records = book.state().records
        found = {
            each.id.grasp: Lift(
                each.stable, each.features, each.slipped, each.announced, each.owner
            )
            for each in records
        }
        assert list(found.items()) == list(model.lifts.items())
        for number, lift in model.lifts.items():
            assert book.is_stable(named(number)) is lift.stable
            assert book.is_told(named(number)) is (lift.slipped is not None)
            assert book.is_kept(named(number)) is (number not in model.unkept)

    @invariant()
    def no_slip_is_beyond_the_bound(self) -> None:
        risk, model, out = self.part.risk, self.model, len(self.model.awaited())
        lifts, slips = len(model.slips), sum(model.slips)
        assert (risk.lifts, risk.slips, risk.proven) == (lifts, slips, model.proven)
        assert risk.budget == pytest.approx(model.budget)
        if model.alpha is not None:
            assert risk.bound is not None
            assert slips <= risk.bound + 1e-9
            # At worst all that was announced and not told has slipped.
            allowed = 5.0 + (self.most + self.late) * (1.0 - model.alpha)
            assert slips + out <= model.alpha * (lifts + out) + allowed + 1e-9

    @invariant()
    def owners_and_heirs_may_report(self) -> None:
        book, lifts = self.part.lifts, self.model.lifts
        for peer in PEERS:
            for number, lift in lifts.items():
                assert book.may_report(named(number), peer) is self.model.may_report(lift, peer)
            own = [n for n, each in lifts.items() if each.owner == peer and each.slipped is None]
            assert book.offered(peer) == (named(max(own)) if own else None)

    def teardown(self) -> None:
        """Check that all outcomes with features were learned, and nothing else."""
        learner = Learner(INPUTS)
        for lesson, slipped in self.model.lessons:
            learner.learn(np.frombuffer(lesson, "<f8"), slipped=slipped)
        assert self.part.learner.state() == learner.state()


def test_trust_agrees_with_a_plain_simulation_after_random_events(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    decode(encode(Trust("model", INPUTS).state()))  # later tests read states of the usual size
    monkeypatch.setattr("graspd.daemon.trust.lift_book.LIFTS_MAX", BOOK)
    run_state_machine_as_test(
        Lifts, settings=settings(derandomize=True, max_examples=100, stateful_step_count=50)
    )


def test_the_book_remembers_256_grasps() -> None:
    book = LiftBook()
    for number in range(257):
        book.note(named(number), NOT_ASSESSED, stable=False)
    assert [named(number) in book for number in (0, 1)] == [False, True]
