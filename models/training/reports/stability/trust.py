"""Test learner, risk rule and session statistics with worst-case streams.

The statistics after a billion grasps are compared with a closed form, the rule's budget with
fractions.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator
from fractions import Fraction
from itertools import islice

import numpy as np
from numpy.typing import NDArray

from graspd.models.session_statistics import HORIZON_GRASPS, SessionState, SessionStatistics
from graspd.models.training.reports.stability.row import Row
from graspd.models.trust.learner import Learner
from graspd.models.trust.risk import Permission, Risk, RiskLimits

Random = np.random.Generator
Outcome = tuple[float, NDArray[np.float64], bool]
"""Margin and inputs of a grasp; True if it slipped."""
INPUTS = 78
"""Number of inputs: session features of the whole hand, for the largest learner."""
CLIP, INPUT_MAX = 3.0, 1000.0
"""Limits of session features, and of inputs that the learner accepts."""
MEAN_MAX, DRIFT = 25.0, 2e-3
GRASPS = 128
"""Number of grasps with a residual in the learner's state."""
PRIOR = np.array([*np.array([0.5, 0.5, *[0.2] * INPUTS]) ** 2, *[9.009] * GRASPS])
"""Variances of the weights (of the margin, the bias and the features) and of the residual."""
CHECKS = 100
"""Number of checks of the covariance, evenly spread over the outcomes of all streams."""
ERROR_MAX = 1e-6
"""Tolerance of a bound, slips, because it is a rounded sum of shares."""
EIGENVALUE_MIN = 0.99 * DRIFT * 0.009
"""Smallest eigenvalue of the covariance, from the learner's docstring, less 1 % for rounding."""
ALPHAS = (0.001, 0.003, 0.01, 0.02, 0.05, 0.1, 0.2, 0.3, 0.5)
LIFTS = 20_000
BUDGET_ERROR_MAX = 1e-9
"""Tolerance of the budget, slips. Each lift rounds by 1e-15."""

WIDTH = 24
UPDATES = 4000
"""Number of updates at full weight, after which 2e-6 of the former state and its errors is left."""
SESSION_ERROR_MAX = 1e-10
"""Largest relative error of a mean or spread. One update rounds by 1e-16, and 301 of them add up
before they have faded."""
SPIKE_AT = 3900
"""Number of the update with the spike, so late that its weight remains at the end."""
STILL, CLOSE, SPIKED = 0, 1, 2
"""Columns of electrodes: one that never moves, one at 4000 +- 0.5 counts, one with a spike."""
PRIOR_MEAN, PRIOR_SPREAD = 2000.0, 300.0


def varied(random: Random) -> Iterator[Outcome]:
    """Yield outcomes of varied features, of which the first decides."""
    while True:
        inputs = random.normal(0.0, 1.0, INPUTS).clip(-CLIP, CLIP)
        yield float(random.normal(0.0, 2.0)), inputs, bool(inputs[0] + random.normal() > 0.0)


def constant(random: Random) -> Iterator[Outcome]:
    """Yield random outcomes of always the same features."""
    while True:
        yield 1.0, np.full(INPUTS, 0.5), bool(random.random() < 0.5)


def at(limit: float, margin: float) -> Callable[[Random], Iterator[Outcome]]:
    """Return a stream of features +-`limit`, margins +-`margin` and outcomes, all at random."""

    def stream(random: Random) -> Iterator[Outcome]:
        while True:
            said = float(random.choice((-margin, margin)))
            yield said, random.choice((-limit, limit), INPUTS), bool(random.random() < 0.5)

    return stream


def contradicting(random: Random) -> Iterator[Outcome]:
    """Yield the same grasp, which slips and holds in turns."""
    inputs = random.uniform(-CLIP, CLIP, INPUTS)
    while True:
        yield 5.0, inputs, True
        yield 5.0, inputs, False


def against_the_margin(random: Random) -> Iterator[Outcome]:
    """Yield slips of grasps of which the network is surest that they are stable."""
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


def rows(outcomes: int) -> Iterator[Row]:
    """Yield the rows of all parts that belong to no model. `outcomes`: number for the learner."""
    yield learner_row(outcomes)
    for alpha in ALPHAS:
        tries = itertools.product((1, 20), (1.0, 2.0))
        worst = max(beyond_the_bound(alpha, late, slips_from) for late, slips_from in tries)
        case = f"allowed share {alpha:g} against adversaries"
        yield Row(
            "risk", case, {"slips beyond the bound": worst}, {"slips beyond the bound": ERROR_MAX}
        )
    yield budget_row()
    for case, spike in (("1e9 updates", None), ("a spike of 1e6", 1e6)):
        yield statistics_row(case, spike)


def learner_row(outcomes: int) -> Row:
    """Have a learner take in this number of outcomes, of all streams in turns; return figures of
    its weights and their covariance."""
    random, learner = np.random.default_rng(0), Learner(INPUTS)
    streams = [stream(random) for stream in STREAMS.values()]
    eigenvalues, variances, means, asymmetric = [], [], [], 0
    for check in range(CHECKS):
        for margin, inputs, slipped in islice(streams[check % len(streams)], outcomes // CHECKS):
            learner.learn(learner.judge(margin, inputs)[1], slipped=slipped)
        mean, covariance = learner.at_told()
        size = len(mean)
        kept = np.frombuffer(learner.state().covariance, "<f8").reshape(size, size)
        asymmetric += not (kept == kept.T).all()
        eigenvalues.append(float(np.linalg.eigvalsh(covariance)[0]))
        variances.append(float((covariance.diagonal() / PRIOR[:size]).max()))
        means.append(float(np.abs(mean).max()))
    # `min` and `max` may lose NaN.
    figures = {
        "asymmetric": float(asymmetric),
        "floor / eigenvalue": float(np.max(EIGENVALUE_MIN / np.array(eigenvalues))),
        "variance / prior's": float(np.max(variances)),
        "mean": float(np.max(means)),
    }
    bounds = {
        "asymmetric": 0.0,
        "floor / eigenvalue": 1.0,
        "variance / prior's": 1.0 + 1e-12,
        "mean": MEAN_MAX,
    }
    # Raises `ValueError` for a state that no outcomes lead to.
    Learner(INPUTS).restore(learner.state())
    return Row("learner", f"{outcomes:.0e} outcomes", figures, bounds)


def beyond_the_bound(alpha: float, late: int, slips_from: float) -> float:
    """Return by how many slips an adversary that knows the rule and its budget exceeds the bound;
    at most 0: the bound holds.

    It lifts the surest grasps, which hold until the budget is at `slips_from` slips, and slip from
    then on. Outcomes come `late` at a time. `alpha`: allowed share of slips.
    """
    rule, worst, waiting = Risk(RiskLimits(alpha)), -math.inf, list[bool]()
    for _ in range(LIFTS):
        allowed = rule.decide(-math.inf) is Permission.ALLOWED
        if allowed:
            waiting.append(rule.budget >= slips_from)
        elif not waiting:
            break  # nothing is `stable` any more
        if len(waiting) == late or not allowed:
            for slipped in waiting:
                rule.take(stable=True, slipped=slipped, proves=True)
                worst = max(worst, rule.slips - (rule.bound or 0.0))
            waiting = []
    return worst


def budget_row() -> Row:
    """Compare the budget after many lifts with exact arithmetic in fractions."""
    random, worst = np.random.default_rng(0), 0.0
    for alpha in (0.001, 0.05, 0.5):
        rule = Risk(RiskLimits(alpha))
        budget = Fraction(rule.budget)
        for unlucky in (random.random(LIFTS) < 1.2 * alpha).tolist():
            slipped = unlucky and rule.decide(-math.inf) is Permission.ALLOWED
            rule.take(stable=True, slipped=slipped, proves=True)
            budget = min(budget + Fraction(alpha) - slipped, Fraction(8))
            worst = max(worst, abs(float(Fraction(rule.budget) - budget)))
    return Row("risk", f"budget, {LIFTS} lifts", {"error": worst}, {"error": BUDGET_ERROR_MAX})


def statistics_row(case: str, spike: float | None) -> Row:
    """Compare the statistics of a long session with their closed form. `spike`: one extreme value
    among the others; None: without."""
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
    errors = np.concatenate((statistics.mean / mean - 1.0, statistics.spread / spread - 1.0))
    figures = {"error": float(np.abs(errors).max())}
    return Row("session", case, figures, {"error": SESSION_ERROR_MAX})


def closed_form(
    values: NDArray[np.float64],
) -> tuple[NDArray[np.longdouble], NDArray[np.longdouble]]:
    """Return weighted mean and spread; each later grasp scales a grasp's weight by 300/301."""
    horizon = np.longdouble(HORIZON_GRASPS)
    fade = horizon / (horizon + 1)
    weights = fade ** np.arange(len(values), 0, -1).astype(np.longdouble)
    exact = values.astype(np.longdouble)
    first, first_weight = exact[0], horizon * fade ** np.longdouble(len(values))
    mean = (first_weight * first + weights @ exact) / horizon
    squares = first_weight * (first - mean) ** 2 + weights @ (exact - mean) ** 2
    total = horizon + 1
    return (PRIOR_MEAN + horizon * mean) / total, np.sqrt((PRIOR_SPREAD**2 + squares) / total)
