"""The bound on slips among stable lifts: against adversaries, late outcomes, and arithmetic."""

from __future__ import annotations

import math
from collections.abc import Callable

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from daemon.trust.trust import LOWEST, Permission, Risk, RiskLimits, RiskState

ALPHAS = (0.001, 0.01, 0.02, 0.05, 0.1, 0.25, 0.3, 0.5)
ROUNDING = 1e-9


def risk(alpha: float | None = 0.05, warm_up: int = 0, explore: float = 0.0) -> Risk:
    return Risk(RiskLimits(alpha, warm_up, explore))


def bound(alpha: float, lifts: int) -> float:
    """As the design states it, where the start lies between the lowest log-odds and zero."""
    start = min(max(math.log(2 * alpha / (1 - 2 * alpha)) if alpha < 0.5 else 0.0, -6.0), 0.0)
    return alpha * lifts + (start + 6.0) + 1.0 - alpha


def lift(rule: Risk, log_odds: float, slips: Callable[[bool], bool]) -> bool:
    """A lift whose outcome is told at once; returns whether it was called stable."""
    stable = rule.decide(log_odds) is Permission.ALLOWED
    rule.take(stable=stable, slipped=slips(stable), proves=True)
    return stable


def test_the_published_bound_at_five_percent_is_4_75_above_the_share() -> None:
    rule = risk(0.05)
    assert rule.bound == pytest.approx(4.75, abs=0.005)
    assert rule.start == pytest.approx(math.log(0.1 / 0.9))


@pytest.mark.parametrize("alpha", ALPHAS)
@pytest.mark.parametrize("log_odds", [-1e9, LOWEST, -4.0, -1.0, 0.0])
def test_an_adversary_that_slips_when_told_stable_ends_below_the_bound_and_is_silenced(
    alpha: float, log_odds: float
) -> None:
    rule = risk(alpha)
    for _ in range(1000):
        lift(rule, log_odds, lambda stable: stable)
        assert rule.slips <= bound(alpha, rule.lifts) + ROUNDING
    assert rule.bound == pytest.approx(bound(alpha, rule.lifts))
    assert rule.slips == rule.lifts <= 15
    if log_odds <= LOWEST:
        assert rule.decide(log_odds) is Permission.RISK_EXCEEDED
        # All that the bound allows is used but for less than one slip and what it costs.
        assert rule.slips > bound(alpha, rule.lifts) - 1.0


@pytest.mark.parametrize("alpha", ALPHAS)
def test_in_the_long_run_the_share_is_the_one_that_was_set(alpha: float) -> None:
    # An adversary that holds just long enough to be believed again.
    rule = risk(alpha)
    for _ in range(20_000):
        lift(rule, -5.5, lambda stable: stable and rule.theta >= LOWEST + 1.0)
    assert rule.slips <= bound(alpha, rule.lifts) + ROUNDING
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
        assert rule.theta <= 0.0


@settings(max_examples=200)
@given(st.floats(0.001, 0.5), st.lists(st.tuples(st.floats(-10.0, 3.0), st.booleans())))
def test_with_each_outcome_told_at_once_the_bound_is_the_published_one(
    alpha: float, steps: list[tuple[float, bool]]
) -> None:
    rule = risk(alpha)
    for log_odds, slipped in steps:
        stable = rule.decide(log_odds) is Permission.ALLOWED
        rule.take(stable=stable, slipped=slipped, proves=True)
        assert rule.overdue <= 1
        assert rule.bound == pytest.approx(bound(alpha, rule.lifts))
        assert rule.slips <= bound(alpha, rule.lifts) + ROUNDING


def test_every_stable_lift_that_was_out_when_the_rule_fell_silent_adds_one() -> None:
    rule = risk(0.05)
    assert rule.bound == pytest.approx(bound(0.05, 0))
    assert all(rule.decide(-9.0) is Permission.ALLOWED for _ in range(20))  # none told yet
    for _ in range(20):
        rule.take(stable=True, slipped=True, proves=True)
    assert rule.slips == 20
    assert rule.slips > bound(0.05, 20)
    assert rule.bound is not None
    assert rule.slips <= rule.bound <= bound(0.05, 20) + 20
    assert rule.decide(-9.0) is Permission.RISK_EXCEEDED


def test_nothing_is_stable_any_more_once_the_risk_is_exceeded() -> None:
    rule = risk(0.05)
    while lift(rule, -20.0, lambda _: True):
        pass
    for _ in range(1000):
        assert rule.decide(-1e9) is Permission.RISK_EXCEEDED
        rule.take(stable=False, slipped=False, proves=True)


def test_stable_is_said_only_up_to_theta_and_never_of_what_is_no_number() -> None:
    rule = risk(0.05)
    assert rule.decide(rule.theta) is Permission.ALLOWED
    assert rule.decide(math.nextafter(rule.theta, 0.0)) is Permission.WITHHELD
    assert rule.decide(math.nan) is Permission.WITHHELD
    for _ in range(200):
        lift(rule, -5.0, lambda _: False)
    assert rule.theta == 0.0
    assert rule.decide(0.1) is Permission.WITHHELD


def test_without_a_risk_all_is_allowed_and_counted() -> None:
    rule = risk(None)
    for slipped in (True, True, False):
        assert rule.decide(2.0) is Permission.ALLOWED
        rule.take(stable=True, slipped=slipped, proves=True)
    assert (rule.lifts, rule.slips, rule.bound, rule.theta) == (3, 2, None, 0.0)


def test_in_the_warm_up_what_is_not_surely_stable_is_unproven_and_to_be_lifted() -> None:
    rule = risk(0.05, warm_up=3)
    for left in (3, 2, 1):
        assert rule.warm_up_left == left
        assert rule.decide(-1.0) is Permission.UNPROVEN
        assert rule.decide(math.nan) is Permission.UNPROVEN
        assert rule.decide(rule.start) is Permission.ALLOWED
        assert rule.supervised(Permission.UNPROVEN, "boot", left)
        rule.take(stable=False, slipped=False, proves=True)
    assert rule.decide(-1.0) is Permission.WITHHELD
    rule.exchanged()
    assert rule.decide(-1.0) is Permission.UNPROVEN
    rule.take(stable=True, slipped=True, proves=False)  # a lift with the former sensor
    assert (rule.warm_up_left, rule.slips) == (3, 1)


def test_so_many_of_the_others_are_to_be_lifted_under_supervision() -> None:
    rule, none = risk(0.05, explore=0.05), risk(0.05)
    chosen = [rule.supervised(Permission.WITHHELD, "boot", grasp) for grasp in range(20_000)]
    # Three standard deviations of so many draws.
    assert abs(sum(chosen) / 20_000 - 0.05) < 3 * math.sqrt(0.05 * 0.95 / 20_000)
    assert chosen == [rule.supervised(Permission.WITHHELD, "boot", n) for n in range(20_000)]
    assert chosen != [rule.supervised(Permission.WITHHELD, "next", n) for n in range(20_000)]
    for permission in (Permission.ALLOWED, Permission.RISK_EXCEEDED):
        assert not any(rule.supervised(permission, "boot", n) for n in range(1000))
    assert not any(none.supervised(Permission.WITHHELD, "boot", n) for n in range(1000))


def test_an_exchange_of_a_sensor_does_not_make_the_rule_more_generous() -> None:
    rule = risk(0.05)
    for _ in range(60):
        lift(rule, -5.0, lambda _: False)
    assert rule.theta == 0.0
    rule.exchanged()
    assert (rule.theta, rule.lifts) == (rule.start, 60)
    lift(rule, -5.0, lambda _: True)
    lowered = rule.theta
    rule.exchanged()
    assert rule.theta == lowered < rule.start


@pytest.mark.parametrize(
    "limits",
    [{"max_slip_when_stable": alpha} for alpha in (0.0, -0.1, 0.0009, 0.51, math.nan)]
    + [{"warm_up": -1}, {"explore": -0.1}, {"explore": 1.1}, {"explore": math.nan}],
)
def test_limits_that_make_no_sense_are_refused(limits: dict[str, float]) -> None:
    with pytest.raises(ValueError, match="must"):
        RiskLimits(**limits)  # type: ignore[arg-type]


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
        lift(rule, -5.0, lambda _: True)
    other.restore(rule.state())
    assert (other.lifts, other.slips, other.theta, other.proven) == (0, 0, other.start, 12)


@pytest.mark.parametrize(
    "state",
    [
        RiskState(0.05, -2.0, 0, 0, 0, 0),  # above the start
        RiskState(0.05, 0.1, 200, 0, 0, 200),
        RiskState(0.05, -2.0, 5, 3, 0, 5),
        RiskState(0.05, -7.1, 9, 9, 1, 9),
        RiskState(0.05, math.nan, 9, 3, 0, 9),
        RiskState(0.05, -3.0, 3, 4, 0, 9),
        RiskState(0.05, -8.0, 3, 3, 4, 9),
        RiskState(None, -1.0, 3, 3, 0, 9),
    ],
)
def test_a_state_that_no_outcomes_lead_to_is_refused(state: RiskState) -> None:
    rule = risk(state.max_slip_when_stable)
    before = rule.state()
    with pytest.raises(ValueError, match=r"threshold|more slips"):
        rule.restore(state)
    assert rule.state() == before
