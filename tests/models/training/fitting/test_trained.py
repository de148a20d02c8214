"""Counts of drifted sensors, mapped to those of the training, on made-up grasps."""

from __future__ import annotations

import numpy as np

from graspd.models.training.fitting.novelty import MARGIN_COUNTS, SESSION_MARGIN_COUNTS
from graspd.models.training.fitting.trained import train
from graspd.models.training.systems.registry import SYSTEMS
from tests.models.training.samples import sessions


def test_a_session_model_sees_drifted_tables_as_if_of_the_same_sensors() -> None:
    grasps = sessions(200)
    trained = train(SYSTEMS["svm-session"], grasps, 0)
    mapped = trained.mapped(grasps.counts, grasps.table_of)
    means = [mapped[grasps.table_of == table].mean(axis=0) for table in range(3)]
    # Electrodes 17 to 20 of the first finger of the last table were recorded 800 counts lower.
    np.testing.assert_allclose(means[2], means[0], atol=1e-6)
    np.testing.assert_allclose(means[1], means[0], atol=1e-6)
    back = trained.unmapped(mapped, grasps.table_of)
    np.testing.assert_allclose(back, grasps.counts, atol=1e-6)
    assert trained.seen().margin == SESSION_MARGIN_COUNTS


def test_other_models_take_the_counts_as_they_are() -> None:
    grasps = sessions(40)
    trained = train(SYSTEMS["svm"], grasps, 0)
    np.testing.assert_array_equal(trained.mapped(grasps.counts, grasps.table_of), grasps.counts)
    assert trained.seen().margin == MARGIN_COUNTS
