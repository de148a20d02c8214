"""A session is calibrated without the judged grasps, and as the daemon does it."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("torch", reason="needs the extra `train`")

from graspd.models.inputs import SessionBuilder, raw_features
from graspd.models.training.fitting.standards import (
    DRAWN,
    Standards,
    TrainingStandards,
    Variant,
    later_session,
)
from tests.models.training.samples import sessions


def test_features_are_standardised_as_the_daemon_does() -> None:
    counts = sessions(50).counts[:50]
    features = raw_features(counts)
    standards = Standards.of(features)
    builder = SessionBuilder(3, clip=3.0)
    builder.use(standards.mean, standards.spread)
    expected = builder.build_batch(counts)[0]
    assert np.array_equal(standards.apply(features, 3.0), expected)


def test_a_constant_feature_is_not_divided_by_zero() -> None:
    standards = Standards.of(np.full((5, 2), 7.0))
    assert standards.apply(np.full((1, 2), 7.5), 3.0).tolist() == [[0.5, 0.5]]


def test_training_rows_are_standardised_by_their_own_table() -> None:
    features = np.array([[0.0], [2.0], [100.0], [104.0]])
    table_of = np.array([0, 0, 2, 2])
    training = TrainingStandards.of(features, table_of)
    standard = training.each(table_of).apply(features, 3.0)
    assert standard.ravel().tolist() == [-1.0, 1.0, -1.0, 1.0]
    # The prior: mean of all four rows; spread within the tables, sqrt((1 + 1 + 4 + 4) / 4).
    assert training.prior.mean.tolist() == [51.5]
    assert training.prior.spread == pytest.approx([np.sqrt(2.5)])
    with pytest.raises(KeyError):
        training.each(np.array([1, 1, 1, 1]))


def test_a_running_session_is_standardised_by_earlier_grasps() -> None:
    random = np.random.default_rng(1)
    features = random.normal(50.0, 4.0, (60, 3))
    training = TrainingStandards.of(features[:20], np.zeros(20, dtype=np.int64))
    test, pool = np.arange(25, 30), np.setdiff1d(np.arange(20, 60), np.arange(25, 30))
    standards, ages = later_session(features, test, pool, training, seed=0)
    assert ages[Variant.RUNNING_SORTED].tolist() == [5, 6, 7, 8, 9]
    by = standards[Variant.RUNNING_SORTED]
    statistics = training.statistics()
    for row in range(20, 29):
        statistics.observe(features[row])
    np.testing.assert_allclose(by.mean[4], statistics.mean)
    np.testing.assert_allclose(by.spread[4], statistics.spread)
    mixed = ages[Variant.RUNNING]
    assert len(set(mixed.tolist())) == 5
    assert mixed.tolist() != [5, 6, 7, 8, 9]


def test_judged_grasps_do_not_calibrate_their_session() -> None:
    features = np.random.default_rng(1).normal(50.0, 4.0, (60, 3))
    training = TrainingStandards.of(features[:20], np.zeros(20, dtype=np.int64))
    test, pool = np.arange(20, 30), np.arange(30, 60)
    changed = features.copy()
    changed[test] += 1000.0
    ours, theirs = (later_session(each, test, pool, training, 0)[0] for each in (features, changed))
    for variant in (Variant.NONE, *DRAWN, Variant.ALL):
        np.testing.assert_array_equal(ours[variant].mean, theirs[variant].mean)
    np.testing.assert_allclose(ours[Variant.ALL].mean, features[pool].mean(axis=0))
