"""Figures against hand calculation, published tables and scikit-learn."""

from __future__ import annotations

import math

import numpy as np
import pandas as pd
import pytest
from scipy import stats

from graspd.models.training.evaluating.metrics import (
    accuracy_at,
    coverage_curve,
    cross_fitted,
    f1_interval,
    fit_temperature,
    interval,
    over_seeds,
    paired_difference,
    score,
    verdict_figures,
)

# Six verdicts, the surest first: right, right, wrong, right, wrong, right.
PROBABILITY = pd.Series([0.99, 0.05, 0.90, 0.80, 0.30, 0.60])
SLIPPED = pd.Series([True, False, False, True, True, True])


def test_spread_is_over_folds_and_error_over_seeds() -> None:
    result = over_seeds(np.array([[0.8, 1.0], [0.6, 0.8]]))
    # Fold means 0.9 and 0.7; each seed's folds lie 0.1 off their mean; error 0.1 * sqrt(2/2).
    assert result.mean == pytest.approx(0.8)
    assert result.std == pytest.approx(0.1)
    assert result.error == pytest.approx(0.1)
    assert (result.seeds, result.folds) == (2, 2)
    assert over_seeds(np.array([[0.8, 1.0]])).error is None
    # One fold of each seed: the spread is that of the trainings.
    assert over_seeds(np.array([[0.8], [1.0]])).std == pytest.approx(0.1)
    # A figure that a fold lacks is left out.
    assert over_seeds(np.array([[0.8, math.nan, 0.6]])).mean == pytest.approx(0.7)
    assert math.isnan(over_seeds(np.array([[math.nan, math.nan]])).mean)


def test_the_error_of_differences_accounts_for_overlapping_trainings() -> None:
    gaps = np.array([0.03, 0.01, 0.02, 0.04])
    # Mean 2.5 points, variance 5/3. Ten folds: test/train = 1/9.
    mean, error = paired_difference(gaps, 1.0 / 9.0)
    assert mean == pytest.approx(0.025)
    assert error == pytest.approx(math.sqrt((1 / 4 + 1 / 9) * 5 / 3) / 100)
    _, naive = paired_difference(gaps, 0.0)
    assert naive == pytest.approx(math.sqrt(5 / 3 / 4) / 100)
    assert paired_difference(gaps[:1], 0.1)[1] is None


def right_of(*objects: list[int]) -> tuple[pd.Series, pd.Series, pd.Series]:
    """Return arguments of `interval`, a row per verdict: 1 if right else 0; 1; object's number.

    `objects`: for each object, 1 for a right verdict and 0 for a wrong one."""
    names = np.repeat(np.arange(len(objects)), [len(verdicts) for verdicts in objects])
    right = pd.Series(np.concatenate(objects))
    return right, pd.Series(np.ones(len(right))), pd.Series(names)


def test_the_interval_comes_from_drawing_objects_not_grasps() -> None:
    # Objects that are judged alike tell nothing of others: 3 of 4 each.
    assert interval(*right_of(*[[1, 1, 1, 0]] * 30)) == (0.75, 0.75)
    # Forty objects, of which ten are always judged wrongly: as forty draws of a coin of 3/4.
    low, high = interval(*right_of(*[[1] * 50] * 30, *[[0] * 50] * 10))
    assert (low, high) == pytest.approx(stats.binom.ppf((0.025, 0.975), 40, 0.75) / 40, abs=0.03)
    # The same grasps ten times say nothing more.
    assert (low, high) == interval(*right_of(*[[1] * 500] * 30, *[[0] * 500] * 10))


def test_one_object_or_no_slip_has_no_f1_interval() -> None:
    rows = pd.DataFrame({"margin": [1.0, -1.0], "slipped": True, "object": ["cup", "pen"]})
    # Drawn are cup twice, which is judged rightly, or pen twice, or both.
    assert f1_interval(rows) == (0.0, 1.0)
    assert f1_interval(rows.assign(object="cup")) is None
    assert f1_interval(rows.assign(margin=-1.0, slipped=False)) is None


def test_the_coverage_curve_of_six_verdicts_equals_hand_calculation() -> None:
    curve = coverage_curve(PROBABILITY, SLIPPED, steps=6)
    assert [point.confidence for point in curve] == pytest.approx(
        [0.99, 0.95, 0.90, 0.80, 0.70, 0.60]
    )
    assert [point.accuracy for point in curve] == pytest.approx([1, 1, 2 / 3, 3 / 4, 3 / 5, 4 / 6])
    assert [point.coverage for point in curve] == pytest.approx([n / 6 for n in range(1, 7)])


def test_verdicts_of_the_same_confidence_are_judged_or_rejected_together() -> None:
    probability = pd.Series([0.9, 0.9, 0.1, 0.6])
    curve = coverage_curve(probability, pd.Series([True, True, True, True]), steps=4)
    assert [point.coverage for point in curve] == [0.75, 1.0]
    assert [point.accuracy for point in curve] == pytest.approx([2 / 3, 3 / 4])


def test_accuracy_at_a_coverage_is_that_of_the_surest() -> None:
    assert accuracy_at(PROBABILITY, SLIPPED, 0.5) == pytest.approx(2 / 3)
    assert accuracy_at(PROBABILITY, SLIPPED, 1.0) == pytest.approx(4 / 6)
    assert accuracy_at(PROBABILITY, SLIPPED, 0.0) == 1.0


def test_scores_take_slip_for_positive() -> None:
    """Only the choice of the positive class is tested; formulas are those of scikit-learn."""
    # Verdicts slip, slip, slip, stable, stable against slip, slip, stable, slip, stable.
    values = np.array([1.0, 2.0, 3.0, -1.0, -2.0])
    slipped = np.array([True, True, False, True, False])
    result = score(values, slipped, 1.0 / (1.0 + np.exp(-values)))
    assert result["precision"] == result["recall"] == pytest.approx(2 / 3)
    assert result["auc"] == pytest.approx(3 / 6)  # pairs ranked right: (1, -2), (2, -2), (-1, -2)
    never = score(np.full(2, -1.0), np.array([True, False]), np.full(2, 0.3))
    assert never["precision"] == never["f1"] == 0.0
    one_class = score(np.array([1.0, -1.0]), np.array([True, True]), np.array([0.9, 0.1]))
    assert math.isnan(one_class["auc"])


@pytest.mark.parametrize("true_temperature", [0.5, 3.0])
def test_the_temperature_that_made_the_labels_is_found(true_temperature: float) -> None:
    random = np.random.default_rng(3)
    margins = random.normal(0.0, 5.0, 40_000)
    slipped = random.random(40_000) < 1.0 / (1.0 + np.exp(-margins / true_temperature))
    assert fit_temperature(margins, slipped) == pytest.approx(true_temperature, rel=0.03)


@pytest.mark.parametrize(("sign", "end"), [(1.0, 0.05), (-1.0, 20.0)])
def test_the_temperature_of_separable_labels_ends_at_a_bound(sign: float, end: float) -> None:
    margins = sign * np.array([-1.0, 1.0, -2.0, 3.0])
    slipped = np.array([False, True, False, True])
    assert fit_temperature(margins, slipped) == pytest.approx(end)


def test_the_expected_calibration_error_equals_hand_calculation() -> None:
    probability = np.array([0.9, 0.9, 0.1, 0.62])
    # Confidence 0.9 three times, of which two are right: gap 3 * 0.9 - 2 = 0.7; then 1 - 0.62.
    result = score(probability - 0.5, np.array([True, False, False, True]), probability)
    assert result["ece"] == pytest.approx((0.7 + 0.38) / 4)


def test_a_fold_is_calibrated_by_the_other_folds_alone() -> None:
    random = np.random.default_rng(5)
    fold_of = pd.Series(np.arange(300) % 3)
    rows = pd.DataFrame(
        {
            "margin": random.normal(size=300),
            "slipped": random.random(300) < 0.5,
            "fold": fold_of,
        }
    )
    before = cross_fitted(rows)
    after = cross_fitted(rows.assign(slipped=rows["slipped"] ^ (fold_of == 1)))
    assert before[fold_of == 1].equals(after[fold_of == 1])
    assert not before[fold_of == 0].equals(after[fold_of == 0])


def test_verdict_figures_of_ten_grasps_equal_hand_calculation() -> None:
    slipped = np.array([True] * 4 + [False] * 6)
    called = np.array([True, True, True, False, True, True, False, False, False, False])
    figures = verdict_figures(pd.DataFrame({"slipped": slipped, "margin": called - 0.5}))
    assert figures["f1"] == pytest.approx(2 * 3 / (2 * 3 + 1 + 2))
    assert figures["slips_among_stable"] == pytest.approx(1 / 5)
    assert figures["slips_called_stable"] == pytest.approx(1 / 4)
    assert figures["stable_called_slip"] == pytest.approx(2 / 6)
    nothing = verdict_figures(pd.DataFrame({"slipped": slipped[:0], "margin": called[:0] - 0.5}))
    assert (nothing["grasps"], nothing["slips_among_stable"]) == (0, None)
