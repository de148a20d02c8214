"""Whatever comes: a verdict has all that it needs, and no grasp is offered once its end is told."""

from __future__ import annotations

from collections.abc import Sequence

from hypothesis import given, settings
from hypothesis import strategies as st

from graspd.daemon.judge.decision import HandLimits
from graspd.daemon.judge.pipeline import Judgement
from graspd.daemon.judge.reasons import Decision, Reason
from graspd.daemon.trust.lift_book import GraspId, OutcomeStatus
from graspd.daemon.trust.trust import Trust
from graspd.models.trust.risk import RiskLimits
from tests.daemon.judge.felt_hand import HELD, Feel, Hand, begins, feels, gates, tared
from tests.daemon.judge.felt_hand import limits as gate_limits

BOOT = "b" * 32
RISKS = {
    "nothing learns": None,
    "no risk": RiskLimits(),
    "in the warm-up": RiskLimits(0.05, warm_up=50),
    "a risk with all withheld lifts watched": RiskLimits(0.05, explore=1.0),
}


def trusting(gate: HandLimits, limits: RiskLimits | None) -> Hand:
    hand = tared(gate)
    hand.pipeline.boot_id = BOOT
    if limits is not None:
        trust = Trust(hand.model.sha256, 0, limits, learns=False)
        hand.pipeline.trust, hand.pipeline.lifts = trust, trust.lifts
    return hand


def tell(hand: Hand, grasp: int, *, slipped: bool) -> OutcomeStatus:
    return hand.pipeline.outcome(GraspId(BOOT, grasp), slipped=slipped)


def is_offered(said: Judgement) -> bool:
    return said.decision is Decision.STABLE or said.supervised


def test_an_open_hand_is_not_told_to_release_anything() -> None:
    hand = trusting(gate_limits(), None)
    hand.play(HELD)
    tell(hand, 1, slipped=False)
    (*_, said) = hand.play(Feel("rest", times=40))
    assert (said.moment.grasp, said.reasons) == (1, (Reason.NO_CONTACT,))


def test_the_grasp_after_a_told_one_is_offered() -> None:
    hand = trusting(gate_limits(), None)
    hand.play(Feel("faint", times=35))
    tell(hand, 1, slipped=True)
    hand.play(Feel("rest", times=15))
    said = hand.play(Feel("faint", times=35))[-1]
    assert (said.moment.grasp, said.decision) == (2, Decision.STABLE)


def test_an_answer_says_that_its_outcome_is_told() -> None:
    hand = trusting(gate_limits(on_request=True), RISKS["in the warm-up"])
    hand.play(HELD)
    tell(hand, 1, slipped=True)
    (answer,) = [each for each in hand.play(HELD) if each.moment.judged]
    assert (answer.decision, answer.supervised) == (Decision.UNKNOWN, False)
    assert Reason.OUTCOME_TOLD in answer.reasons


outcomes = st.sampled_from([None, None, False, True])
"""Told of the newest grasp before a hand feels what comes next: whether it slipped."""


@given(
    gate=gates,
    limits=st.sampled_from(list(RISKS.values())),
    begin=begins,
    following=st.lists(st.tuples(outcomes, feels), min_size=3, max_size=12),
)
@settings(max_examples=100)
def test_whatever_comes_a_verdict_has_all_it_needs(
    gate: HandLimits,
    limits: RiskLimits | None,
    begin: Sequence[Feel],
    following: Sequence[tuple[bool | None, Feel]],
) -> None:
    hand = trusting(gate, limits)
    told: set[int] = set()
    newest = 0
    for slipped, feel in [*((None, feel) for feel in begin), *following]:
        if slipped is not None and tell(hand, newest, slipped=slipped) is OutcomeStatus.TAKEN:
            told.add(newest)
        for said in hand.play(feel):
            newest = said.moment.grasp
            if newest in told:
                assert not is_offered(said)
                assert Reason.OUTCOME_TOLD in said.reasons or not said.moment.in_contact
    if gate.on_request:
        assert hand.judged <= hand.asked * (2 if gate.gate.early else 1)
