"""Figures against hand calculation, published tables and scikit-learn."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import stats

from graspd.models.training.evaluating.metrics import (
    accuracy_at,
    coverage_curve,
    cross_fitted_p_slip,
    fit_temperature,
    over_seeds,
    p_slip,
    paired_difference,
    reject_threshold,
    reliability_bins,
    score,
    wilson,
)

# Six verdicts, the surest first: right, right, wrong, right, wrong, right.
PROBABILITY = np.array([0.99, 0.05, 0.90, 0.80, 0.30, 0.60])
SLIPPED = np.array([True, False, False, True, True, True])


def test_one_class_alone_has_no_auc() -> None:
    result = score(np.array([1.0, -1.0]), np.array([True, True]), np.array([0.9, 0.1]))
    assert result["auc"] is None
    assert (result["accuracy"], result["recall"]) == (0.5, 0.5)


def test_spread_over_folds_and_error_over_seeds() -> None:
    result = over_seeds([[0.8, 1.0], [0.6, 0.8]])
    # Fold means 0.9 and 0.7; each seed's folds lie 0.1 off their mean; error 0.1 * sqrt(2/2).
    assert result.mean == pytest.approx(0.8)
    assert result.std == pytest.approx(0.1)
    assert result.error == pytest.approx(0.1)
    assert (result.seeds, result.folds) == (2, 2)
    assert over_seeds([[0.8, 1.0]]).error is None
    # One fold of each seed: the spread is that of the trainings.
    assert over_seeds([[0.8], [1.0]]).std == pytest.approx(0.1)


def test_a_figure_that_a_fold_lacks_is_left_out() -> None:
    assert over_seeds([[0.8, None, 0.6]]).mean == pytest.approx(0.7)
    assert math.isnan(over_seeds([[None, None]]).mean)


def test_differences_of_overlapping_trainings_are_less_sure_than_they_look() -> None:
    ours, theirs = [0.95, 0.93, 0.94, 0.96], [0.92, 0.92, 0.92, 0.92]
    # Differences 3, 1, 2, 4 points: mean 2.5, variance 5/3. Ten folds: test/train = 1/9.
    mean, error = paired_difference(ours, theirs, 1.0 / 9.0)
    assert mean == pytest.approx(0.025)
    assert error == pytest.approx(math.sqrt((1 / 4 + 1 / 9) * 5 / 3) / 100)
    _, naive = paired_difference(ours, theirs, 0.0)
    assert naive == pytest.approx(math.sqrt(5 / 3 / 4) / 100)
    assert paired_difference([0.9], [0.8], 0.1)[1] is None


@pytest.mark.parametrize(
    ("right", "grasps", "low", "high"),
    # Newcombe 1998, Statistics in Medicine 17, table I, method 3 (score without continuity
    # correction): 81/263, 15/148, 0/20, 1/29.
    [
        (81, 263, 0.2553, 0.3662),
        (15, 148, 0.0624, 0.1605),
        (0, 20, 0.0, 0.1611),
        (1, 29, 0.0061, 0.1718),
    ],
)
def test_intervals_are_those_of_newcombes_table(
    right: int, grasps: int, low: float, high: float
) -> None:
    result = wilson(right / grasps, grasps)
    assert result.low == pytest.approx(low, abs=5e-5)
    assert result.high == pytest.approx(high, abs=5e-5)


def test_an_interval_holds_its_share_even_at_the_ends() -> None:
    for grasps in range(1, 300):
        for accuracy in (0.0, 1.0):
            result = wilson(accuracy, grasps)
            assert 0.0 <= result.low <= accuracy <= result.high <= 1.0


def test_the_curve_of_six_verdicts_worked_out_by_hand() -> None:
    curve = coverage_curve(PROBABILITY, SLIPPED, steps=6)
    assert [point.confidence for point in curve] == pytest.approx(
        [0.99, 0.95, 0.90, 0.80, 0.70, 0.60]
    )
    assert [point.accuracy for point in curve] == pytest.approx([1, 1, 2 / 3, 3 / 4, 3 / 5, 4 / 6])
    assert [point.coverage for point in curve] == pytest.approx([n / 6 for n in range(1, 7)])


def test_verdicts_of_the_same_confidence_are_judged_or_rejected_together() -> None:
    probability = np.array([0.9, 0.9, 0.1, 0.6])
    curve = coverage_curve(probability, np.array([True, True, True, True]), steps=4)
    assert [point.coverage for point in curve] == [0.75, 1.0]
    assert [point.accuracy for point in curve] == pytest.approx([2 / 3, 3 / 4])


def test_accuracy_at_a_coverage_is_that_of_the_surest() -> None:
    assert accuracy_at(PROBABILITY, SLIPPED, 0.5) == pytest.approx(2 / 3)
    assert accuracy_at(PROBABILITY, SLIPPED, 1.0) == pytest.approx(4 / 6)
    assert accuracy_at(PROBABILITY, SLIPPED, 0.0) == 1.0


def test_a_threshold_rejects_as_little_as_the_wanted_accuracy_allows() -> None:
    random = np.random.default_rng(8)
    probability = random.random(4000)
    slipped = random.random(4000) < probability  # calibrated
    found = reject_threshold(probability, slipped, 0.9)
    assert found is not None
    confidence = np.maximum(probability, 1 - probability)
    right = (probability > 0.5) == slipped
    judged = confidence >= found.confidence
    assert found.accuracy == pytest.approx(right[judged].mean())
    assert found.coverage == pytest.approx(judged.mean())
    assert found.accuracy >= 0.9
    lower = [c for c in confidence if c < found.confidence]
    for c in lower[:200]:
        several = right[confidence >= c]
        interval = stats.binomtest(int(several.sum()), len(several)).proportion_ci(method="wilson")
        assert interval.low < 0.9
    # Confidences are uniform in 0.5..1, so 0.9 on average means judging from 0.8 on.
    assert found.confidence == pytest.approx(0.83, abs=0.05)
    again = reject_threshold(np.tile(probability, 5), np.tile(slipped, 5), 0.9, repeats=5)
    assert again is not None
    assert again.confidence == found.confidence


def test_confidences_that_say_nothing_set_no_threshold() -> None:
    """Of verdicts that are right in 92 of 100 cases, however sure, none are in 95 of 100."""
    random = np.random.default_rng(0)
    found = 0
    for _ in range(200):
        confidence, says_slip = random.uniform(0.5, 1.0, 1000), random.random(1000) < 0.5
        right = random.random(1000) < 0.92
        probability = np.where(says_slip, confidence, 1.0 - confidence)
        found += reject_threshold(probability, says_slip == right, 0.95) is not None
    assert found <= 10


def test_a_few_lucky_verdicts_set_no_threshold() -> None:
    assert reject_threshold(PROBABILITY, SLIPPED, 0.9) is None


def test_reliability_bins_hold_every_grasp_once() -> None:
    bins = reliability_bins(np.array([0.0, 0.01, 0.5, 1.0]), np.array([False, True, True, True]))
    assert [number for _, _, number in bins] == [2, 1, 1]
    assert bins[0][:2] == pytest.approx((0.005, 0.5))


def test_scores_take_slip_for_positive() -> None:
    # Verdicts slip, slip, slip, stable, stable against slip, slip, stable, slip, stable.
    values = np.array([1.0, 2.0, 3.0, -1.0, -2.0])
    slipped = np.array([True, True, False, True, False])
    result = score(values, slipped, p_slip(values))
    assert result["accuracy"] == pytest.approx(3 / 5)
    assert result["precision"] == pytest.approx(2 / 3)
    assert result["recall"] == pytest.approx(2 / 3)
    assert result["f1"] == pytest.approx(2 / 3)
    assert result["auc"] == pytest.approx(3 / 6)  # pairs ranked right: (1, -2), (2, -2), (-1, -2)


def test_a_model_that_never_says_slip_scores_zero_without_complaint() -> None:
    result = score(np.array([-1.0] * 4), np.array([True, False, True, False]), np.full(4, 0.3))
    assert [result[name] for name in ("precision", "recall", "f1", "auc")] == [0.0, 0.0, 0.0, 0.5]


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


def test_scores_of_four_probabilities_are_those_worked_out_by_hand() -> None:
    probability = np.array([0.9, 0.9, 0.1, 0.62])
    slipped = np.array([True, False, False, True])
    # Confidence 0.9 three times, of which two are right: gap 3 * 0.9 - 2 = 0.7; then 1 - 0.62.
    # Brier: (0.1^2 + 0.9^2 + 0.1^2 + 0.38^2) / 4. Log loss: of 0.9, 0.1, 0.9 and 0.62.
    result = score(probability - 0.5, slipped, probability)
    assert result["ece"] == pytest.approx((0.7 + 0.38) / 4)
    assert result["brier"] == pytest.approx((0.01 + 0.81 + 0.01 + 0.1444) / 4)
    assert result["log_loss"] == pytest.approx(-math.log(0.9 * 0.1 * 0.9 * 0.62) / 4)


def test_a_fold_is_calibrated_by_the_other_folds_alone() -> None:
    random = np.random.default_rng(5)
    margins, slipped = random.normal(size=300), random.random(300) < 0.5
    fold_of = np.arange(300) % 3
    before = cross_fitted_p_slip(margins, slipped, fold_of)
    other_labels = np.where(fold_of == 1, ~slipped, slipped)
    after = cross_fitted_p_slip(margins, other_labels, fold_of)
    assert np.array_equal(before[fold_of == 1], after[fold_of == 1])
    assert not np.array_equal(before[fold_of == 0], after[fold_of == 0])
