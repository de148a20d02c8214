"""When the session takes in a judged grasp: once, after its verdict, when the grasp is over."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from graspd.daemon.judge.decision import HandLimits, Limits
from graspd.daemon.judge.pipeline import Judgement, Pipeline
from graspd.daemon.judge.reasons import Decision, GateState, Moment, Reason
from graspd.drivers.twins.grasps import synthetic
from graspd.drivers.twins.grasps.whole_grasps import synthetic_grasps
from graspd.models import zoo
from graspd.models.judge.session import SessionCalibration
from graspd.models.runtime import TactileModel
from tests.daemon.fakes import Clock, sound

Learnt = list[NDArray[np.generic]]


def grasps(number: int) -> NDArray[np.uint16]:
    """Counts of made-up grasps, shape (number, 3, 24)."""
    drawn = synthetic.draw(synthetic.read_model(), np.random.default_rng(1), number)
    return drawn.counts.reshape(number, 3, 24)


def judge(pipeline: Pipeline, rows: NDArray[np.uint16]) -> list[Judgement]:
    return [pipeline.judge(sound(row)) for row in rows]


@pytest.fixture
def pipeline() -> Pipeline:
    model = TactileModel(zoo.find("small-session"))
    return Pipeline(model, model.contract.fingers, Limits(max_age_ns=10**9), lambda: 0)


@pytest.fixture
def learnt(monkeypatch: pytest.MonkeyPatch) -> Learnt:
    """Counts of the grasps that the session was given, oldest first; it ignores them."""
    taken: Learnt = []
    monkeypatch.setattr(SessionCalibration, "observe", lambda _, counts, slip: taken.append(counts))
    return taken


def test_a_grasp_is_learnt_once_after_its_verdict(pipeline: Pipeline, learnt: Learnt) -> None:
    judge(pipeline, grasps(3))
    assert pipeline.session is not None
    assert pipeline.health()["session"] is Reason.NOT_CALIBRATED
    assert len(learnt) == 2, "the third waits for the next reading, whoever looks"
    pipeline.learn()
    pipeline.learn()
    assert len(learnt) == 3


def test_grasps_from_before_an_exchange_of_sensors_are_not_learnt(pipeline: Pipeline) -> None:
    judge(pipeline, grasps(3))
    pipeline.sensors_exchanged()
    assert pipeline.session is not None
    assert pipeline.session.grasps == 0


def test_the_session_learns_each_grasp_with_its_judged_decision(
    pipeline: Pipeline, monkeypatch: pytest.MonkeyPatch
) -> None:
    slips: list[bool | None] = []
    monkeypatch.setattr(SessionCalibration, "observe", lambda *_, slip: slips.append(slip))
    judged = judge(pipeline, grasps(40))
    pipeline.learn()
    known = [it for it in judged if it.decision is not Decision.UNKNOWN]
    told = [slip for slip in slips if slip is not None]  # None: it is like nothing seen before
    assert told == [it.decision is Decision.SLIP for it in known]
    assert set(told) == {False, True}


def test_a_judge_that_needs_a_session_says_unknown_until_calibrated() -> None:
    model = TactileModel(zoo.find("small-session"))
    careful, bold = (
        Pipeline(model, model.contract.fingers, Limits(10**9), lambda: 0, needs_session=needs)
        for needs in (True, False)
    )
    rows, calibrated = grasps(60), []
    for mine, other in zip(judge(careful, rows), judge(bold, rows), strict=True):
        if mine.session_calibrated:
            assert (mine.decision, mine.p_slip) == (other.decision, other.p_slip)
            calibrated.append(mine.decision)
        else:
            assert mine.decision is Decision.UNKNOWN
            assert Reason.NOT_CALIBRATED in mine.reasons
            assert Reason.NOT_CALIBRATED not in other.reasons
    assert Decision.STABLE in calibrated


def test_a_session_learns_only_from_steady_readings_once_per_grasp(
    monkeypatch: pytest.MonkeyPatch, learnt: Learnt
) -> None:
    model = TactileModel(zoo.find("small-session"))
    gated = Pipeline(model, model.contract.fingers, Limits(10**9), lambda: 0, hand=HandLimits())
    steady = [(1, False), (2, False), (2, True), (2, True), (3, False), (4, False)]
    moments = [Moment(grasp, GateState.JUDGED, steady=each) for grasp, each in steady]
    rows = grasps(len(steady))
    now = iter(zip(moments, rows, strict=True))
    monkeypatch.setattr(gated.hand, "step", lambda *_, **__: next(now))
    judge(gated, rows)
    # Of the second grasp alone: the first reading by which it kept still.
    np.testing.assert_array_equal(learnt, rows[2:3])


def test_the_session_learns_a_grasp_only_when_it_is_over(learnt: Learnt) -> None:
    model, clock = TactileModel(zoo.find("small-session")), Clock()
    gated = Pipeline(model, model.contract.fingers, Limits(), clock, hand=HandLimits())
    judged = []
    for moment in synthetic_grasps(1, seed=1):
        clock.now_ns += 10_000_000
        said = gated.judge(sound(moment.counts, clock()))
        gated.learn()
        judged += [said.judged_counts] if said.moment.judged else []
        if said.moment.state is GateState.JUDGED:
            assert not learnt
    assert len(learnt) == 1
    np.testing.assert_array_equal(learnt[0], judged[0])
