"""Probability calibration by one temperature (Guo et al. 2017, arXiv:1706.04599)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from models.training.arrays import Bools, Floats, Ints

TEMPERATURE_RANGE = (0.05, 20.0)
"""Where a temperature is looked for; perfectly separated labels end at the low end."""
ECE_BINS = 15
"""Bins of equal width, as in Guo et al."""
HALVINGS = 60
"""Steps of the bisection: enough for every bit of a double."""


@dataclass(frozen=True, slots=True)
class Reliability:
    """How far probabilities are from frequencies; 0 is perfect."""

    ece: float
    """Expected calibration error of the verdict's probability."""
    brier: float
    """Mean squared error of the slip probability."""
    log_loss: float
    """Mean negative log-likelihood, nats: what the temperature is fitted to."""


def fit_temperature(margins: Floats, slipped: Bools) -> float:
    """The T that makes sigmoid(margin / T) most likely, of margins (N,) and labels (N,).

    They must be of grasps that were not trained on.
    """
    low, high = np.log(TEMPERATURE_RANGE)
    for _ in range(HALVINGS):
        middle = (low + high) / 2.0
        # The likelihood is concave in 1/T; its slope there says on which side of T the peak is.
        slope = np.mean((slipped - p_slip(margins, np.exp(middle))) * margins)
        low, high = (low, middle) if slope > 0.0 else (middle, high)
    return float(np.exp((low + high) / 2.0))


def p_slip(margins: Floats, temperature: float = 1.0) -> Floats:
    """Slip probability (N,) of margins (N,): sigmoid(margin / temperature)."""
    value = margins / temperature
    # exp() of a negative number only: never overflows.
    small = np.exp(-np.abs(value))
    probability: Floats = np.where(value >= 0.0, 1.0, small) / (1.0 + small)
    return probability


def cross_fitted_p_slip(margins: Floats, slipped: Bools, fold_of: Ints) -> Floats:
    """Slip probability (N,), each fold's by the temperature that the other folds give."""
    probability = np.empty(len(margins))
    for fold in np.unique(fold_of):
        inside = fold_of == fold
        temperature = fit_temperature(margins[~inside], slipped[~inside])
        probability[inside] = p_slip(margins[inside], temperature)
    return probability


def reliability(probability: Floats, slipped: Bools) -> Reliability:
    """How far slip probabilities (N,) are from the labels (N,)."""
    confidence = np.maximum(probability, 1.0 - probability)
    correct = (probability > 0.5) == slipped
    bins = np.minimum((confidence * ECE_BINS).astype(np.int64), ECE_BINS - 1)
    gaps = np.bincount(bins, weights=correct - confidence, minlength=ECE_BINS)
    of_truth = np.where(slipped, probability, 1.0 - probability)
    return Reliability(
        ece=float(np.abs(gaps).sum() / len(probability)),
        brier=float(np.mean((probability - slipped) ** 2)),
        log_loss=float(-np.mean(np.log(np.maximum(of_truth, np.finfo(np.float64).tiny)))),
    )
