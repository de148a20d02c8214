"""Systems of hands with fewer sensors: fewer channels, and nothing padded."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from graspd.models.runtime import TactileModel
from graspd.models.training.evaluating import jobs
from graspd.models.training.evaluating.jobs import Job
from graspd.models.training.making.make_model import make_model
from graspd.models.training.making.plan import TrainingPlan
from graspd.models.training.systems.registry import SYSTEMS
from graspd.models.training.systems.system import digest, with_recipes
from tests.daemon.judge.test_fewer_fingers import HANDS
from tests.models.training.samples import sessions


def test_there_is_a_form_of_the_default_system_for_every_smaller_hand() -> None:
    whole = SYSTEMS["small-session"]
    for name, fingers in HANDS.items():
        system = SYSTEMS[name]
        assert system.fingers == fingers
        assert digest(system) != digest(whole)
        assert digest(dataclasses.replace(system, fingers=whole.fingers)) == digest(whole)


def test_grasps_of_fewer_fingers_are_those_columns() -> None:
    grasps = sessions(60)
    two = grasps.of_fingers(("ff", "th"))
    np.testing.assert_array_equal(two.counts, grasps.counts[:, [0, 2]])
    np.testing.assert_array_equal(two.slipped, grasps.slipped)
    with pytest.raises(ValueError, match="have not the fingers lf"):
        grasps.of_fingers(("lf",))
    with pytest.raises(ValueError, match="have not the fingers ff"):
        two.of_fingers(("ff",))


def test_what_the_other_fingers_feel_changes_nothing() -> None:
    grasps = sessions(120)
    other = dataclasses.replace(grasps, counts=grasps.counts.copy())
    other.counts[:, 1] = 3000
    job = Job(with_recipes(SYSTEMS["small-session-ff-th"], epochs=1), "cv", 0, 0, 3)
    one, two = (jobs.run(job, sample) for sample in (grasps, other))
    for name, margins in one.margins.items():
        np.testing.assert_array_equal(margins, two.margins[name])

    whole = Job(with_recipes(SYSTEMS["small-session"], epochs=1), "cv", 0, 0, 3)
    assert one.parameters < jobs.run(whole, grasps).parameters


def test_a_model_of_two_fingers_takes_the_features_of_two(tmp_path: Path) -> None:
    grasps = sessions(200)
    system = with_recipes(SYSTEMS["small-session-ff-th"], epochs=1)
    make_model(
        TrainingPlan(system, 3, 0, only="cv"), grasps, tmp_path, tmp_path / "jobs", lambda: None
    )
    model = TactileModel(tmp_path / "small-session-ff-th.onnx")
    assert model.contract.fingers == ("ff", "th")
    assert model.input.shape == (2 * 26,)
