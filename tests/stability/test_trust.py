"""What a session and outcomes teach and what a risk allows, under streams made up for the worst.

The statistics of a session that has lasted for a billion grasps are compared with a closed form,
the rule's budget with fractions.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from fractions import Fraction
from itertools import islice

import numpy as np
import pytest
from numpy.typing import NDArray

from graspd.models.session_statistics import HORIZON_GRASPS, SessionState, SessionStatistics
from graspd.models.trust.learner import Learner
from graspd.models.trust.risk import Permission, Risk, RiskLimits

Note = Callable[..., None]
Random = np.random.Generator
Outcome = tuple[float, NDArray[np.float64], bool]
"""Margin, inputs, whether it slipped."""
INPUTS = 78
"""A session's features of the whole hand: the largest learner there is."""
CLIP, INPUT_MAX = 3.0, 1000.0
"""Limits of a session's features, and of what the learner takes."""
MEAN_MAX, DRIFT = 25.0, 2e-3
GRASPS = 128
"""Told grasps with a residual."""
PRIOR = np.array([*np.array([0.5, 0.5, *[0.2] * INPUTS]) ** 2, *[9.009] * GRASPS])
"""Variances of the weights (of the margin, the bias and the features) and of the residual."""
CHECKS = 100
"""How often the covariance is looked at during the longest stream."""
ERROR_MAX = 1e-6
"""Slips. A bound is a sum of shares."""
EIGENVALUE_MIN = 0.99 * DRIFT * 0.009
"""What the learner's docstring derives, with room for rounding."""
LIFTS = 20_000
BUDGET_ERROR_MAX = 1e-9
"""Slips. A lift rounds by 1e-15."""

WIDTH = 24
UPDATES = 4000
"""At full weight 2e-6 of what was before is left after them, and of its rounding too."""
SESSION_ERROR_MAX = 1e-10
"""Largest relative error of a mean or spread. One update rounds by 1e-16, and 301 of them add up
before they have faded."""
SPIKE_AT = 3900
"""Update with the spike, so late that its weight is still there at the end."""
STILL, CLOSE, SPIKED = 0, 1, 2
"""Columns: an electrode that never moves, one at 4000 +- 0.5 counts, one with a spike."""
PRIOR_MEAN, PRIOR_SPREAD = 2000.0, 300.0


def varied(random: Random) -> Iterator[Outcome]:
    while True:
        inputs = random.normal(0.0, 1.0, INPUTS).clip(-CLIP, CLIP)
        yield float(random.normal(0.0, 2.0)), inputs, bool(inputs[0] + random.normal() > 0.0)


def constant(random: Random) -> Iterator[Outcome]:
    while True:
        yield 1.0, np.full(INPUTS, 0.5), bool(random.random() < 0.5)


def at(limit: float, margin: float) -> Callable[[Random], Iterator[Outcome]]:
    def stream(random: Random) -> Iterator[Outcome]:
        while True:
            said = float(random.choice((-margin, margin)))
            yield said, random.choice((-limit, limit), INPUTS), bool(random.random() < 0.5)

    return stream


def contradicting(random: Random) -> Iterator[Outcome]:
    inputs = random.uniform(-CLIP, CLIP, INPUTS)
    while True:
        yield 5.0, inputs, True
        yield 5.0, inputs, False


def against_the_margin(random: Random) -> Iterator[Outcome]:
    while True:
        yield -30.0, CLIP * np.eye(INPUTS)[random.integers(INPUTS)], True


STREAMS: dict[str, Callable[[Random], Iterator[Outcome]]] = {
    "varied": varied,
    "constant features": constant,
    "features at the clip": at(CLIP, 1e9),
    "features at the largest that is taken": at(INPUT_MAX, 1e300),
    "contradicting labels": contradicting,
    "labels against the surest margin": against_the_margin,
}


def test_the_learner_stays_bounded_and_positive_definite(
    note: Note, request: pytest.FixtureRequest
) -> None:
    outcomes: int = request.config.getoption("outcomes")
    random, learner = np.random.default_rng(0), Learner(INPUTS)
    streams = [stream(random) for stream in STREAMS.values()]
    eigenvalues, variances, means, symmetric = [], [], [], True
    for check in range(CHECKS):
        for margin, inputs, slipped in islice(streams[check % len(streams)], outcomes // CHECKS):
            learner.learn(learner.judge(margin, inputs)[1], slipped=slipped)
        state = learner.state()
        size = len(state.mean) // 8
        covariance = np.frombuffer(state.covariance, "<f8").reshape(size, size)
        symmetric &= bool((covariance == covariance.T).all())
        eigenvalues.append(float(np.linalg.eigvalsh(covariance)[0]))
        variances.append(float((covariance.diagonal() / PRIOR[:size]).max()))
        means.append(float(np.abs(np.frombuffer(state.mean, "<f8")).max()))
    note(
        step=f"learner, {outcomes:.0e} outcomes, all of these in turns",
        expected=f"symmetric, eigenvalues from {EIGENVALUE_MIN:.1e} on, variances within the "
        f"prior's, means within {MEAN_MAX:g}",
        found=f"{'symmetric' if symmetric else 'not symmetric'}, from {min(eigenvalues):.2e} on, "
        f"{max(variances):.6f} of the prior's, {max(means):.1f}",
    )
    assert symmetric
    assert min(eigenvalues) >= EIGENVALUE_MIN
    assert max(variances) <= 1 + 1e-12
    assert max(means) <= MEAN_MAX
    Learner(INPUTS).restore(learner.state())  # raises for a state that no outcomes lead to


@pytest.mark.parametrize("alpha", [0.001, 0.003, 0.01, 0.02, 0.05, 0.1, 0.2, 0.3, 0.5])
def test_no_adversary_slips_beyond_the_bound(note: Note, alpha: float) -> None:
    worst = max(
        beyond_the_bound(alpha, late, slips_from) for late in (1, 20) for slips_from in (1.0, 2.0)
    )
    note(
        step=f"risk of {alpha:g} against adversaries, {LIFTS} grasps each",
        expected="slips within the bound at every moment",
        found=f"nearest {worst:+.2f} slips",
    )
    assert worst <= ERROR_MAX


def beyond_the_bound(alpha: float, late: int, slips_from: float) -> float:
    """Return the most slips beyond the bound, by an adversary that knows the rule and its budget.

    It lifts the surest grasps, which hold until the budget is at `slips_from` and slip from then
    on. Outcomes come `late` at a time.
    """
    rule, worst, waiting = Risk(RiskLimits(alpha)), -math.inf, list[bool]()
    for _ in range(LIFTS):
        allowed = rule.decide(-math.inf) is Permission.ALLOWED
        if allowed:
            waiting.append(rule.budget >= slips_from)
        elif not waiting:
            break  # silent for ever
        if len(waiting) == late or not allowed:
            for slipped in waiting:
                rule.take(stable=True, slipped=slipped, proves=True)
                worst = max(worst, rule.slips - (rule.bound or 0.0))
            waiting = []
    return worst


def test_the_budget_is_that_of_fractions(note: Note) -> None:
    random, worst = np.random.default_rng(0), 0.0
    for alpha in (0.001, 0.05, 0.5):
        rule = Risk(RiskLimits(alpha))
        budget = Fraction(rule.budget)
        for unlucky in (random.random(LIFTS) < 1.2 * alpha).tolist():
            slipped = unlucky and rule.decide(-math.inf) is Permission.ALLOWED
            rule.take(stable=True, slipped=slipped, proves=True)
            budget = min(budget + Fraction(alpha) - slipped, Fraction(8))
            worst = max(worst, abs(float(Fraction(rule.budget) - budget)))
    note(
        step=f"risk, budget after {LIFTS} lifts",
        expected=f"of fractions to {BUDGET_ERROR_MAX:.0e}",
        found=f"{worst:.1e}",
    )
    assert worst <= BUDGET_ERROR_MAX


@pytest.mark.parametrize(("name", "spike"), [("1e9 updates", None), ("a spike of 1e6", 1e6)])
def test_mean_and_spread_are_those_of_the_closed_form(
    note: Note, name: str, spike: float | None
) -> None:
    random = np.random.default_rng(0)
    values = random.integers(0, 4096, (UPDATES, WIDTH)).astype(np.float64)
    values[:, STILL] = 2000.0
    values[:, CLOSE] = 4000.0 + random.choice((-0.5, 0.5), UPDATES)
    if spike is not None:
        values[SPIKE_AT, SPIKED] = spike
    statistics = SessionStatistics(np.full(WIDTH, PRIOR_MEAN), np.full(WIDTH, PRIOR_SPREAD))
    first = tuple(values[0].tolist())
    statistics.restore(SessionState(HORIZON_GRASPS, 10**9, first, (0.0,) * WIDTH))
    for row in values:
        statistics.observe(row)
    mean, spread = closed_form(values)
    mean_error = np.abs(statistics.mean / mean - 1.0).max()
    error = float(max(mean_error, np.abs(statistics.spread / spread - 1.0).max()))
    note(
        step=f"session statistics, {name}",
        expected=f"mean and spread to {SESSION_ERROR_MAX:.0e}",
        found=f"{error:.1e}",
    )
    assert error <= SESSION_ERROR_MAX


def closed_form(
    values: NDArray[np.float64],
) -> tuple[NDArray[np.longdouble], NDArray[np.longdouble]]:
    """Weighted mean and spread: a grasp weighs 300/301 of what it did, with each after it."""
    horizon = np.longdouble(HORIZON_GRASPS)
    fade = horizon / (horizon + 1)
    weights = fade ** np.arange(len(values), 0, -1).astype(np.longdouble)
    exact = values.astype(np.longdouble)
    first, first_weight = exact[0], horizon * fade ** np.longdouble(len(values))
    mean = (first_weight * first + weights @ exact) / horizon
    squares = first_weight * (first - mean) ** 2 + weights @ (exact - mean) ** 2
    total = horizon + 1
    return (PRIOR_MEAN + horizon * mean) / total, np.sqrt((PRIOR_SPREAD**2 + squares) / total)
