"""Figures of verdicts: of one test set, over folds and seeds, and between two systems.

Probabilities are calibrated by one temperature (Guo et al. 2017, arXiv:1706.04599). Rows are those
of `frame`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import pandas as pd
from sklearn.metrics import (
    accuracy_score,
    brier_score_loss,
    log_loss,
    precision_recall_fscore_support,
    roc_auc_score,
)

from graspd.models.contract import ConfidenceStep
from graspd.models.training.arrays import Bools, Floats, Ints

TEMPERATURE_RANGE = (0.05, 20.0)
"""Limits of a fitted temperature; perfectly separated labels end at the lower one."""
ECE_BINS = 15
"""Bins of equal width, as in Guo et al."""
HALVINGS = 60
"""Steps of the bisection: enough for every bit of a double."""
CURVE_STEPS = 50
"""Points of an accuracy-coverage curve."""
FEWEST_JUDGED = 50
"""Fewest verdicts that show how often they are right."""
DRAWS = 2000
"""Number of draws of objects for an interval; another thousand moves it by a tenth of a point."""


@dataclass(frozen=True, slots=True)
class Spread:
    """A figure over folds and seeds."""

    mean: float
    """Mean over the seeds of each seed's fold mean."""
    std: float
    """Population standard deviation over the folds, averaged over the seeds; with a single fold,
    that over the seeds."""
    error: float | None
    """Standard error of the mean over the seeds; None for one seed."""
    seeds: int
    folds: int


def score(margins: Floats, slipped: Bools, probability: Floats) -> dict[str, float]:
    """Return scores of margins and slip probabilities against labels, each (N,), slip positive.

    Margins give `accuracy`, `precision`, `recall`, `f1`, `auc` (NaN for a single class);
    probabilities give `brier`, their mean squared error; `log_loss`; `ece`, the expected
    calibration error of the verdict's probability.
    """
    verdict = margins > 0.0
    precision, recall, f1, _ = precision_recall_fscore_support(
        slipped, verdict, average="binary", zero_division=0.0
    )
    both = len(np.unique(slipped)) == 2
    return {
        "accuracy": accuracy_score(slipped, verdict),
        "precision": precision,
        "recall": recall,
        "f1": f1,
        "auc": roc_auc_score(slipped, margins) if both else math.nan,
        "brier": brier_score_loss(slipped, probability, pos_label=True),
        "ece": _ece(probability, slipped),
        "log_loss": log_loss(slipped, probability, labels=[False, True]),
    }


def _ece(probability: Floats, slipped: Bools) -> float:
    """Return the expected calibration error of slip probabilities (N,)."""
    confidence = np.maximum(probability, 1.0 - probability)
    correct = (probability > 0.5) == slipped
    bins = np.minimum((confidence * ECE_BINS).astype(np.int64), ECE_BINS - 1)
    gaps = np.bincount(bins, weights=correct - confidence, minlength=ECE_BINS)
    return float(np.abs(gaps).sum() / len(probability))


def p_slip(margins: Floats, temperature: float) -> Floats:
    """Return sigmoid(margin / temperature) of margins (N,)."""
    small = np.exp(-np.abs(margins / temperature))
    probability: Floats = np.where(margins >= 0.0, 1.0, small) / (1.0 + small)
    return probability


def fit_temperature(margins: Floats, slipped: Bools) -> float:
    """Return the T that makes sigmoid(margin / T) most likely, of margins (N,) and labels (N,).
    The grasps must not have been trained on."""
    low, high = np.log(TEMPERATURE_RANGE)
    for _ in range(HALVINGS):
        middle = (low + high) / 2.0
        # The likelihood is concave in 1/T, so its slope shows on which side the maximum is.
        slope = np.mean((slipped - p_slip(margins, np.exp(middle))) * margins)
        low, high = (low, middle) if slope > 0.0 else (middle, high)
    return float(np.exp((low + high) / 2.0))


def cross_fitted(rows: pd.DataFrame) -> pd.Series:
    """Return the slip probability of each row; `rows` are of one seed and variant.

    Each fold is calibrated by a temperature fitted to the other folds; of a single fold, each
    object by one fitted to the other objects, and a single object not at all.
    """
    group_of = rows["fold"] if rows["fold"].nunique() > 1 else rows["object"]
    probability = pd.Series(np.nan, rows.index)
    for group in group_of.unique():
        inside = group_of == group
        rest, temperature = rows[~inside], 1.0
        if len(rest):
            temperature = fit_temperature(rest["margin"].to_numpy(), rest["slipped"].to_numpy())
        probability[inside] = p_slip(rows["margin"][inside].to_numpy(), temperature)
    return probability


def over_seeds(figures: Floats) -> Spread:
    """Return mean and spread of figures (seeds, folds), ignoring NaN; NaN if all are NaN."""
    seeds, folds = figures.shape
    if np.isnan(figures).all():  # the mean of no values would warn
        return Spread(math.nan, math.nan, None, seeds, folds)
    means = np.nanmean(figures, axis=1)
    std = np.nanstd(figures, axis=1).mean() if folds > 1 else means.std()
    error = float(means.std(ddof=1) / math.sqrt(seeds)) if seeds > 1 else None
    return Spread(float(means.mean()), float(std), error, seeds, folds)


def paired_difference(differences: Floats, test_to_train: float) -> tuple[float, float | None]:
    """Return the mean of differences of two systems over all splits, and its standard error.

    Trainings share most of their grasps, so their errors are not independent: the variance of the
    mean is `(1 / J + test_to_train)` times that of the J differences (Nadeau & Bengio 2003,
    Inference for the Generalization Error). `test_to_train` is the ratio of test to training
    grasps; 0 if the trainings differ only by their seed. A single split has no error.
    """
    mean = float(differences.mean())
    if len(differences) < 2:
        return mean, None
    variance = float(differences.var(ddof=1)) * (1.0 / len(differences) + test_to_train)
    return mean, math.sqrt(variance)


def interval(some: pd.Series, of: pd.Series, objects: pd.Series) -> tuple[float, float]:
    """Return the 95 % interval of sum(`some`) / sum(`of`), as if other such objects were drawn.

    Objects are drawn with replacement with all their grasps, as grasps of an object are alike.
    """
    sums = pd.DataFrame({"some": some, "of": of}).groupby(objects).sum().to_numpy()
    drawn = np.random.default_rng(0).integers(len(sums), size=(DRAWS, len(sums)))
    with np.errstate(invalid="ignore"):  # objects without a slip have no F1
        shares = np.divide(*sums[drawn].sum(axis=1).T)
    low, high = np.nanquantile(shares, (0.025, 0.975))
    return float(low), float(high)


def f1_interval(rows: pd.DataFrame) -> tuple[float, float] | None:
    """Return the `interval` of F1, slip positive, over all rows; None: of one object, which says
    nothing of others, or without a slip, judged or real."""
    slip, slipped = rows["margin"] > 0.0, rows["slipped"]
    of = slip.astype(int) + slipped
    if not of.any() or rows["object"].nunique() < 2:
        return None
    return interval(2 * (slip & slipped), of, rows["object"])


def confusion(rows: pd.DataFrame) -> Ints:
    """Return numbers of grasps, shape (2, 2): rows held, slipped; columns judged stable, slip."""
    counts: Ints = np.zeros((2, 2), np.int64)
    np.add.at(counts, (rows["slipped"].astype(int), (rows["margin"] > 0.0).astype(int)), 1)
    return counts


def verdict_figures(rows: pd.DataFrame) -> dict[str, float | None]:
    """Return `grasps`, their number; `f1`, slip positive, 0..1; and shares: `slips_among_stable`,
    `slips_called_stable`, `stable_called_slip`; None: a share of no grasp."""
    (held, alarms), (missed, found) = confusion(rows).tolist()
    return {
        "grasps": len(rows),
        "f1": _share(2 * found, 2 * found + alarms + missed) or 0.0,
        "slips_among_stable": _share(missed, missed + held),
        "slips_called_stable": _share(missed, missed + found),
        "stable_called_slip": _share(alarms, alarms + held),
    }


def _share(some: int, of: int) -> float | None:
    return float(some / of) if of else None


def by_confidence(probability: pd.Series, slipped: pd.Series) -> pd.DataFrame:
    """Return a row for each `confidence`, falling: `accuracy` of the verdicts that have it or more,
    and their share of all, `coverage`.

    Verdicts of equal confidence count together.
    """
    confidence = np.maximum(probability, 1.0 - probability)
    right = (probability > 0.5) == slipped
    judged = right.groupby(confidence).agg(["sum", "count"])[::-1].cumsum()
    return pd.DataFrame(
        {
            "confidence": judged.index,
            "accuracy": (judged["sum"] / judged["count"]).to_numpy(),
            "coverage": (judged["count"] / len(right)).to_numpy(),
        }
    )


def coverage_curve(
    probability: pd.Series, slipped: pd.Series, steps: int = CURVE_STEPS
) -> list[ConfidenceStep]:
    """Return at most `steps` points of `by_confidence`, ascending in coverage up to 1."""
    points, number = by_confidence(probability, slipped), len(slipped)
    wanted = np.unique(np.ceil(np.linspace(1.0 / steps, 1.0, steps) * number))
    ends = np.rint(points["coverage"] * number)
    chosen = points.iloc[np.unique(np.searchsorted(ends, wanted))]
    return [ConfidenceStep(*map(float, point)) for point in chosen.itertuples(index=False)]


def accuracy_at(probability: pd.Series, slipped: pd.Series, coverage: float) -> float:
    """Return the accuracy of the most confident verdicts: the share `coverage`, at least one."""
    uncertainty = -np.maximum(probability, 1.0 - probability)
    right = ((probability > 0.5) == slipped).iloc[uncertainty.argsort(kind="stable")]
    return float(right.iloc[: max(1, round(coverage * len(right)))].mean())
