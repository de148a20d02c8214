"""Whole grasps from real end points with the real sensors' noise: judged once, before the lift."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from graspd.daemon.judge.decision import HandLimits, Limits
from graspd.daemon.judge.pipeline import Judgement, Pipeline
from graspd.daemon.judge.reasons import Decision, Reason
from graspd.drivers.base import JointReading
from graspd.drivers.twins.grasps.grasp_script import Timetable
from graspd.drivers.twins.grasps.whole_grasps import WholeGrasps, rest_above
from graspd.models import zoo
from graspd.models.runtime import TactileModel
from tests.daemon.fakes import Clock, sound
from tests.drivers.twins.signals import crept_s, fresh_residuals, played, read_end_points

GRASPS = 20
"""Per rate."""
STILL_COUNTS_PER_S = 20.0
"""A hand is still when its electrodes move no faster, in the mean. A held touch of a real sensor
relaxes as fast."""
STILL_S = 0.24
"""What is looked back at; the end of closing is no part of it."""
WAITED_MAX_S = 0.5
"""After the hand is as still as a held touch; 99 in 100 have their verdict within 0.42 s."""
STANDS_S = 0.03
"""A hand that opens moves nothing beyond noise for the first 20 ms; then the verdict is gone."""


@dataclass(slots=True)
class Seen:
    """What happened to one grasp."""

    truth: Timetable
    row: Judgement
    """Of the row of the table that it was made from."""
    judged: list[tuple[float, Judgement]] = field(default_factory=list)
    """Time, s, and judgement of each time that the network was asked."""


@dataclass(slots=True)
class Study:
    """All grasps of one stream."""

    grasps: list[Seen]
    too_early: int = 0
    """Verdicts other than unknown before the hand has closed, or after it has opened."""
    outlived_s: float = 0.0
    """Longest time, s, for which a verdict still stood when the hand had begun to open."""


@pytest.fixture(scope="module", params=[True, False], ids=["71.43 Hz held", "100 Hz fresh"])
def found(bts3_dir: Path, untouched: NDArray[np.uint16], request: pytest.FixtureRequest) -> Study:
    """Grasps as a palm's recording has them, or as an SPI bridge reads them, and what is judged."""
    table = [
        point
        for name in ("palm_down", "palm_side")
        for point in read_end_points(bts3_dir / f"{name}.csv")
    ]
    rest = rest_above(np.array([point.counts for point in table]))
    chosen = np.random.default_rng(0).permutation(len(table))[:GRASPS]
    points = [table[index] for index in chosen]
    stream = WholeGrasps(rest, points, held=request.param, noise=played(fresh_residuals(untouched)))

    model, clock = TactileModel(zoo.find("cnn1")), Clock(0)

    def judge(hand: HandLimits | None) -> Pipeline:
        fingers = model.contract.fingers
        return Pipeline(model, fingers, Limits(), clock, hand=hand, learns=False)

    rows = [judge(None).judge(sound(point.counts)) for point in points]
    grasps = [Seen(*each) for each in zip(stream.timetables(), rows, strict=True)]
    study, pipeline = Study(grasps), judge(HandLimits(joints=True))
    for moment in stream:
        clock.now_ns = round(moment.t_s * 1e9)
        joints = JointReading(clock(), 0, moment.joint_names, moment.position_rad)
        pipeline.observe_joints(joints)
        judgement = pipeline.judge(sound(moment.counts, clock()))
        truth = grasps[max(moment.grasp - 1, 0)].truth  # grasp 0: the rest before the first
        if judgement.decision is not Decision.UNKNOWN:
            is_held = truth.closed_s <= moment.t_s < truth.open_s
            study.too_early += not is_held
            if is_held:
                study.outlived_s = max(study.outlived_s, moment.t_s - truth.release_s)
        if judgement.moment.judged:
            grasps[moment.grasp - 1].judged.append((moment.t_s, judgement))
    return study


def test_every_grasp_is_judged_exactly_once_before_its_lift(found: Study) -> None:
    assert len(found.grasps) == GRASPS
    for seen in found.grasps:
        assert [t_s < seen.truth.lift_s for t_s, _ in seen.judged].count(True) == 1


def test_the_verdict_comes_after_everything_is_still(found: Study) -> None:
    for seen in found.grasps:
        t_s = seen.judged[0][0]
        assert seen.truth.closed_s + STILL_S <= t_s < seen.truth.lift_s
        assert t_s - crept_s(seen.truth, STILL_COUNTS_PER_S) < WAITED_MAX_S


def test_nothing_is_judged_before_closing_or_while_opening(found: Study) -> None:
    assert not found.too_early
    assert found.outlived_s <= STANDS_S


def test_a_clear_row_keeps_its_verdict(found: Study) -> None:
    others = [seen for seen in found.grasps if seen.judged[0][1].decision is not seen.row.decision]
    unlike = [seen for seen in others if seen.judged[0][1].decision is Decision.UNKNOWN]
    # A row at the edge of what was ever seen may fall over it, to the safe side.
    assert len(unlike) <= 1
    for seen in others:
        if seen in unlike:
            assert seen.judged[0][1].reasons == (Reason.NEVER_SEEN,)
        else:
            assert seen.row.p_slip is not None
            # What noise and creep may move a probability by: 0.083 in one of a hundred readings.
            assert abs(seen.row.p_slip - 0.5) < 0.1
