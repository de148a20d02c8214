"""When a judged grasp becomes part of the session: after its verdict, and before anybody looks."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray

from daemon.judge.calibration import SessionCalibration
from daemon.judge.decision import Limits
from daemon.judge.pipeline import Pipeline
from drivers.base import TactileReading
from drivers.twins.grasps import synthetic
from models import zoo
from models.runtime import TactileModel

Learnt = list[NDArray[np.generic]]


def grasps(number: int) -> NDArray[np.uint16]:
    """Counts of grasps that nobody ever grasped, shape (number, 3, 24)."""
    drawn = synthetic.draw(synthetic.read_model(), np.random.default_rng(1), number)
    return drawn.counts.reshape(number, 3, 24)


def judge(pipeline: Pipeline, rows: NDArray[np.uint16]) -> None:
    for seq, row in enumerate(rows):
        pipeline.judge(TactileReading(0, seq, row, np.zeros(row.shape, dtype=np.uint8)))


@pytest.fixture
def pipeline() -> Pipeline:
    model = TactileModel(zoo.find("small-session"))
    return Pipeline(model, model.contract.fingers, Limits(max_age_ns=10**9), lambda: 0)


@pytest.fixture
def learnt(monkeypatch: pytest.MonkeyPatch) -> Learnt:
    """What the session took in, in turn."""
    taken: Learnt = []
    monkeypatch.setattr(SessionCalibration, "observe", lambda _, counts, slip: taken.append(counts))
    return taken


def test_a_verdict_does_not_wait_for_its_grasp_to_be_learnt(
    pipeline: Pipeline, learnt: Learnt
) -> None:
    judge(pipeline, grasps(3))
    assert len(learnt) == 2, "the third waits for the next reading"


@pytest.mark.parametrize("look", [lambda it: it.session, lambda it: it.health()])
def test_who_looks_sees_the_grasp_that_was_just_judged(
    pipeline: Pipeline, learnt: Learnt, look: Callable[[Pipeline], object]
) -> None:
    judge(pipeline, grasps(3))
    look(pipeline)
    assert len(learnt) == 3
    look(pipeline)
    assert len(learnt) == 3, "once"


def test_a_grasp_of_a_sensor_that_was_exchanged_is_not_learnt(pipeline: Pipeline) -> None:
    judge(pipeline, grasps(3))
    pipeline.sensors_exchanged()
    assert pipeline.session is not None
    assert pipeline.session.grasps == 0
