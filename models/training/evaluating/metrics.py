"""Figures of verdicts: of one test set, over folds and seeds, and between two systems.

Probabilities are calibrated by one temperature (Guo et al. 2017, arXiv:1706.04599).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from sklearn.metrics import accuracy_score, precision_recall_fscore_support, roc_auc_score

from graspd.models.contract import ConfidenceStep
from graspd.models.training.arrays import Bools, Floats, Ints

TEMPERATURE_RANGE = (0.05, 20.0)
"""Limits of a fitted temperature; perfectly separated labels end at the lower one."""
ECE_BINS = 15
"""Bins of equal width, as in Guo et al."""
HALVINGS = 60
"""Steps of the bisection: enough for every bit of a double."""
Z_95 = 1.959963984540054
"""Standard normal quantile of a two-sided 95 % interval."""
CURVE_STEPS = 50
"""Points of an accuracy-coverage curve."""
FEWEST_JUDGED = 50
"""Fewest verdicts whose accuracy sets a threshold; of fewer, all may be right by chance."""


@dataclass(frozen=True, slots=True)
class Spread:
    """A figure over folds and seeds."""

    mean: float
    """Mean over the seeds of each seed's fold mean."""
    std: float
    """Population standard deviation over the folds, mean of the seeds; over the seeds where a seed
    has one fold only."""
    error: float | None
    """Standard error of the mean over the seeds; None for one seed."""
    seeds: int
    folds: int


@dataclass(frozen=True, slots=True)
class Fraction:
    """Share of right verdicts, with its 95 % interval (Wilson 1927)."""

    grasps: int
    accuracy: float
    low: float
    high: float


def score(margins: Floats, slipped: Bools, probability: Floats) -> dict[str, float | None]:
    """Return figures of margins and slip probabilities against labels (N,), slip positive.

    `auc` is None for a single class. `ece` is the expected calibration error of the verdict's
    probability, `brier` the mean squared error of the slip probability.
    """
    verdict = margins > 0.0
    precision, recall, f1, _ = precision_recall_fscore_support(
        slipped, verdict, average="binary", zero_division=0.0
    )
    both = len(np.unique(slipped)) == 2
    of_truth = np.where(slipped, probability, 1.0 - probability)
    return {
        "accuracy": float(accuracy_score(slipped, verdict)),
        "precision": float(precision),
        "recall": float(recall),
        "f1": float(f1),
        "auc": float(roc_auc_score(slipped, margins)) if both else None,
        "brier": float(np.mean((probability - slipped) ** 2)),
        "ece": _ece(probability, slipped),
        "log_loss": float(-np.mean(np.log(np.maximum(of_truth, np.finfo(np.float64).tiny)))),
    }


def fit_temperature(margins: Floats, slipped: Bools) -> float:
    """Return the T that makes sigmoid(margin / T) most likely, of margins (N,) and labels (N,).
    The grasps must not have been trained on."""
    low, high = np.log(TEMPERATURE_RANGE)
    for _ in range(HALVINGS):
        middle = (low + high) / 2.0
        # The likelihood is concave in 1/T; its slope there says on which side of T the peak is.
        slope = np.mean((slipped - p_slip(margins, np.exp(middle))) * margins)
        low, high = (low, middle) if slope > 0.0 else (middle, high)
    return float(np.exp((low + high) / 2.0))


def p_slip(margins: Floats, temperature: float = 1.0) -> Floats:
    """Return the slip probability (N,) of margins (N,): sigmoid(margin / temperature)."""
    value = margins / temperature
    # exp() of a negative number only: never overflows.
    small = np.exp(-np.abs(value))
    probability: Floats = np.where(value >= 0.0, 1.0, small) / (1.0 + small)
    return probability


def cross_fitted_p_slip(margins: Floats, slipped: Bools, fold_of: Ints) -> Floats:
    """Return the slip probability (N,), each fold's by the temperature of the other folds."""
    probability = np.empty(len(margins))
    for fold in np.unique(fold_of):
        inside = fold_of == fold
        temperature = fit_temperature(margins[~inside], slipped[~inside])
        probability[inside] = p_slip(margins[inside], temperature)
    return probability


def over_seeds(figures: Sequence[Sequence[float | None]]) -> Spread:
    """Return mean and spread of figures (seeds, folds) without None; only None gives NaN."""
    table = np.array(figures, dtype=np.float64)
    if np.isnan(table).all():  # the mean of nothing is a warning
        return Spread(math.nan, math.nan, None, *table.shape)
    means = np.nanmean(table, axis=1)
    seeds, folds = table.shape
    std = np.nanstd(table, axis=1).mean() if folds > 1 else means.std()
    error = float(means.std(ddof=1) / math.sqrt(seeds)) if seeds > 1 else None
    return Spread(float(means.mean()), float(std), error, seeds, folds)


def paired_difference(
    ours: Sequence[float], theirs: Sequence[float], test_to_train: float
) -> tuple[float, float | None]:
    """Return the mean of `ours - theirs` over all splits, and its standard error.

    Trainings share most of their grasps, so their errors are not independent: the variance of the
    mean is `(1 / J + test_to_train)` times that of the J differences (Nadeau & Bengio 2003,
    Inference for the Generalization Error). `test_to_train` is the ratio of their grasps; 0 where
    the trainings differ by their seed alone. A single split has no error.
    """
    differences = np.array(ours) - np.array(theirs)
    mean = float(differences.mean())
    if len(differences) < 2:
        return mean, None
    variance = float(differences.var(ddof=1)) * (1.0 / len(differences) + test_to_train)
    return mean, math.sqrt(variance)


def wilson(accuracy: float, grasps: int) -> Fraction:
    """Return the share of right verdicts among `grasps` grasps, with its interval."""
    spread = Z_95**2 / grasps
    centre = (accuracy + spread / 2.0) / (1.0 + spread)
    half = math.sqrt(accuracy * (1.0 - accuracy) * spread + spread**2 / 4.0) / (1.0 + spread)
    # The interval holds the share; at 0 and 1 rounding would just miss it.
    low, high = min(accuracy, centre - half), max(accuracy, centre + half)
    return Fraction(grasps, accuracy, max(0.0, low), min(1.0, high))


def coverage_curve(
    probability: Floats, slipped: Bools, steps: int = CURVE_STEPS
) -> list[ConfidenceStep]:
    """Return the accuracy of the most confident verdicts, ascending in coverage up to all.

    Verdicts of equal confidence stay together.
    """
    points = _points(probability, slipped)
    number = len(slipped)
    wanted = np.unique(np.ceil(np.linspace(1.0 / steps, 1.0, steps) * number))
    ends = [round(point.coverage * number) for point in points]
    return [points[index] for index in np.unique(np.searchsorted(ends, wanted))]


def accuracy_at(probability: Floats, slipped: Bools, coverage: float) -> float:
    """Return the accuracy of this share of the grasps, the most confident ones; at least one."""
    _, accuracy = _by_confidence(probability, slipped)
    return float(accuracy[max(1, round(coverage * len(accuracy))) - 1])


def reject_threshold(
    probability: Floats, slipped: Bools, wanted: float, repeats: int = 1
) -> ConfidenceStep | None:
    """Return the lowest confidence from which verdicts surely reach the accuracy `wanted`.

    Surely: the lower end of the 95 % interval reaches it. With many confidences to choose from, the
    accuracy itself reaches it somewhere by chance. `repeats`: number of verdicts on each grasp.
    None: no confidence reaches it with `FEWEST_JUDGED` verdicts.
    """
    least = FEWEST_JUDGED / len(slipped)
    grasps = len(slipped) / repeats
    reached = (
        point
        for point in reversed(_points(probability, slipped))
        if point.coverage >= least
        and wilson(point.accuracy, max(1, round(point.coverage * grasps))).low >= wanted
    )
    return next(reached, None)


def reliability_bins(probability: Floats, slipped: Bools) -> list[tuple[float, float, int]]:
    """Mean slip probability, share that slipped, and number of grasps of each bin in use."""
    bins = np.minimum((probability * ECE_BINS).astype(np.int64), ECE_BINS - 1)
    return [
        (float(probability[bins == b].mean()), float(slipped[bins == b].mean()), int(number))
        for b, number in enumerate(np.bincount(bins, minlength=ECE_BINS))
        if number
    ]


def _ece(probability: Floats, slipped: Bools) -> float:
    """Expected calibration error of slip probabilities (N,)."""
    confidence = np.maximum(probability, 1.0 - probability)
    correct = (probability > 0.5) == slipped
    bins = np.minimum((confidence * ECE_BINS).astype(np.int64), ECE_BINS - 1)
    gaps = np.bincount(bins, weights=correct - confidence, minlength=ECE_BINS)
    return float(np.abs(gaps).sum() / len(probability))


def _points(probability: Floats, slipped: Bools) -> list[ConfidenceStep]:
    """Return a point for each confidence that occurs, ascending in coverage."""
    confidence, accuracy = _by_confidence(probability, slipped)
    ends = np.flatnonzero(np.append(confidence[1:] != confidence[:-1], True)).tolist()
    return [
        ConfidenceStep(float(confidence[end]), float(accuracy[end]), (end + 1) / len(confidence))
        for end in ends
    ]


def _by_confidence(probability: Floats, slipped: Bools) -> tuple[Floats, Floats]:
    """Return the confidences, falling, and the accuracy of all verdicts down to each."""
    confidence = np.maximum(probability, 1.0 - probability)
    order = np.argsort(-confidence, kind="stable")
    right = ((probability > 0.5) == slipped)[order]
    return confidence[order], np.cumsum(right) / np.arange(1, len(order) + 1)
