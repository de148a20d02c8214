"""Classifiers of scikit-learn behind one function."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("torch", reason="needs the extra `train`")

from graspd.models.inputs import VectorBuilder
from graspd.models.training.estimators.classical import fit_classical
from graspd.models.training.estimators.configs import (
    ForestConfig,
    MlpConfig,
    SvmConfig,
)
from tests.models.training.samples import separable_counts

COUNTS, SLIPPED = separable_counts(120)
VECTORS = VectorBuilder(3).build_batch(COUNTS)[0]


def test_a_unanimous_forest_has_a_finite_margin() -> None:
    """All trees agree, so probabilities are clipped to 0.001 and 0.999: log-odds +-6.9068."""
    fitted = fit_classical(ForestConfig(11, None), VECTORS, SLIPPED, seed=0)
    assert np.abs(fitted.margins(VECTORS)).max() == pytest.approx(6.90675, abs=1e-4)


def test_a_perceptron_counts_its_weights_and_keeps_large_margins() -> None:
    fitted = fit_classical(MlpConfig((8, 4), epochs=300), VECTORS, SLIPPED, seed=0)
    assert fitted.parameters == 72 * 8 + 8 + 8 * 4 + 4 + 4 + 1
    margins = fitted.margins(20.0 * VECTORS)
    assert np.isfinite(margins).all()
    assert np.abs(margins).max() > 40.0  # where a probability in double precision is 1


def test_classes_weigh_the_same_however_many_grasps_each_has() -> None:
    """Nine in ten grasps slip, so a stable grasp may weigh nine times as much."""
    random = np.random.default_rng(0)
    inputs = random.normal(size=(400, 72)).astype(np.float32)
    slipped = np.arange(400) % 10 > 0
    fitted = fit_classical(SvmConfig(0.01, 0.0001), inputs, slipped, seed=0)
    weights = np.abs(fitted.model.dual_coef_[0])
    assert weights.max() / weights.min() == pytest.approx(9.0, rel=0.01)


def test_fitting_images_or_a_single_class_is_refused() -> None:
    images, slipped = np.zeros((4, 12, 11, 3), np.float32), np.ones(120, np.bool_)
    with pytest.raises(ValueError, match="takes vectors"):
        fit_classical(SvmConfig(1.0, 0.1), images, SLIPPED[:4], seed=0)
    with pytest.raises(ValueError, match="one class"):
        fit_classical(SvmConfig(1.0, 0.1), VECTORS, slipped, seed=0)
