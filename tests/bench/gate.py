"""Whole grasps made from real end points, through the judge behind its gate: when, and how right.

`python -m tests.bench.gate DIR --grasps 500` prints a few lines per rate, and what is made of
generated slides; DIR is the folder that holds `bts3/` and `untouched/`.
"""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from daemon.judge.decision import Limits
from daemon.judge.gate import Gate
from daemon.judge.limits import GateLimits, GripLimits, JointLimits
from daemon.judge.median import FreshMedian
from daemon.judge.pipeline import Judgement, Pipeline
from daemon.judge.reasons import Decision, Reason
from drivers.base import ELECTRODES, JointReading, TactileReading
from drivers.twins.grasps.grasp_script import EndPoint, Phase, Timetable
from drivers.twins.grasps.grasps import recorded_counts
from drivers.twins.grasps.slides import SECONDS, held
from drivers.twins.grasps.whole_grasps import (
    Moment,
    Sampling,
    WholeGrasps,
    read_end_points,
    rest_above,
)
from models import zoo
from models.runtime import TactileModel
from tests.drivers.twins.signals import crept_s, fresh_residuals, played

TABLES = ("palm_down", "palm_side")
MAX_AGE_NS = 100_000_000
RATE_LIMIT = 120.0
"""Counts/s below which a finger is still, as `GateLimits` has it."""
QUIET_PHASES = (Phase.REST, Phase.APPROACH, Phase.TOUCH, Phase.CLOSE)
"""No verdict may come in these."""


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
    def waited_s(self) -> float:
        """From the moment when everything is still to the first verdict, s."""
        return self.judged[0][0] - crept_s(self.truth, RATE_LIMIT)


@dataclass(slots=True)
class Study:
    """All grasps of one stream."""

    grasps: list[Seen]
    too_early: Counter[str] = field(default_factory=Counter)
    """Verdicts other than unknown, by phase, in phases in which there may be none."""
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
    stream: WholeGrasps, points: Sequence[EndPoint], model: TactileModel, sweeps: int = 3
) -> Study:
    """Judge a stream of these end points."""
    judge = Judge(model, sweeps)
    grasps = [
        Seen(truth, *judge.row(point.counts))
        for truth, point in zip(stream.timetables(), points, strict=True)
    ]
    result = Study(grasps)
    for moment, judgement in judge.stream(stream):
        if judgement.decision is not Decision.UNKNOWN and moment.phase in QUIET_PHASES:
            result.too_early[moment.phase] += 1
        if judgement.decision is not Decision.UNKNOWN and moment.phase is Phase.RELEASE:
            release_s = grasps[moment.grasp - 1].truth.release_s
            result.outlived_s = max(result.outlived_s, moment.t_s - release_s)
        if judgement.judged:
            grasps[moment.grasp - 1].judged.append((moment.t_s, judgement))
    return result


class Judge:
    """The judge behind its gate, on a clock that follows the stream."""

    def __init__(self, model: TactileModel, sweeps: int) -> None:
        self._model = model
        self._now_ns = 0
        self._grip = GripLimits(sweeps=sweeps, joints=JointLimits())

    def row(self, counts: NDArray[np.uint16]) -> tuple[Decision, float | None]:
        """Verdict on a row of a table, which is a grasp of its own."""
        judgement = self._pipeline(None).judge(_tactile(self._now_ns, 0, counts))
        return judgement.decision, judgement.p_slip

    def stream(self, stream: WholeGrasps) -> Iterator[tuple[Moment, Judgement]]:
        """Every row of the stream and what is said of it."""
        pipeline = self._pipeline(self._grip)
        for index, moment in enumerate(stream):
            self._now_ns = round(moment.t_s * 1e9)
            names, angles = moment.joint_names, moment.position_rad
            pipeline.observe_joints(JointReading(self._now_ns, index, names, angles))
            yield moment, pipeline.judge(_tactile(self._now_ns, index, moment.counts))

    def _pipeline(self, grip: GripLimits | None) -> Pipeline:
        fingers = self._model.contract.fingers
        limits = Limits(max_age_ns=MAX_AGE_NS)
        return Pipeline(self._model, fingers, limits, lambda: self._now_ns, grip=grip, learns=False)


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


def lines(name: str, found: Study) -> Iterator[str]:
    """What was found, for people."""
    grasps = found.grasps
    judged = [seen for seen in grasps if seen.before_lift]
    once = sum(len(seen.before_lift) == 1 for seen in grasps)
    waited_ms = 1e3 * np.array([seen.waited_s for seen in judged])
    spare_ms = 1e3 * np.array([seen.truth.lift_s - seen.judged[0][0] for seen in judged])
    same = sum(seen.judged[0][1].decision is seen.row for seen in judged)
    yield f"{name}: {len(grasps)} grasps, {len(judged)} judged before the lift, {once} of them once"
    yield (
        f"  from still to verdict: p50 {np.quantile(waited_ms, 0.5):.0f}, "
        f"p99 {np.quantile(waited_ms, 0.99):.0f}, max {waited_ms.max():.0f} ms; "
        f"{spare_ms.min():.0f} ms or more before the lift"
    )
    early = ", ".join(f"{number} in {phase}" for phase, number in found.too_early.items())
    yield (
        f"  verdict as on the table's row: {same} of {len(judged)}; verdicts too early: "
        f"{early or 'none'}; gone {1e3 * found.outlived_s:.0f} ms after the hand begins to open"
    )
    for seen in judged:
        _, first = seen.judged[0]
        if first.decision is not seen.row:
            yield (
                f"    grasp {seen.truth.grasp}: row {seen.row} {_shown(seen.row_p_slip)}, stream "
                f"{first.decision} {_shown(first.p_slip)} {' '.join(first.reasons)}"
            )


def _shown(p_slip: float | None) -> str:
    return "" if p_slip is None else f"(p_slip {p_slip:.3f})"


@dataclass(slots=True)
class Sliding:
    """What the gate said of streams in which an object slides, or is held."""

    sweeps: int = 0
    still: int = 0
    streams: int = 0
    settled: int = 0
    """Streams that settled at all."""
    times: int = 0
    """How often they did."""


def sliding(slides: Sequence[bool], number: int, sampling: Sampling) -> Sliding:
    """So many streams of fingers that all touch; `slides` says which of them slide."""
    found = Sliding()
    everywhere = np.ones((len(slides), ELECTRODES), dtype=np.bool_)
    for seed in range(number):
        gate = Gate(everywhere[:, 0], GateLimits())
        fresh, settled = FreshMedian(everywhere.shape), 0
        for t_s, counts in held(slides, sampling=sampling, seed=seed):
            t_ns = round(t_s * 1e9)
            fresh.push(counts, everywhere)
            gate.step(t_ns, counts, fresh.counts, everywhere, everywhere[:, 0])
            if Reason.SEQUENCE_GAP not in gate.reasons:
                found.sweeps += 1
                found.still += Reason.MOVING not in gate.reasons
            if gate.wants_judgement:
                settled += 1
                gate.judged(t_ns, fresh.counts)
        found.streams += 1
        found.settled += settled > 0
        found.times += settled
    return found


def sliding_lines(number: int, fingers: int = 3) -> Iterator[str]:
    """The same for people: held, one finger sliding alone, and all of a hand at once."""
    kinds = {
        f"{fingers} fingers held": [False] * fingers,
        "one finger, sliding": [True],
        f"{fingers} fingers, one sliding": [True, *[False] * (fingers - 1)],
        f"{fingers} fingers, all sliding": [True] * fingers,
    }
    for name, slides in kinds.items():
        for sampling, rate in ((Sampling.HELD, "71.43 Hz held"), (Sampling.FRESH, "100 Hz fresh")):
            found = sliding(slides, number, sampling)
            yield (
                f"{rate}, {name}: {found.still / found.sweeps:.0%} of the sweeps called still, "
                f"{found.settled} of {found.streams} settle, "
                f"{found.times / found.streams:.1f} times in {SECONDS:g} s"
            )


def main() -> None:
    """Print the study."""
    parser = argparse.ArgumentParser(prog="python -m tests.bench.gate", description=__doc__)
    parser.add_argument("data", type=Path, metavar="DIR")
    parser.add_argument("--grasps", type=int, default=500)
    parser.add_argument("--slides", type=int, default=100)
    parser.add_argument("--model", default="cnn1")
    parser.add_argument("--sweeps", type=int, choices=(1, 3), default=3)
    options = parser.parse_args()
    points, rest = end_points(options.data / "bts3", options.grasps)
    model = TactileModel(zoo.find(options.model))
    for name, stream in streams(options.data, points, rest).items():
        print("\n".join(lines(name, study(stream, points, model, options.sweeps))))  # noqa: T201
    print("\n".join(sliding_lines(options.slides)))  # noqa: T201


if __name__ == "__main__":
    main()
