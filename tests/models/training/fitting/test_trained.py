"""Counts of drifted sensors, mapped to those of the training, on made-up grasps."""

from __future__ import annotations

import numpy as np

from graspd.models.training.fitting.novelty import MARGIN_COUNTS, SESSION_MARGIN_COUNTS
from graspd.models.training.fitting.trained import SensorMapping
from tests.models.training.evaluation_samples import sessions


def test_a_session_model_sees_drifted_tables_as_if_of_the_same_sensors() -> None:
    grasps = sessions(200)
    sensors = SensorMapping.of(grasps.counts, grasps.table_of, session=True)
    mapped = sensors.to_training(grasps.counts, grasps.table_of)
    means = [mapped[grasps.table_of == table].mean(axis=0) for table in range(3)]
    # Electrodes 17 to 20 of the first finger of the last table were recorded 800 counts lower.
    np.testing.assert_allclose(means[2], means[0], atol=1e-6)
    np.testing.assert_allclose(means[1], means[0], atol=1e-6)
    back = sensors.from_training(mapped, grasps.table_of)
    np.testing.assert_allclose(back, grasps.counts, atol=1e-6)
    assert sensors.margin == SESSION_MARGIN_COUNTS


def test_other_models_take_the_counts_as_they_are() -> None:
    grasps = sessions(40)
    sensors = SensorMapping.of(grasps.counts, grasps.table_of, session=False)
    np.testing.assert_array_equal(
        sensors.to_training(grasps.counts, grasps.table_of), grasps.counts
    )
    assert sensors.margin == MARGIN_COUNTS
