"""What outcomes teach and what a risk allows, under streams made up for the worst, and their cost.

The learner against itself in extended precision; the rule's threshold against exact fractions.
"""

from __future__ import annotations

import contextlib
import math
import time
import tracemalloc
from collections.abc import Callable, Iterator
from fractions import Fraction

import msgspec
import numpy as np
from numpy.typing import NDArray

from daemon.measure.stability.steps import StepRow
from daemon.trust.learner import (
    BIAS_SPREAD,
    DRIFT,
    FEATURE_SPREAD,
    INPUT_MAX,
    MARGIN_SPREAD,
    MEAN_SPREADS_MAX,
    Learner,
)
from daemon.trust.lift_book import LIFTS_MAX, GraspId
from daemon.trust.risk import LOWEST, Permission, Risk, RiskLimits
from daemon.trust.trust import Trust, decode, encode
from drivers.base import ELECTRODES

INPUTS = 3 * (ELECTRODES + 2)
"""A session's features of the whole hand: the largest learner there is."""
CLIP = 3.0
"""Of a session's features."""
OUTCOMES, QUICK_OUTCOMES = 1_000_000, 10_000
CHECKS = 100
"""How often the covariance is looked at meanwhile."""
COMPARED = 500
"""Outcomes that extended precision is asked for; it takes a millisecond for each."""
ERROR_MAX = 1e-6
"""Largest error of log-odds, over their magnitude if that is above 1."""
EIGENVALUE_MIN = 0.99 * DRIFT * FEATURE_SPREAD**2
"""What the learner's docstring derives, but for rounding."""
ALPHAS = (0.001, 0.003, 0.01, 0.02, 0.05, 0.1, 0.2, 0.3, 0.5)
LIFTS = 20_000
OUTSTANDING = 20
"""Lifts whose outcomes come later, of the adversary that keeps them back."""
THETA_ERROR_MAX = 1e-9
"""Log-odds. A lift rounds by 1e-15."""
STATE_BYTES_MAX = 2 << 20
JUDGE_US_MAX, OUTCOME_US_MAX = 30.0, 200.0
"""Bounds of the median of the quietest batch: a computer has other work too."""
BATCHES, BATCH = 20, LIFTS_MAX

Outcome = tuple[float, NDArray[np.float64], bool]
"""Margin, inputs, whether it slipped."""
Stream = Callable[[np.random.Generator], Iterator[Outcome]]


def trust_rows(*, quick: bool) -> Iterator[StepRow]:
    """All rows; with `quick`, fewer outcomes in the longest one, which else takes a minute."""
    yield _endurance(QUICK_OUTCOMES if quick else OUTCOMES)
    for name, stream in STREAMS.items():
        error = _learner_error(stream)
        yield StepRow(
            f"learner, {COMPARED} outcomes, {name}",
            f"log-odds of long double to {ERROR_MAX:.0e}",
            f"{error:.1e}",
            error <= ERROR_MAX,  # false for NaN
        )
    yield _refused()
    for alpha in ALPHAS:
        yield _adversaries(alpha)
    yield _theta()
    yield _goes_on()
    yield from _cost()


def _varied(random: np.random.Generator) -> Iterator[Outcome]:
    while True:
        inputs = random.normal(0.0, 1.0, INPUTS).clip(-CLIP, CLIP)
        yield float(random.normal(0.0, 2.0)), inputs, bool(inputs[0] + random.normal() > 0.0)


def _constant(random: np.random.Generator) -> Iterator[Outcome]:
    while True:
        yield 1.0, np.full(INPUTS, 0.5), bool(random.random() < 0.5)


def _at_the_clip(random: np.random.Generator) -> Iterator[Outcome]:
    while True:
        margin = float(random.choice((-1e9, 1e9)))
        yield margin, random.choice((-CLIP, CLIP), INPUTS), bool(random.random() < 0.5)


def _at_the_limit(random: np.random.Generator) -> Iterator[Outcome]:
    while True:
        margin = float(random.choice((-1e300, 1e300)))
        yield margin, random.choice((-INPUT_MAX, INPUT_MAX), INPUTS), bool(random.random() < 0.5)


def _contradicting(random: np.random.Generator) -> Iterator[Outcome]:
    inputs = random.uniform(-CLIP, CLIP, INPUTS)
    while True:
        yield 5.0, inputs, True
        yield 5.0, inputs, False


def _against_the_margin(random: np.random.Generator) -> Iterator[Outcome]:
    while True:
        yield -30.0, CLIP * np.eye(INPUTS)[random.integers(INPUTS)], True


STREAMS: dict[str, Stream] = {
    "varied": _varied,
    "constant features": _constant,
    "features at the clip": _at_the_clip,
    "features at the largest that is taken": _at_the_limit,
    "contradicting labels": _contradicting,
    "labels against the surest margin": _against_the_margin,
}


def _prior() -> NDArray[np.float64]:
    """Variances of the weights, shape (INPUTS + 2,)."""
    return np.array([MARGIN_SPREAD, BIAS_SPREAD, *[FEATURE_SPREAD] * INPUTS]) ** 2


def _endurance(outcomes: int) -> StepRow:
    """All streams in turns; what must hold of mean and covariance, looked at all along."""
    random, learner, prior = np.random.default_rng(0), Learner(INPUTS), _prior()
    start = np.zeros(len(prior))
    start[0] = 1.0
    streams = [stream(random) for stream in STREAMS.values()]
    every, least, most, far, told = outcomes // CHECKS, math.inf, 0.0, 0.0, 0
    symmetric = True
    for check in range(CHECKS):
        stream = streams[check % len(streams)]
        for _, (margin, inputs, slipped) in zip(range(every), stream, strict=False):
            learner.learn(learner.judge(margin, inputs)[1], slipped=slipped)
            told += 1
        state = learner.state()
        covariance = np.frombuffer(state.covariance, "<f8").reshape(len(prior), -1)
        mean = np.frombuffer(state.mean, "<f8")
        symmetric &= bool((covariance == covariance.T).all())
        least = min(least, float(np.linalg.eigvalsh(covariance)[0]))
        most = max(most, float((covariance.diagonal() / prior).max()))
        far = max(far, float((np.abs(mean - start) / np.sqrt(prior)).max()))
    Learner(INPUTS).restore(learner.state())  # raises for what it would not go on from
    return StepRow(
        f"learner, {told:.0e} outcomes, all of these in turns",
        f"symmetric, eigenvalues from {EIGENVALUE_MIN:.1e} on, variances within the prior's, "
        f"weights within {MEAN_SPREADS_MAX:g} spreads",
        f"{'symmetric' if symmetric else 'not symmetric'}, from {least:.2e} on, "
        f"{most:.6f} of the prior's, {far:.1f} spreads",
        symmetric and least >= EIGENVALUE_MIN and most <= 1 + 1e-12 and far <= MEAN_SPREADS_MAX,
    )


def _learner_error(stream: Stream) -> float:
    """Largest error of log-odds, each said before its outcome is told."""
    learner, exact = Learner(INPUTS), _ExactLearner()
    worst = 0.0
    outcomes = stream(np.random.default_rng(1))
    for _, (margin, inputs, slipped) in zip(range(COMPARED), outcomes, strict=False):
        found, features = learner.judge(margin, inputs)
        wanted = exact.log_odds(features)
        error = abs(float(found - wanted)) / max(1.0, abs(float(wanted)))
        worst = max(worst, error if math.isfinite(error) else math.inf)
        learner.learn(features, slipped=slipped)
        exact.learn(features, slipped=slipped)
    return worst


class _ExactLearner:
    """The learner's equations in extended precision, written plainly."""

    def __init__(self) -> None:
        self.prior = _prior().astype(np.longdouble)
        self.start = np.zeros(len(self.prior), np.longdouble)
        self.start[0] = 1
        self.mean = self.start.copy()
        self.covariance = np.diag(self.prior)

    def log_odds(self, features: NDArray[np.float64]) -> np.longdouble:
        f = features.astype(np.longdouble)
        moderated = np.longdouble(math.pi) / 8 * (f @ self.covariance @ f)
        return np.longdouble((f @ self.mean) / np.sqrt(1 + moderated))

    def learn(self, features: NDArray[np.float64], *, slipped: bool) -> None:
        f = features.astype(np.longdouble)
        seen = self.covariance @ f
        with np.errstate(over="ignore"):  # to infinity, which gives 0 as it should
            p = 1 / (1 + np.exp(-(f @ self.mean)))
        w = p * (1 - p)
        gain = seen / (1 + w * (f @ seen))
        reach = np.longdouble(MEAN_SPREADS_MAX) * np.sqrt(self.prior)
        mean = self.mean + gain * (slipped - p)
        self.mean = np.clip(mean, self.start - reach, self.start + reach)
        widened = self.covariance - w * np.outer(gain, seen) + np.diag(DRIFT * self.prior)
        scale = np.sqrt(np.minimum(1, self.prior / np.diag(widened)))
        self.covariance = widened * np.outer(scale, scale)


def _refused() -> StepRow:
    """What is no number, or no feature, changes nothing."""
    trust, zeros = Trust("report", INPUTS), np.zeros(INPUTS)
    before, taken = trust.state(), 0
    wrong = [(value, zeros) for value in (math.nan, math.inf, -math.inf)]
    for value in (math.nan, math.inf, -math.inf, 1.001 * INPUT_MAX, -1e300):
        inputs = zeros.copy()
        inputs[-1] = value
        wrong.append((0.0, inputs))
    for margin, inputs in wrong:
        with contextlib.suppress(ValueError):
            trust.judge(GraspId("report", 1), 0.5, margin, inputs)
            taken += 1
    return StepRow(
        "learner, what is not finite or too large",
        "refused, nothing changes",
        f"{taken} of {len(wrong)} taken in",
        taken == 0 and trust.state() == before,
    )


def _adversaries(alpha: float) -> StepRow:
    """Slips beyond the bound at the worst moment, against who knows the rule and its threshold."""
    worst = -math.inf
    for late in (1, OUTSTANDING):
        for believes in (LOWEST, LOWEST + 1.0, -1.0):
            worst = max(worst, _beyond(alpha, late, believes))
    return StepRow(
        f"risk of {alpha:g} against adversaries, {LIFTS} grasps each",
        "slips within the bound at every moment",
        f"nearest {worst:+.2f} slips",
        worst <= ERROR_MAX,
    )


def _beyond(alpha: float, late: int, slips_from: float) -> float:
    """Most slips beyond the bound, of grasps as sure as can be that slip while theta allows it.

    It holds until theta is at `slips_from`, then slips on what is told `stable`; outcomes come
    `late` at a time.
    """
    rule, worst = Risk(RiskLimits(alpha)), -math.inf
    waiting: list[bool] = []
    for _ in range(LIFTS):
        if rule.decide(LOWEST) is Permission.ALLOWED:
            waiting.append(rule.theta >= slips_from)
        elif not waiting:
            break  # silent for ever
        if len(waiting) == late or rule.theta < LOWEST:
            for slipped in waiting:
                rule.take(stable=True, slipped=slipped, proves=True)
                worst = max(worst, rule.slips - (rule.bound or 0.0))
            waiting = []
    return worst


def _theta() -> StepRow:
    """Rounding of the threshold after many lifts, against fractions."""
    random, worst = np.random.default_rng(0), 0.0
    for alpha in (ALPHAS[0], 0.05, ALPHAS[-1]):
        rule = Risk(RiskLimits(alpha))
        theta = Fraction(rule.theta)
        for unlucky in (random.random(LIFTS) < 1.2 * alpha).tolist():
            slipped = unlucky and rule.theta >= LOWEST  # else nothing would be lifted
            rule.take(stable=True, slipped=slipped, proves=True)
            theta = min(theta + Fraction(alpha) - slipped, Fraction(0))
            worst = max(worst, abs(float(Fraction(rule.theta) - theta)))
    return StepRow(
        f"risk, threshold after {LIFTS} lifts",
        f"of fractions to {THETA_ERROR_MAX:.0e}",
        f"{worst:.1e}",
        worst <= THETA_ERROR_MAX,
    )


def _goes_on() -> StepRow:
    """A state written and read in between leaves no trace."""
    rows = list(zip(range(400), _varied(np.random.default_rng(2)), strict=False))
    whole, half = _trust(), _trust()
    for trust, part in ((whole, rows), (half, rows[:200])):
        _live(trust, part)
    again = _trust()
    again.restore(decode(encode(half.state())))
    _live(again, rows[200:])
    # As bytes: NaN would differ from itself, and -0.0 be equal to 0.0.
    same = msgspec.msgpack.encode(again.state()) == msgspec.msgpack.encode(whole.state())
    found = "the same bytes" if same else "other bytes"
    return StepRow("learner and risk, kept and restored", "the same bytes", found, same)


def _trust() -> Trust:
    return Trust("report", INPUTS, RiskLimits(0.05, warm_up=50, explore=0.05))


def _live(trust: Trust, rows: list[tuple[int, Outcome]]) -> None:
    """Each grasp judged, every third told late."""
    for number, (margin, inputs, slipped) in rows:
        grasp = GraspId("report", number)
        found = trust.judge(grasp, 0.5, margin, inputs)
        trust.note(grasp, found, stable=found.permission is Permission.ALLOWED)
        if number % 3 == 2:
            trust.outcome(GraspId("report", number - 2), slipped=bool(margin > 0.0))
        if number % 3:
            trust.outcome(grasp, slipped=slipped)


def _cost() -> Iterator[StepRow]:
    """Time of a judged grasp and of an outcome, and memory with every outcome still out."""
    outcomes = _varied(np.random.default_rng(3))
    trust = _trust()
    judged, told = [], []
    for batch in range(BATCHES):
        took: list[tuple[int, int]] = []
        for number, (margin, inputs, slipped) in zip(range(BATCH), outcomes, strict=False):
            grasp, began = GraspId("report", BATCH * batch + number), time.perf_counter_ns()
            found = trust.judge(grasp, 0.5, margin, inputs)
            trust.note(grasp, found, stable=found.permission is Permission.ALLOWED)
            said = time.perf_counter_ns()
            trust.outcome(grasp, slipped=slipped)
            took.append((said - began, time.perf_counter_ns() - said))
        judge_ns, outcome_ns = np.median(took, axis=0)
        judged.append(float(judge_ns) / 1e3)
        told.append(float(outcome_ns) / 1e3)
    for name, limit, found_us in (
        ("a grasp judged and noted", JUDGE_US_MAX, min(judged)),
        ("an outcome", OUTCOME_US_MAX, min(told)),
    ):
        yield StepRow(
            f"learner and risk, time of {name}",
            f"p50 of the quietest {BATCH} within {limit:g} us",
            f"{found_us:.1f} us",
            found_us <= limit,
        )
    yield _memory()


def _memory() -> StepRow:
    tracing = tracemalloc.is_tracing()
    tracemalloc.start()
    before, _ = tracemalloc.get_traced_memory()
    trust = _trust()
    outcomes = _varied(np.random.default_rng(4))
    for number, (margin, inputs, _) in zip(range(2 * LIFTS_MAX), outcomes, strict=False):
        grasp = GraspId("report", number)
        trust.note(grasp, trust.judge(grasp, 0.5, margin, inputs), stable=False)
    encoded = encode(trust.state())
    _, peak = tracemalloc.get_traced_memory()
    if not tracing:
        tracemalloc.stop()
    held = peak - before
    return StepRow(
        "learner and risk, memory with all outcomes out, while it is kept",
        f"within {STATE_BYTES_MAX >> 20} MiB",
        f"{held / (1 << 20):.2f} MiB, {len(encoded) / 1024:.0f} KiB of them written",
        held <= STATE_BYTES_MAX,
    )
