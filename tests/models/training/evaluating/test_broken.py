"""The study of broken electrodes, and the mapping of a session's counts, on made-up grasps."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("torch", reason="the train extra is not installed")

from models.training.evaluating.broken import KINDS, NUMBERS, broken_study
from models.training.fitting.novelty import MARGIN_COUNTS, SESSION_MARGIN_COUNTS
from models.training.fitting.sensor_mapping import SensorMapping
from models.training.systems.registry import SYSTEMS
from tests.models.training.evaluation_samples import sessions


def test_a_session_model_sees_drifted_tables_as_if_of_the_same_sensors() -> None:
    grasps = sessions(200)
    looks = SensorMapping.of(grasps.counts, grasps.table_of, session=True)
    mapped = looks.to_training(grasps.counts, grasps.table_of)
    means = [mapped[grasps.table_of == table].mean(axis=0) for table in range(3)]
    # Electrodes 17 to 20 of the first finger of the last table were recorded 800 counts lower.
    np.testing.assert_allclose(means[2], means[0], atol=1e-6)
    np.testing.assert_allclose(means[1], means[0], atol=1e-6)
    back = looks.from_training(mapped, grasps.table_of)
    np.testing.assert_allclose(back, grasps.counts, atol=1e-6)
    assert looks.margin == SESSION_MARGIN_COUNTS


def test_other_models_take_the_counts_as_they_are() -> None:
    grasps = sessions(40)
    looks = SensorMapping.of(grasps.counts, grasps.table_of, session=False)
    np.testing.assert_array_equal(looks.to_training(grasps.counts, grasps.table_of), grasps.counts)
    assert looks.margin == MARGIN_COUNTS


@pytest.mark.parametrize("name", ["svm", "svm-session"])
def test_dead_electrodes_cost_less_once_they_are_repaired(name: str) -> None:
    study = broken_study(SYSTEMS[name], sessions(150), seed=1)
    assert len(study.broken) == len(KINDS) * len(NUMBERS)
    assert study.grasps == 135
    # A tenth of the labels is wrong, so 90 % is the best that anybody could reach.
    assert study.sound > 0.8
    dead = next(b for b in study.broken if b.reads == "at 0" and b.number == 12)
    assert dead.unnoticed < dead.known
    assert dead.known > study.sound - 0.05


def test_the_study_looks_for_one_more_broken_electrode_than_the_daemon_repairs() -> None:
    from daemon.judge.health import BROKEN_MAX
    from models.training.evaluating.broken import LOOKED_FOR_MAX

    assert LOOKED_FOR_MAX == BROKEN_MAX + 1
