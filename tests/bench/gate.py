"""Whole grasps made from real end points, through the judge behind its gate."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from graspd.daemon.judge.decision import GateLimits, HandLimits, JointLimits, Limits
from graspd.daemon.judge.pipeline import Judgement, Pipeline
from graspd.daemon.judge.reasons import Decision
from graspd.drivers.base import JointReading, TactileReading
from graspd.drivers.twins.grasps.grasp_script import EndPoint, Timetable
from graspd.drivers.twins.grasps.grasps import recorded_counts
from graspd.drivers.twins.grasps.whole_grasps import (
    GraspRow,
    Sampling,
    WholeGrasps,
    rest_above,
)
from graspd.models.runtime import TactileModel
from tests.drivers.twins.signals import crept_s, fresh_residuals, played, read_end_points

TABLES = ("palm_down", "palm_side")
MAX_AGE_NS = 100_000_000
STILL_COUNTS_PER_S = 20.0
"""A hand is still when its electrodes move no faster, in the mean: so does a held touch of a real
sensor, which relaxes."""


@dataclass(slots=True)
class Seen:
    """What happened to one grasp."""

    truth: Timetable
    row: Decision
    """Verdict on the row of the table that it was made from."""
    row_p_slip: float | None
    judged: list[tuple[float, Judgement]] = field(default_factory=list)
    """Time, s, and judgement of each time that the network was asked."""

    @property
    def before_lift(self) -> list[tuple[float, Judgement]]:
        return [(t_s, judgement) for t_s, judgement in self.judged if t_s < self.truth.lift_s]

    @property
    def still_s(self) -> float:
        """When everything is still."""
        return crept_s(self.truth, STILL_COUNTS_PER_S)


@dataclass(slots=True)
class Study:
    """All grasps of one stream."""

    grasps: list[Seen]
    too_early: int = 0
    """Verdicts other than unknown before the hand has closed, or after it has opened."""
    outlived_s: float = 0.0
    """Longest time, s, for which a verdict still stood when the hand had begun to open."""


def end_points(
    folder: Path, number: int, seed: int = 0
) -> tuple[list[EndPoint], NDArray[np.float64]]:
    """Rows of the tables, drawn without putting back, and where their fingers rest."""
    table = [point for name in TABLES for point in read_end_points(folder / f"{name}.csv")]
    rest = rest_above(np.array([point.counts for point in table]))
    chosen = np.random.default_rng(seed).permutation(len(table))[:number]
    return [table[index] for index in chosen], rest


def residuals(folder: Path) -> NDArray[np.float64]:
    """Noise of the real untouched sensors."""
    held = np.array(list(recorded_counts(folder / "untouched.csv")))
    return fresh_residuals(held)


def study(
    stream: WholeGrasps,
    points: Sequence[EndPoint],
    model: TactileModel,
    sweeps: int = 3,
    *,
    early: bool = False,
) -> Study:
    """Judge a stream of these end points."""
    judge = Judge(model, sweeps, early=early)
    grasps = [
        Seen(truth, *judge.row(point.counts))
        for truth, point in zip(stream.timetables(), points, strict=True)
    ]
    result = Study(grasps)
    for moment, judgement in judge.stream(stream):
        truth = grasps[max(moment.grasp - 1, 0)].truth  # grasp 0: the rest before the first
        if judgement.decision is not Decision.UNKNOWN:
            is_held = truth.closed_s <= moment.t_s < truth.open_s
            result.too_early += not is_held
            if is_held:
                result.outlived_s = max(result.outlived_s, moment.t_s - truth.release_s)
        if judgement.moment.judged:
            grasps[moment.grasp - 1].judged.append((moment.t_s, judgement))
    return result


class Judge:
    """The judge behind its gate, on a clock that follows the stream."""

    def __init__(self, model: TactileModel, sweeps: int, *, early: bool) -> None:
        self._model = model
        self._now_ns = 0
        gate = GateLimits(early=early)
        self._grip = HandLimits(sweeps=sweeps, joints=JointLimits(), gate=gate)

    def row(self, counts: NDArray[np.uint16]) -> tuple[Decision, float | None]:
        """Verdict on a row of a table, which is a grasp of its own."""
        judgement = self._pipeline(None).judge(_tactile(self._now_ns, 0, counts))
        return judgement.decision, judgement.p_slip

    def stream(self, stream: WholeGrasps) -> Iterator[tuple[GraspRow, Judgement]]:
        """Every row of the stream and what is said of it."""
        pipeline = self._pipeline(self._grip)
        for index, moment in enumerate(stream):
            self._now_ns = round(moment.t_s * 1e9)
            names, angles = moment.joint_names, moment.position_rad
            pipeline.observe_joints(JointReading(self._now_ns, index, names, angles))
            yield moment, pipeline.judge(_tactile(self._now_ns, index, moment.counts))

    def _pipeline(self, hand: HandLimits | None) -> Pipeline:
        fingers = self._model.contract.fingers
        limits = Limits(max_age_ns=MAX_AGE_NS)
        return Pipeline(self._model, fingers, limits, lambda: self._now_ns, hand=hand, learns=False)


def _tactile(t_ns: int, seq: int, counts: NDArray[np.uint16]) -> TactileReading:
    return TactileReading(t_ns, seq, counts, np.zeros(counts.shape, dtype=np.uint8))


def streams(
    data: Path, points: Sequence[EndPoint], rest: NDArray[np.float64], seed: int = 0
) -> dict[str, WholeGrasps]:
    """The same grasps as a palm's recording has them, and as an SPI bridge reads them."""
    noise = residuals(data / "untouched")
    return {
        "71.43 Hz held": WholeGrasps(
            rest, points, sampling=Sampling.HELD, noise=played(noise), seed=seed
        ),
        "100 Hz fresh": WholeGrasps(rest, points, noise=played(noise), seed=seed),
    }
