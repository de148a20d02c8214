"""Whole grasps from real end points with the real sensors' noise: judged once, before the lift."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from graspd.daemon.judge.decision import HandLimits, Limits
from graspd.daemon.judge.pipeline import Pipeline
from graspd.daemon.judge.reasons import Decision
from graspd.drivers.base import JointReading
from graspd.drivers.twins.grasps.whole_grasps import WholeGrasps, rest_above
from graspd.models import zoo
from graspd.models.runtime import TactileModel
from tests.daemon.fakes import FINGERS, Clock, sound
from tests.drivers.twins.signals import crept_s, fresh_residuals, played, read_end_points

GRASPS = 20
"""Number of grasps at each rate."""
STILL_COUNTS_PER_S = 20.0
"""A hand is still when its electrodes move no faster, in the mean. A held touch of a real sensor
relaxes as fast."""
STILL_S = 0.24
"""Duration of stillness before a verdict, s; the end of closing is not a part of it."""
WAITED_MAX_S = 0.5
"""Longest wait for a verdict once the hand is as still as a held touch, s; 99 in 100 get it within
0.42 s."""
STANDS_S = 0.03
"""Longest time for which a verdict lasts while the hand opens, s: 20 ms of it look like noise."""


@pytest.mark.parametrize("held", [True, False], ids=["71.43 Hz held", "100 Hz fresh"])
def test_each_still_grasp_is_judged_exactly_once_before_its_lift(
    bts3_dir: Path, untouched: NDArray[np.uint16], held: bool
) -> None:
    """`held`: values are repeated as in a palm's recording; else all are fresh, as from SPI."""
    table = [
        point
        for name in ("palm_down", "palm_side")
        for point in read_end_points(bts3_dir / f"{name}.csv")
    ]
    rest = rest_above(np.array([point.counts for point in table]))
    chosen = np.random.default_rng(0).permutation(len(table))[:GRASPS]
    points = [table[index] for index in chosen]
    stream = WholeGrasps(rest, points, held=held, noise=played(fresh_residuals(untouched)))
    model, clock, hand = TactileModel(zoo.find("cnn1")), Clock(0), HandLimits(joints=True)
    pipeline = Pipeline(model, FINGERS, Limits(), clock, hand=hand, learns=False)
    timetables = list(stream.timetables())
    judged_s: list[list[float]] = [[] for _ in timetables]
    for moment in stream:
        clock.now_ns = round(moment.t_s * 1e9)
        joints = JointReading(clock(), 0, moment.joint_names, moment.position_rad)
        pipeline.observe_joints(joints)
        judgement = pipeline.judge(sound(moment.counts, clock()))
        truth = timetables[max(moment.grasp - 1, 0)]  # grasp 0: the rest before the first
        if judgement.decision is not Decision.UNKNOWN:
            assert truth.closed_s <= moment.t_s < truth.open_s
            assert moment.t_s - truth.release_s <= STANDS_S
        if judgement.moment.judged:
            judged_s[moment.grasp - 1].append(moment.t_s)
    for truth, (first_s, *others_s) in zip(timetables, judged_s, strict=True):
        assert truth.closed_s + STILL_S <= first_s < truth.lift_s
        assert first_s - crept_s(truth, STILL_COUNTS_PER_S) < WAITED_MAX_S
        assert not any(t_s < truth.lift_s for t_s in others_s)
