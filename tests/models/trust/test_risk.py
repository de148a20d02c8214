"""The rule of risk by itself; tests/daemon/trust/test_lifts.py has outcomes in any order."""

from __future__ import annotations

import math
from collections.abc import Callable

import pytest

from graspd.models.trust.risk import Permission, Risk, RiskLimits, RiskState

ALPHAS = (0.001, 0.01, 0.02, 0.05, 0.1, 0.25, 0.3, 0.5)
ROUNDING = 1e-6
START = 5.0
"""Number of slips that are allowed beyond the share."""


def risk(alpha: float | None = 0.05, warm_up: int = 0, explore: float = 0.0) -> Risk:
    return Risk(RiskLimits(alpha, warm_up, explore))


def lift(rule: Risk, log_odds: float, slips: Callable[[bool], bool]) -> bool:
    """Take in a lift's outcome at once; return whether it was called stable.

    `slips`: function that returns the outcome for this answer.
    """
    stable = rule.decide(log_odds) is Permission.ALLOWED
    rule.take(stable=stable, slipped=slips(stable), proves=True)
    return stable


@pytest.mark.parametrize("alpha", ALPHAS)
def test_stable_ends_within_nine_lifts_if_all_of_them_slip(alpha: float) -> None:
    rule = risk(alpha)
    for _ in range(1000):
        lift(rule, -1e9, lambda stable: stable)
        assert rule.slips <= alpha * rule.lifts + START + ROUNDING
        assert rule.bound == pytest.approx(alpha * rule.lifts + START)
        assert rule.figures(0, 0, 0).beyond_share == pytest.approx(START)
    assert rule.slips == rule.lifts <= 9
    assert rule.decide(-1e9) is Permission.RISK_EXCEEDED
    # Less than one slip is left, and what it costs.
    assert rule.slips > alpha * rule.lifts + START - 1.0


def test_over_many_lifts_the_slip_share_nears_the_allowed_one() -> None:
    # An adversary that holds just long enough to be believed again.
    rule = risk(0.05)
    for _ in range(20_000):
        lift(rule, -20.0, lambda stable: stable and rule.budget >= 2.0)
    assert rule.slips / rule.lifts > 0.8 * 0.05


def test_outcomes_raise_the_threshold_and_a_spent_budget_lowers_it() -> None:
    rule = risk(0.05)

    def probability() -> float:
        return 1.0 / (1.0 + math.exp(-rule.threshold))

    assert probability() == pytest.approx(1.5 * 0.05)
    for _ in range(20):
        rule.take(stable=False, slipped=True, proves=True)
    assert probability() == pytest.approx(2.25 * 0.05)
    for _ in range(80):
        rule.take(stable=False, slipped=False, proves=True)
    assert probability() == pytest.approx(3.0 * 0.05)
    rule.take(stable=True, slipped=True, proves=True)
    # The odds, 15 to 85, shrink with what is left over one slip: 3.1 of 4.05.
    assert probability() == pytest.approx(1.0 / (1.0 + 85.0 / 15.0 * 4.05 / 3.1))


def test_only_log_odds_up_to_the_threshold_are_allowed() -> None:
    rule = risk(0.05)
    assert rule.decide(rule.threshold) is Permission.ALLOWED
    assert rule.decide(math.nextafter(rule.threshold, 0.0)) is Permission.WITHHELD
    assert rule.decide(math.nan) is Permission.WITHHELD
    generous = risk(0.5)
    for _ in range(200):
        lift(generous, -5.0, lambda _: False)
    assert generous.threshold == 0.0
    assert generous.decide(0.1) is Permission.WITHHELD


def test_too_many_outstanding_announced_lifts_make_the_next_unproven() -> None:
    rule = Risk(RiskLimits(0.05, outstanding_max=2))
    assert rule.decide(-9.0, awaited=1) is Permission.ALLOWED
    assert rule.decide(-9.0, awaited=2) is Permission.UNPROVEN
    assert rule.decide(-0.1, awaited=2) is Permission.WITHHELD
    assert risk().decide(-9.0, awaited=4) is Permission.ALLOWED, "five by default"
    assert risk().decide(-9.0, awaited=5) is Permission.UNPROVEN
    assert Risk(RiskLimits(0.05, outstanding_max=1)).decide(-9.0) is Permission.ALLOWED
    assert risk(None).decide(-9.0, awaited=99) is Permission.ALLOWED
    assert risk(None).figures(0, 0, 0).beyond_share == 0.0


def test_the_warm_up_requests_supervised_lifts_of_unsure_grasps() -> None:
    rule = risk(0.05, warm_up=3)
    for left in (3, 2, 1):
        assert rule.warm_up_left == left
        assert rule.decide(-1.0) is Permission.UNPROVEN
        assert rule.decide(math.nan) is Permission.UNPROVEN
        assert rule.decide(rule.threshold) is Permission.ALLOWED
        assert rule.supervised(Permission.UNPROVEN, "boot", left)
        rule.take(stable=False, slipped=False, proves=True)
    assert rule.decide(-1.0) is Permission.WITHHELD
    rule.exchanged()
    assert rule.decide(-1.0) is Permission.UNPROVEN
    rule.take(stable=True, slipped=True, proves=False)  # a lift with the former sensor
    assert (rule.warm_up_left, rule.slips) == (3, 1)


@pytest.mark.parametrize(("known", "left"), [(1.5, 1.5), (-9.0, -2.0), (8.0, 3.2), (None, 3.2)])
def test_an_exchange_may_lower_but_never_raises_the_budget(
    known: float | None, left: float
) -> None:
    """Two of two lifts slip under a share of 0.1: 3.2 of 5 slips are left."""
    rule = risk(0.1)
    for _ in range(2):
        rule.take(stable=True, slipped=True, proves=True)
    rule.exchanged(7, known)
    assert (rule.proven, rule.slips) == (7, 2)
    assert rule.budget == pytest.approx(left)
    risk(0.1).restore(rule.state())


def test_a_share_of_withheld_grasps_is_lifted_under_supervision() -> None:
    rule, none = risk(0.05, explore=0.05), Risk(RiskLimits(0.05))
    chosen = [rule.supervised(Permission.WITHHELD, "boot", grasp) for grasp in range(20_000)]
    # Three standard deviations of the draws.
    assert abs(sum(chosen) / 20_000 - 0.05) < 3 * math.sqrt(0.05 * 0.95 / 20_000)
    assert chosen == [rule.supervised(Permission.WITHHELD, "boot", n) for n in range(20_000)]
    assert chosen != [rule.supervised(Permission.WITHHELD, "next", n) for n in range(20_000)]
    for permission in (Permission.ALLOWED, Permission.RISK_EXCEEDED):
        assert not any(rule.supervised(permission, "boot", n) for n in range(1000))
    assert not any(none.supervised(Permission.WITHHELD, "boot", n) for n in range(1000))


@pytest.mark.parametrize(
    "state",
    [
        RiskState(0.05, 0, 0, 0, 5.1),  # above the start
        RiskState(0.05, 200, 0, 200, 8.1),
        RiskState(0.05, 5, 3, 5, 2.3),
        RiskState(0.05, 9, 9, 9, -9.1),
        RiskState(0.05, 9, 3, 9, math.nan),
        RiskState(0.05, 3, 4, 9, 1.0),
        RiskState(None, 0, 0, 0, 5.1),
    ],
)
def test_a_state_that_no_outcomes_lead_to_is_refused(state: RiskState) -> None:
    rule = risk(state.max_slip_when_stable)
    before = rule.state()
    with pytest.raises(ValueError, match=r"budget|more slips"):
        rule.restore(state)
    assert rule.state() == before
    for taken in (RiskState(0.05, 0, 0, 0, 5.0), RiskState(0.05, 9, 9, 9, -9.0)):
        rule = risk(0.05)
        rule.restore(taken)
        assert rule.state() == taken
