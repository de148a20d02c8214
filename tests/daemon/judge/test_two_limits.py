"""Two limits of motion: a grasp settles by the strict one and goes on by the loose one."""

from __future__ import annotations

import numpy as np
import pytest

from graspd.daemon.judge.decision import HandLimits, Limits
from graspd.daemon.judge.pipeline import Pipeline
from graspd.daemon.judge.reasons import GateState, Moment, Reason
from graspd.drivers.twins.grasps.grasps import Counts
from graspd.models import zoo
from graspd.models.judge.session import SessionCalibration
from graspd.models.runtime import TactileModel
from tests.daemon.judge.test_gate_limits import Steps
from tests.daemon.judge.test_learning import grasps, judge


def trembling(steps: Steps, counts: float) -> None:
    """Half a second in which every electrode of FF goes to and fro, ten times a second."""
    for place in range(50):
        steps.step(counts=3000 + counts * np.sin(2.0 * np.pi * place / 10.0))


def test_a_settled_grasp_goes_on_where_it_would_not_settle() -> None:
    steps = Steps(on_request=True)
    steps.hold()
    trembling(steps, 4.0)
    strict, loose = steps.motion.strict, steps.motion.loose
    assert not strict.sure
    assert loose.sure
    assert (steps.now.state, steps.now.reasons) == (GateState.SETTLED, (Reason.NOT_ASKED,))
    assert steps.now.motion_limits is not None
    assert steps.now.motion_limits["ff"] in np.round((loose.fast[0], loose.slow[0]), 2)
    assert not steps.now.steady
    steps.gate.ask()
    trembling(steps, 4.0)
    assert steps.now.settled
    assert not steps.now.steady
    # Once it has gone, it comes back by the strict limit alone.
    trembling(steps, 40.0)
    trembling(steps, 4.0)
    assert steps.now.state is GateState.CLOSING
    assert steps.now.reasons == (Reason.MOVING,)
    strict = steps.motion.strict
    assert steps.now.motion_limits is not None
    assert steps.now.motion_limits["ff"] in np.round((strict.fast[0], strict.slow[0]), 2)


def test_a_changed_grasp_settles_by_the_strict_limit() -> None:
    steps = Steps()
    steps.grasp()
    trembling(steps, 4.0)
    assert steps.now.settled
    steps.story()
    steps.step(counts=3041)
    for place in range(60):
        steps.step(counts=3041 + 4.0 * np.sin(2.0 * np.pi * place / 10.0))
    assert steps.story() == "closing:changed"


def test_a_session_learns_only_what_the_strict_limit_lets_pass(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    model = TactileModel(zoo.find("small-session"))
    limits, hand = Limits(max_age_ns=10**9), HandLimits()
    pipeline = Pipeline(model, model.contract.fingers, limits, lambda: 0, hand=hand)
    learnt: list[Counts] = []
    monkeypatch.setattr(
        SessionCalibration, "observe", lambda _self, counts, **_: learnt.append(counts)
    )
    rows = grasps(6)
    steady = [(1, False), (2, False), (2, True), (2, True), (3, False), (4, False)]
    moments = [Moment(grasp, GateState.JUDGED, steady=each) for grasp, each in steady]
    now = iter(zip(moments, rows, strict=True))
    monkeypatch.setattr(pipeline.hand, "step", lambda *_, **__: next(now))
    judge(pipeline, rows)
    # Of the second grasp alone: the first reading by which it kept still.
    np.testing.assert_array_equal(learnt, rows[2:3])
