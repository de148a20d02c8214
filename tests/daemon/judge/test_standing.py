"""A verdict has all it needs, follows the network's last answer, and ends with its outcome."""

from __future__ import annotations

import math
from collections.abc import Sequence

from hypothesis import given, settings
from hypothesis import strategies as st

from graspd.daemon.judge.decision import HandLimits
from graspd.daemon.judge.pipeline import Judgement
from graspd.daemon.judge.reasons import Decision, Reason
from graspd.daemon.trust.lift_book import GraspId, OutcomeStatus
from graspd.daemon.trust.trust import Trust
from graspd.drivers.base import ElectrodeFault
from graspd.models.trust.risk import RiskLimits
from tests.daemon.judge.felt_hand import HELD, Feel, Flaw, Hand, begins, feels, gates, tared
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


def test_slip_becomes_stable_only_after_a_second_without_slip() -> None:
    hand = tared(gate_limits())
    assert hand.play(HELD)[-1].decision is Decision.STABLE
    slips = hand.play(Feel(times=10, answer=0.6))
    assert {each.decision for each in slips[5:]} == {Decision.SLIP}
    said = hand.play(Feel(times=200, answer=0.4))
    assert {each.p_slip for each in said[5:]} == {0.4}, "what is told is the newest"
    first = [each.decision for each in said].index(Decision.STABLE)
    assert 95 <= first <= 105
    assert {each.decision for each in said[first:]} == {Decision.STABLE}


def test_a_verdict_is_refreshed_although_values_keep_missing() -> None:
    hand = tared(gate_limits())
    assert hand.play(HELD)[-1].decision is Decision.STABLE
    missing = (Flaw(0, 3, 2, int(ElectrodeFault.MISSING), 0),)
    runs, known = hand.model.runs, 0
    for _ in range(40):  # so no electrode of it ever has three fresh values
        known += hand.play(Feel(flaws=missing))[0].decision is Decision.STABLE
        known += hand.play(Feel())[0].decision is Decision.STABLE
    assert known > 40
    assert hand.model.runs - runs >= 80 * 10 // 110


def test_with_a_risk_answers_around_its_threshold_are_never_stable() -> None:
    hand = trusting(gate_limits(), RiskLimits(0.05))
    trust = hand.pipeline.trust
    assert trust is not None
    theta = 1.0 / (1.0 + math.exp(-trust.risk.threshold))
    said = [
        each
        for number in range(200)
        for each in hand.play(Feel(times=5, answer=theta * (0.9 if number % 3 else 1.1)))
    ]
    stable = [each.decision is Decision.STABLE for each in said]
    assert not any(stable[60:]), "of three judgings two are below the threshold"
    reasons = {reason for each in said[60:] for reason in each.reasons}
    assert Reason.LOW_CONFIDENCE in reasons
    assert trust.report().outstanding <= 1


def test_the_reason_outcome_told_ends_when_the_hand_opens() -> None:
    hand = trusting(gate_limits(), None)
    hand.play(HELD)
    tell(hand, 1, slipped=False)
    (*_, said) = hand.play(Feel("rest", times=40))
    assert (said.moment.grasp, said.reasons) == (1, (Reason.NO_CONTACT,))


def test_a_slip_does_not_keep_the_next_grasp_from_stable() -> None:
    hand = trusting(gate_limits(), None)
    hand.play(Feel("faint", times=35, answer=0.9))
    tell(hand, 1, slipped=True)
    hand.play(Feel("rest", times=15))
    said = hand.play(Feel("faint", times=35))
    assert (said[-1].moment.grasp, said[-1].decision) == (2, Decision.STABLE)
    assert Decision.SLIP not in {each.decision for each in said}


outcomes = st.sampled_from([None, None, False, True])
"""Outcome reported of the newest grasp before the next readings: True: it slipped; None: none."""


@given(
    gate=gates,
    limits=st.sampled_from(list(RISKS.values())),
    begin=begins,
    following=st.lists(st.tuples(outcomes, feels), min_size=3, max_size=12),
)
@settings(max_examples=100)
def test_after_any_readings_and_outcomes_verdicts_have_what_they_need(
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
