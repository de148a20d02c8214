"""Calibration against figures worked out by hand or by scikit-learn."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

pytest.importorskip("torch", reason="the train extra is not installed")
pytest.importorskip("sklearn", reason="the train extra is not installed")

from sklearn.metrics import brier_score_loss, log_loss

from models.training.fitting.calibration import (
    cross_fitted_p_slip,
    fit_temperature,
    p_slip,
    reliability,
)


def margins_of(logits: NDArray[np.float64]) -> NDArray[np.float64]:
    """Log-odds of slip (N,) of logits (N, 2), order (stable, slip)."""
    margins: NDArray[np.float64] = logits[:, 1] - logits[:, 0]
    return margins


@pytest.mark.parametrize("true_temperature", [0.5, 1.0, 3.0])
def test_the_temperature_that_made_the_labels_is_found(true_temperature: float) -> None:
    random = np.random.default_rng(3)
    logits = random.normal(0.0, 4.0, (40_000, 2))
    chance = 1.0 / (1.0 + np.exp((logits[:, 0] - logits[:, 1]) / true_temperature))
    slipped = random.random(40_000) < chance
    assert fit_temperature(margins_of(logits), slipped) == pytest.approx(true_temperature, rel=0.03)


@pytest.mark.parametrize(("sign", "end"), [(1.0, 0.05), (-1.0, 20.0)])
def test_labels_without_overlap_end_at_a_bound(sign: float, end: float) -> None:
    logits = sign * np.array([[1.0, 0.0], [0.0, 1.0], [2.0, 0.0], [0.0, 3.0]])
    slipped = np.array([False, True, False, True])
    assert fit_temperature(margins_of(logits), slipped) == pytest.approx(end)


def test_probabilities_of_extreme_logits_are_finite() -> None:
    logits = np.array([[0.0, 5000.0], [5000.0, 0.0], [1.0, 1.0]])
    assert p_slip(margins_of(logits)).tolist() == [1.0, 0.0, 0.5]


def test_reliability_of_four_verdicts_worked_out_by_hand() -> None:
    probability = np.array([0.9, 0.9, 0.1, 0.62])
    slipped = np.array([True, False, False, True])
    # Confidence 0.9 three times, of which two are right: gap 3 * 0.9 - 2 = 0.7; then 1 - 0.62.
    # Brier: (0.1^2 + 0.9^2 + 0.1^2 + 0.38^2) / 4.
    result = reliability(probability, slipped)
    assert result.ece == pytest.approx((0.7 + 0.38) / 4)
    assert result.brier == pytest.approx((0.01 + 0.81 + 0.01 + 0.1444) / 4)


def test_brier_and_log_loss_agree_with_scikit_learn() -> None:
    random = np.random.default_rng(11)
    probability, slipped = random.random(500), random.random(500) < 0.5
    result = reliability(probability, slipped)
    assert result.brier == pytest.approx(brier_score_loss(slipped, probability))
    assert result.log_loss == pytest.approx(log_loss(slipped, probability))


def test_a_fold_is_calibrated_by_the_other_folds_alone() -> None:
    random = np.random.default_rng(5)
    margins, slipped = random.normal(size=300), random.random(300) < 0.5
    fold_of = np.arange(300) % 3
    before = cross_fitted_p_slip(margins, slipped, fold_of)
    other_labels = np.where(fold_of == 1, ~slipped, slipped)
    after = cross_fitted_p_slip(margins, other_labels, fold_of)
    assert np.array_equal(before[fold_of == 1], after[fold_of == 1])
    assert not np.array_equal(before[fold_of == 0], after[fold_of == 0])
