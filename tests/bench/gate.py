"""Whole grasps made from real end points, through the judge behind its gate; holds and slides.

`python -m tests.bench.gate [EPISODES [SHARE ...]]` tells how often a hand that holds is said to
hold, how often one along which the object slides, and how soon a slide that begins is told, for
each share of `false_alarms`; then the same of each finger's word, with slides at median speed.
"""

from __future__ import annotations

import itertools
import math
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from graspd.daemon.judge.decision import GateLimits, HandLimits, JointLimits, Limits
from graspd.daemon.judge.hand import HandTracker
from graspd.daemon.judge.health import Checked
from graspd.daemon.judge.pipeline import Judgement, Pipeline
from graspd.daemon.judge.reasons import Decision, FingerState, GateState, Moment
from graspd.drivers.base import ELECTRODES, JointReading, TactileReading
from graspd.drivers.twins.grasps.grasp_script import EndPoint, Timetable
from graspd.drivers.twins.grasps.whole_grasps import (
    GraspRow,
    Sampler,
    WholeGrasps,
    rest_above,
)
from graspd.models.contract import Finger
from graspd.models.runtime import TactileModel
from tests.drivers.twins.signals import (
    crept_s,
    fresh_residuals,
    played,
    read_end_points,
    untouched_counts,
)
from tests.drivers.twins.slides import SLIDE_SPREAD, HeldNoise, Hold

TABLES = ("palm_down", "palm_side")
MAX_AGE_NS = 100_000_000
STILL_COUNTS_PER_S = 20.0
"""A hand is still when its electrodes move no faster, in the mean: so does a held touch of a real
sensor, which relaxes."""
FINGERS: tuple[Finger, ...] = ("ff", "mf", "th")
REST_S, CLOSES_S, HOLDS_S = 1.5, 0.25, 3.0
"""A hand of holds rests, closes and then holds for these times, s."""
SLIDE_AFTER_S = (1.0, 1.3)
"""When a slide begins that a held hand does not expect, s after the hand has closed."""
REST_COUNTS, PRESSED_COUNTS = 2500.0, 600.0
"""Where its electrodes rest, and by how much the most pressed one falls, counts."""
SHARES = (0.03, 0.01, 0.001)
"""Of `false_alarms`, as in the table of real holds."""


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


@dataclass(frozen=True, slots=True)
class Held:
    """What the gate said of one hand that holds, or along which the object slides."""

    stands: NDArray[np.bool_]
    """Of each reading since the hand has closed: did a verdict stand?"""
    settles: int
    """How often the grasp settled."""
    slides_at: int
    """The reading at which the object begins to slide."""

    @property
    def comes(self) -> int:
        """How often the verdict began to stand."""
        return int(self.stands[0]) + int((self.stands[1:] & ~self.stands[:-1]).sum())

    @property
    def since(self) -> NDArray[np.bool_]:
        """The readings since the verdict stood first."""
        return self.stands[int(self.stands.argmax()) :] if self.stands.any() else self.stands[:0]

    @property
    def revoked_ms(self) -> float | None:
        """How long the verdict stood after the slide began, ms; None: it did not stand then."""
        if not self.stands[self.slides_at - 1]:
            return None
        stands = self.stands[self.slides_at :]
        return 10.0 * (len(stands) if stands.all() else int(stands.argmin()))


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
    return fresh_residuals(untouched_counts(folder / "untouched.csv"))


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
        "71.43 Hz held": WholeGrasps(rest, points, held=True, noise=played(noise), seed=seed),
        "100 Hz fresh": WholeGrasps(rest, points, noise=played(noise), seed=seed),
    }


class Closing:
    """A hand that closes at `REST_S`, and then holds as `hold` does."""

    def __init__(self, hold: Hold, rng: np.random.Generator) -> None:
        self._hold = hold
        self._pressed = rng.uniform(0.0, PRESSED_COUNTS, (len(FINGERS), ELECTRODES))

    def deviation(self, t_s: NDArray[np.float64]) -> NDArray[np.float64]:
        """Counts less the rest, shape (fingers, 24)."""
        share = np.clip((t_s - REST_S) / CLOSES_S, 0.0, 1.0)
        ramp = share**3 * (10.0 + share * (6.0 * share - 15.0))  # minimum jerk
        return self._hold.deviation(t_s) - ramp * self._pressed


def moments(
    false_alarms: float,
    seed: int,
    sliding: Sequence[bool],
    *,
    begins: bool = False,
    slide_spread: float = SLIDE_SPREAD,
    late: bool = False,
) -> tuple[list[Moment], int]:
    """Return the moments since a hand has closed, and which one is the first with a slide.

    The object slides along the fingers that are `sliding`, from the start or from when it `begins`.
    """
    rng = np.random.default_rng([seed, 4])
    closed_s = REST_S + CLOSES_S
    slide_s = closed_s + rng.uniform(*SLIDE_AFTER_S)
    begins_s = slide_s if begins else None
    hold = Hold(sliding, rng, closed_s + HOLDS_S, closed_s, begins_s, slide_spread)
    rest = np.full((len(FINGERS), ELECTRODES), REST_COUNTS)
    sampler = Sampler(rest, HeldNoise(len(FINGERS), rng).sweep, held=late)
    course = Closing(hold, rng)
    hand = HandTracker(FINGERS, HandLimits(gate=GateLimits(false_alarms=false_alarms)))
    felt = []
    for row in range(round(100 * (closed_s + HOLDS_S))):
        counts = sampler.sample(course.deviation, row / 100.0)
        moment, _ = hand.step(row * 10_000_000, counts, Checked((), None))
        felt.append(moment)
    first = round(100 * closed_s)
    return felt[first:], round(100 * slide_s) - first


def follow(
    false_alarms: float,
    seed: int,
    *,
    slides: bool = False,
    begins: bool = False,
    late: bool = False,
) -> Held:
    """Say what the gate makes of a hand that holds; of one of which three fingers slide from the
    start, or of one along which the object `begins` to slide."""
    sliding = [slides or begins] * len(FINGERS)
    felt, slides_at = moments(false_alarms, seed, sliding, begins=begins, late=late)
    changes = [[change.state for change in moment.changes] for moment in felt]
    settles = sum(GateState.SETTLED in states for states in changes)
    return Held(np.array([moment.settled for moment in felt]), settles, slides_at)


def tell(episodes: int, false_alarms: float, late: bool) -> str:
    """One row of the table."""
    seeds = range(episodes)
    return row(
        false_alarms,
        [follow(false_alarms, seed, late=late) for seed in seeds],
        [follow(false_alarms, seed, slides=True, late=late) for seed in seeds],
        [follow(false_alarms, seed, begins=True, late=late) for seed in seeds],
    )


def row(false_alarms: float, holds: list[Held], slides: list[Held], begun: list[Held]) -> str:
    """The cells of hands that hold, of slides, and of slides that begin."""
    since = np.concatenate([hold.since for hold in holds])
    revoked = [each.revoked_ms for each in begun if each.revoked_ms is not None]
    waits = 10 * np.array([hold.stands.argmax() for hold in holds if hold.stands.any()])
    cells = (
        f"{false_alarms:g}",
        f"{100 * np.mean([hold.stands.mean() for hold in holds]):.1f} %",
        f"{100 * since.mean():.1f} %",
        f"{np.mean([hold.settles for hold in holds]):.2f}",
        f"{np.mean([hold.comes for hold in holds]):.2f}",
        f"{np.median(waits):.0f} / {np.quantile(waits, 0.99):.0f} ms",
        f"{100 * np.mean([slide.stands.mean() for slide in slides]):.1f} %",
        f"{100 * np.mean([slide.stands.any() for slide in slides]):.0f} %",
        f"{np.median(revoked):.0f} / {np.quantile(revoked, 0.9):.0f} ms",
    )
    return " | ".join(cells)


def tell_words(episodes: int, false_alarms: float, late: bool) -> str:
    """Return a row of the table of the fingers' words."""

    def feel(sliding: Sequence[bool]) -> Iterator[tuple[list[Moment], int]]:
        for seed in range(episodes):
            yield moments(
                *(false_alarms, seed, sliding),
                begins=True,
                slide_spread=0.0,
                late=late,
            )

    held = [slides(felt, settled_at(felt)) for felt, _ in feel([False] * len(FINGERS))]
    changes = np.mean([np.abs(np.diff(each, axis=0)).sum(axis=0) for each in held])
    three = [late_ms(slides(felt, at).max(axis=1)) for felt, at in feel([True] * len(FINGERS))]
    one = [late_ms(slides(felt, at)[:, 0]) for felt, at in feel([True, False, False])]
    cells = (
        f"{false_alarms:g}",
        f"{100 * np.concatenate(held).mean():.2f} %",
        f"{changes:.2f}",
        f"{np.median(three):.0f} / {np.quantile(three, 0.9):.0f} ms",
        f"{np.median(one):.0f} / {np.quantile(one, 0.9):.0f} ms",
    )
    return " | ".join(cells)


def settled_at(felt: Sequence[Moment]) -> int:
    """Return the first moment at which a verdict stood; where none did, the last."""
    return next((at for at, moment in enumerate(felt) if moment.settled), len(felt) - 1)


def slides(felt: Sequence[Moment], begin: int) -> NDArray[np.int8]:
    """Return 1 where a finger says `slide`, from a moment on; shape (moments, fingers)."""
    words = [(moment.fingers or {}).values() for moment in felt[begin:]]
    return np.array([[word is FingerState.SLIDE for word in each] for each in words], dtype=np.int8)


def late_ms(says_slide: NDArray[np.int8]) -> float:
    """Return after how long it is said first, ms; infinite where it never is."""
    return 10.0 * int(says_slide.argmax()) if says_slide.any() else math.inf


def main(arguments: Sequence[str]) -> None:
    """Print the table."""
    episodes = int(arguments[0]) if arguments else 60
    shares = [float(share) for share in arguments[1:]] or SHARES
    for head, line in (
        (
            "false_alarms | hold stands | of the time since it did | settles | verdict comes | "
            "first after, p50 / p99 | slide stands | slides that ever do | revoked, p50 / p90",
            tell,
        ),
        (
            "false_alarms | a finger that holds says `slide` | changes of its word | slide along "
            "three fingers named after, p50 / p90 | along one",
            tell_words,
        ),
    ):
        sys.stdout.write(f"{head}\n")
        for late, share in itertools.product((False, True), shares):
            sys.stdout.write(f"{'held' if late else 'fresh'} {line(episodes, share, late)}\n")
            sys.stdout.flush()


if __name__ == "__main__":
    main(sys.argv[1:])
