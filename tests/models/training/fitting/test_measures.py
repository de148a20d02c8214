"""Calibration, seen counts and protocols against figures worked out by hand or by scikit-learn."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

pytest.importorskip("torch", reason="the train extra is not installed")
pytest.importorskip("sklearn", reason="the train extra is not installed")

from sklearn.metrics import brier_score_loss, log_loss

from models.novelty import NoveltyCheck
from models.training.data.folds import TooFewGraspsError, folds_of
from models.training.evaluating.metrics import score
from models.training.fitting.calibration import (
    cross_fitted_p_slip,
    fit_temperature,
    p_slip,
    reliability,
)
from models.training.fitting.seen import (
    held_out_never_seen,
    made_up_never_seen,
    seen_counts,
)


@pytest.mark.parametrize("true_temperature", [0.5, 1.0, 3.0])
def test_the_temperature_that_made_the_labels_is_found(true_temperature: float) -> None:
    random = np.random.default_rng(3)
    logits = random.normal(0.0, 4.0, (40_000, 2))
    chance = 1.0 / (1.0 + np.exp((logits[:, 0] - logits[:, 1]) / true_temperature))
    slipped = random.random(40_000) < chance
    assert fit_temperature(logits, slipped) == pytest.approx(true_temperature, rel=0.03)


def test_margins_and_logits_give_the_same_calibration() -> None:
    random = np.random.default_rng(4)
    logits, slipped = random.normal(size=(200, 2)), random.random(200) < 0.5
    margins = logits[:, 1] - logits[:, 0]
    fold_of = np.arange(200) % 4
    assert fit_temperature(margins, slipped) == fit_temperature(logits, slipped)
    ours, theirs = (cross_fitted_p_slip(each, slipped, fold_of) for each in (margins, logits))
    assert np.array_equal(ours, theirs)


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


def random_counts(number: int) -> NDArray[np.uint16]:
    """Correlated readings: one common part moves all electrodes together."""
    random = np.random.default_rng(5)
    common = random.normal(0.0, 200.0, (number, 1, 1))
    own = random.normal(0.0, 10.0, (number, 3, 24))
    counts: NDArray[np.uint16] = (2000.0 + common + own).astype(np.uint16)
    return counts


def test_seen_counts_are_range_mean_and_inverse_covariance() -> None:
    counts = random_counts(500)
    seen = seen_counts(counts)
    assert seen.low[2][23] == counts[:, 2, 23].min()
    assert seen.high[0][5] == counts[:, 0, 5].max()
    np.testing.assert_allclose(np.array(seen.centre), counts.mean(axis=0), rtol=1e-8)
    lower = np.zeros((72, 72))
    for index, row in enumerate(seen.whitening):
        lower[index, : len(row)] = row
    # The inverse covariance, with 5 counts of sensor noise on each electrode.
    covariance = np.cov(counts.reshape(500, 72).T) + 25.0 * np.eye(72)
    np.testing.assert_allclose(lower @ lower.T @ covariance, np.eye(72), atol=1e-5)


def test_values_that_are_possible_alone_but_not_together_were_never_seen() -> None:
    counts = random_counts(500)
    check = NoveltyCheck(seen_counts(counts))
    assert check.never_seen(counts).mean() < 0.02
    torn = counts[:1].copy()
    torn[0, 0, ::2], torn[0, 0, 1::2] = counts.min() + 50, counts.max() - 50
    assert check.never_seen(torn).tolist() == [True]


def test_a_held_out_fold_is_not_judged_by_its_own_range() -> None:
    counts = random_counts(100)
    counts[:2, 0, 0] = 3500
    group_of = np.arange(100) // 50
    # Both odd readings are in the first group, so nothing in the second looks like them.
    assert held_out_never_seen(counts, group_of) >= 0.02
    assert NoveltyCheck(seen_counts(counts)).never_seen(counts)[:2].tolist() == [False, False]


def test_made_up_readings_are_refused() -> None:
    counts = random_counts(500)
    fractions = made_up_never_seen(counts, seen_counts(counts), seed=1)
    assert len(fractions) == 4
    assert fractions.pop("middle of the ranges, with noise") < 1.0  # here this is a usual reading
    assert set(fractions.values()) == {1.0}


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
