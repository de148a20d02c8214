"""Calibration, seen counts and protocols against figures worked out by hand or by scikit-learn."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("torch", reason="the train extra is not installed")
pytest.importorskip("sklearn", reason="the train extra is not installed")

from sklearn.metrics import brier_score_loss, log_loss

from models.contract import SeenCounts
from models.training.calibration import (
    cross_fitted_p_slip,
    fit_temperature,
    p_slip,
    reliability,
)
from models.training.protocols import TooFewGraspsError, folds_of, score
from models.training.seen import (
    held_out_never_seen,
    never_seen,
    random_never_seen,
    seen_counts,
)


@pytest.mark.parametrize("true_temperature", [0.5, 1.0, 3.0])
def test_the_temperature_that_made_the_labels_is_found(true_temperature: float) -> None:
    random = np.random.default_rng(3)
    logits = random.normal(0.0, 4.0, (40_000, 2))
    chance = 1.0 / (1.0 + np.exp((logits[:, 0] - logits[:, 1]) / true_temperature))
    slipped = random.random(40_000) < chance
    assert fit_temperature(logits, slipped) == pytest.approx(true_temperature, rel=0.03)


@pytest.mark.parametrize(("sign", "end"), [(1.0, 0.05), (-1.0, 20.0)])
def test_labels_without_overlap_end_at_a_bound(sign: float, end: float) -> None:
    logits = sign * np.array([[1.0, 0.0], [0.0, 1.0], [2.0, 0.0], [0.0, 3.0]])
    slipped = np.array([False, True, False, True])
    assert fit_temperature(logits, slipped) == pytest.approx(end)


def test_probabilities_of_extreme_logits_are_finite() -> None:
    logits = np.array([[0.0, 5000.0], [5000.0, 0.0], [1.0, 1.0]])
    assert p_slip(logits).tolist() == [1.0, 0.0, 0.5]


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
    logits, slipped = random.normal(size=(300, 2)), random.random(300) < 0.5
    fold_of = np.arange(300) % 3
    before = cross_fitted_p_slip(logits, slipped, fold_of)
    other_labels = np.where(fold_of == 1, ~slipped, slipped)
    after = cross_fitted_p_slip(logits, other_labels, fold_of)
    assert np.array_equal(before[fold_of == 1], after[fold_of == 1])
    assert not np.array_equal(before[fold_of == 0], after[fold_of == 0])


def test_seen_counts_are_the_range_of_each_electrode() -> None:
    counts = np.full((3, 3, 24), 2000, dtype=np.uint16)
    counts[1, 2, 23] = 1000
    counts[2, 0, 5] = 3000
    seen = seen_counts(counts)
    assert (seen.low[2][23], seen.high[2][23]) == (1000, 2000)
    assert (seen.low[0][5], seen.high[0][5]) == (2000, 3000)
    assert (seen.low[1][0], seen.high[1][0]) == (2000, 2000)


@pytest.mark.parametrize(
    ("count", "refused"), [(1750, False), (1749, True), (2250, False), (2251, True), (0, True)]
)
def test_a_count_beyond_the_margin_was_never_seen(count: int, refused: bool) -> None:
    row = (2000,) * 24
    seen = SeenCounts(low=(row,) * 3, high=(row,) * 3, margin=250)
    counts = np.full((2, 3, 24), 2000, dtype=np.uint16)
    counts[1, 1, 11] = count
    assert never_seen(counts, seen).tolist() == [False, refused]


def test_a_held_out_fold_does_not_widen_its_own_range() -> None:
    counts = np.full((4, 3, 24), 2000, dtype=np.uint16)
    counts[0, 0, 0] = 3000
    assert held_out_never_seen(counts, np.array([0, 0, 1, 1])) == 0.25


def test_uniformly_random_counts_are_refused_by_a_narrow_range() -> None:
    row = (2000,) * 24
    assert random_never_seen(SeenCounts((row,) * 3, (row,) * 3, 250), seed=1) == 1.0


def test_folds_are_stratified_and_leave_each_grasp_out_once() -> None:
    slipped = np.arange(200) % 4 == 0
    fold_of = folds_of(slipped, 10, seed=0)
    for fold in range(10):
        inside = fold_of == fold
        assert (int(inside.sum()), int(slipped[inside].sum())) == (20, 5)
    assert np.array_equal(fold_of, folds_of(slipped, 10, seed=0))
    assert not np.array_equal(fold_of, folds_of(slipped, 10, seed=1))


def test_too_few_grasps_of_one_class_are_refused() -> None:
    slipped = np.array([True] * 9 + [False] * 30)
    with pytest.raises(TooFewGraspsError, match="10 folds need 10 grasps of each class, one has 9"):
        folds_of(slipped, 10, seed=0)


def test_scores_take_slip_for_positive() -> None:
    # Verdicts slip, slip, slip, stable, stable against slip, slip, stable, slip, stable.
    values = np.array([[0.0, 1.0], [0.0, 2.0], [0.0, 3.0], [1.0, 0.0], [2.0, 0.0]])
    slipped = np.array([True, True, False, True, False])
    result = score(values, slipped)
    assert result.grasps == 5
    assert result.accuracy == pytest.approx(3 / 5)
    assert result.precision == pytest.approx(2 / 3)
    assert result.recall == pytest.approx(2 / 3)
    assert result.f1 == pytest.approx(2 / 3)
    assert result.auc == pytest.approx(3 / 6)  # pairs ranked right: (1, -2), (2, -2), (-1, -2)


def test_a_model_that_never_says_slip_scores_zero_without_complaint() -> None:
    result = score(np.array([[1.0, 0.0]] * 4), np.array([True, False, True, False]))
    assert (result.precision, result.recall, result.f1, result.auc) == (0.0, 0.0, 0.0, 0.5)
