"""The bounds on slips among stable lifts: against adversaries, late outcomes, and arithmetic."""

from __future__ import annotations

import math
from collections.abc import Callable

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from graspd.models.trust.risk import Permission, Risk, RiskLimits, RiskState

ALPHAS = (0.001, 0.01, 0.02, 0.05, 0.1, 0.25, 0.3, 0.5)
ROUNDING = 1e-6
START, MOST = 5.0, 8.0
"""Slips beyond the share, as the design states them: of all lifts, and of a stretch."""


def risk(alpha: float | None = 0.05, warm_up: int = 0, explore: float = 0.0) -> Risk:
    return Risk(RiskLimits(alpha, warm_up, explore))


def lift(rule: Risk, log_odds: float, slips: Callable[[bool], bool]) -> bool:
    """A lift whose outcome is told at once; returns whether it was called stable."""
    stable = rule.decide(log_odds) is Permission.ALLOWED
    rule.take(stable=stable, slipped=slips(stable), proves=True)
    return stable


@pytest.mark.parametrize("alpha", ALPHAS)
@pytest.mark.parametrize("log_odds", [-1e9, -6.0, -4.0, -1.0, 0.0])
def test_an_adversary_that_slips_when_told_stable_is_silenced(
    alpha: float, log_odds: float
) -> None:
    rule = risk(alpha)
    for _ in range(1000):
        lift(rule, log_odds, lambda stable: stable)
        assert rule.slips <= alpha * rule.lifts + START + ROUNDING
    assert rule.bound == pytest.approx(alpha * rule.lifts + START)
    assert rule.slips == rule.lifts <= 9
    if log_odds == -1e9:
        assert rule.decide(log_odds) is Permission.RISK_EXCEEDED
        # Less than one slip is left, and what it costs.
        assert rule.slips > alpha * rule.lifts + START - 1.0


@pytest.mark.parametrize("alpha", ALPHAS)
def test_in_the_long_run_the_share_is_as_set(alpha: float) -> None:
    # An adversary that holds just long enough to be believed again.
    rule = risk(alpha)
    for _ in range(20_000):
        lift(rule, -20.0, lambda stable: stable and rule.budget >= 2.0)
    assert rule.slips <= alpha * rule.lifts + START + ROUNDING
    if 0.01 <= alpha <= 0.3:
        assert rule.slips / rule.lifts > 0.8 * alpha


STEPS = st.lists(
    st.tuples(
        st.floats(-10.0, 3.0),
        st.sampled_from(("as told", "against", "slip", "hold", "late", "never")),
    ),
    max_size=150,
)


@settings(max_examples=300)
@given(st.floats(0.001, 0.5), STEPS)
def test_no_sequence_breaks_the_bound(alpha: float, steps: list[tuple[float, str]]) -> None:
    rule, out = risk(alpha), 0
    slips = lifts = 0
    for log_odds, how in steps:
        stable = rule.decide(log_odds) is Permission.ALLOWED
        if how in ("late", "never"):
            out += stable
        else:
            slipped = {"as told": not stable, "against": stable, "slip": True, "hold": False}[how]
            rule.take(stable=stable, slipped=slipped, proves=True)
            slips, lifts = slips + (stable and slipped), lifts + stable
        if how == "never" and out:
            # What is still out comes now, and all of it has slipped.
            before, waiting = rule.bound, out
            assert before is not None
            for _ in range(waiting):
                rule.take(stable=True, slipped=True, proves=True)
            slips, lifts, out = slips + waiting, lifts + waiting, 0
            assert rule.slips <= before + waiting + ROUNDING
        assert (rule.slips, rule.lifts) == (slips, lifts)
        assert rule.bound is not None
        assert rule.slips <= rule.bound + ROUNDING
        assert rule.threshold <= 0.0


@settings(max_examples=200)
@given(st.floats(0.001, 0.5), st.lists(st.tuples(st.floats(-10.0, 3.0), st.booleans())))
def test_with_each_outcome_told_at_once_every_stretch_is_bounded(
    alpha: float, steps: list[tuple[float, bool]]
) -> None:
    rule, stretch = risk(alpha), 0.0
    for log_odds, slipped in steps:
        if lift(rule, log_odds, lambda _, slipped=slipped: slipped):  # type: ignore[misc]
            stretch = max(stretch + slipped - alpha, 0.0)  # the worst one that ends here
        assert stretch <= MOST + ROUNDING
        assert rule.slips <= alpha * rule.lifts + START + ROUNDING
        assert rule.bound == pytest.approx(alpha * rule.lifts + START)


def test_each_outstanding_stable_lift_adds_one_slip_at_most() -> None:
    rule = risk(0.05)
    assert all(rule.decide(-9.0) is Permission.ALLOWED for _ in range(20))  # none told yet
    for _ in range(20):
        rule.take(stable=True, slipped=True, proves=True)
    assert rule.slips == 20 > 0.05 * 20 + START
    assert rule.bound == pytest.approx(20.0)
    assert rule.decide(-1e9) is Permission.RISK_EXCEEDED


def test_no_more_than_the_most_is_saved_up() -> None:
    rule = risk(0.5)
    for _ in range(100):
        lift(rule, -20.0, lambda _: False)
    assert rule.budget == pytest.approx(MOST)


def test_the_threshold_rises_with_outcomes_and_falls_with_the_budget() -> None:
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


def test_stable_needs_a_number_up_to_the_threshold() -> None:
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
    assert risk(None).decide(-9.0, awaited=99) is Permission.ALLOWED


def test_without_a_risk_all_is_allowed_and_counted() -> None:
    rule = risk(None)
    for slipped in (True, True, False):
        assert rule.decide(2.0) is Permission.ALLOWED
        rule.take(stable=True, slipped=slipped, proves=True)
    rule.take_untold()
    assert (rule.lifts, rule.slips, rule.bound, rule.budget) == (3, 2, None, START)


def test_the_warm_up_asks_for_lifts_of_unsure_grasps() -> None:
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
def test_sensors_that_return_add_nothing_to_the_budget(known: float | None, left: float) -> None:
    """Two of two lifts slip under a share of 0.1: 3.2 of 5 slips are left."""
    rule = risk(0.1)
    for _ in range(2):
        rule.take(stable=True, slipped=True, proves=True)
    rule.exchanged(7, known)
    assert (rule.proven, rule.slips) == (7, 2)
    assert rule.budget == pytest.approx(left)
    risk(0.1).restore(rule.state())


def test_a_share_of_withheld_grasps_is_lifted_under_supervision() -> None:
    rule, none = risk(0.05, explore=0.05), risk(0.05)
    chosen = [rule.supervised(Permission.WITHHELD, "boot", grasp) for grasp in range(20_000)]
    # Three standard deviations of so many draws.
    assert abs(sum(chosen) / 20_000 - 0.05) < 3 * math.sqrt(0.05 * 0.95 / 20_000)
    assert chosen == [rule.supervised(Permission.WITHHELD, "boot", n) for n in range(20_000)]
    assert chosen != [rule.supervised(Permission.WITHHELD, "next", n) for n in range(20_000)]
    for permission in (Permission.ALLOWED, Permission.RISK_EXCEEDED):
        assert not any(rule.supervised(permission, "boot", n) for n in range(1000))
    assert not any(none.supervised(Permission.WITHHELD, "boot", n) for n in range(1000))


def test_an_exchange_of_sensors_makes_no_rule_more_generous() -> None:
    rule = risk(0.05)
    for _ in range(60):
        lift(rule, -9.0, lambda _: False)
    assert rule.budget == pytest.approx(MOST)
    rule.exchanged()
    assert (rule.budget, rule.lifts) == (START, 60)
    lift(rule, -9.0, lambda _: True)
    lowered = rule.budget
    rule.exchanged()
    assert rule.budget == lowered < START


@settings(max_examples=100)
@given(st.floats(0.001, 0.5), STEPS)
def test_any_state_that_a_rule_has_can_be_restored(
    alpha: float, steps: list[tuple[float, str]]
) -> None:
    rule = risk(alpha, warm_up=2)
    for index, (log_odds, how) in enumerate(steps):
        stable = rule.decide(log_odds) is Permission.ALLOWED
        rule.take(stable=stable or how == "late", slipped=how != "hold", proves=index % 2 == 0)
        if how == "never":
            rule.exchanged()
    other = risk(alpha, warm_up=2)
    other.restore(rule.state())
    assert other.state() == rule.state()


def test_with_another_risk_the_counting_begins_anew() -> None:
    rule, other = risk(0.05, warm_up=9), risk(0.1, warm_up=9)
    for _ in range(12):
        lift(rule, -9.0, lambda _: True)
    other.restore(rule.state())
    assert (other.lifts, other.slips, other.budget, other.proven) == (0, 0, START, 12)


@pytest.mark.parametrize(
    "state",
    [
        RiskState(0.05, 0, 0, 0, 5.1),  # above the start
        RiskState(0.05, 200, 0, 200, 8.1),
        RiskState(0.05, 5, 3, 5, 2.3),
        RiskState(0.05, 9, 9, 9, -9.1),
        RiskState(0.05, 9, 3, 9, math.nan),
        RiskState(0.05, 3, 4, 9, 1.0),
    ],
)
def test_a_state_that_no_outcomes_lead_to_is_refused(state: RiskState) -> None:
    rule = risk(state.max_slip_when_stable)
    before = rule.state()
    with pytest.raises(ValueError, match=r"budget|more slips"):
        rule.restore(state)
    assert rule.state() == before
