"""Streams of grasps of another day, and what graspd says of them as outcomes are told.

Networks saw neither the objects nor the pose of a stream. The days are those of the protocol
`days`. Session statistics start empty, as in the daemon. No grasp is refused.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from daemon.process.text import progress
from daemon.trust.learner import sigmoid
from daemon.trust.lift_book import GraspId
from daemon.trust.risk import Permission, RiskLimits
from daemon.trust.trust import Trust
from models.inputs import SessionBuilder, builder, raw_features
from models.training.data.datasets import Grasps
from models.training.data.protocols import DAYS, DAYS_FOLDS, fold_seed, object_folds
from models.training.fitting.trained import train
from models.training.systems.registry import SYSTEMS
from models.training.systems.system import SessionFeatures, System, with_recipes

OWN, PUBLISHED = "small-session", "cnn1"
"""Systems that judge: graspd's default, and the published network on the plain image."""
DRAWS: Final = 2
"""Streams of each table and fold, in random order."""


@dataclass(frozen=True, slots=True, eq=False)
class Stream:
    """The grasps of one table and fold in random order."""

    protocol: str
    table: str
    margins: NDArray[np.float64]
    """Log-odds of slip (N,) of graspd's network."""
    features: NDArray[np.float32]
    """Inputs of that network, shape (N, 78)."""
    published: NDArray[np.float64]
    """Log-odds of slip (N,) of the published network."""
    slipped: NDArray[np.bool_]

    def rows(self) -> Iterator[tuple[float, NDArray[np.float32], bool]]:
        """Margin, features and outcome of each grasp."""
        yield from zip(self.margins.tolist(), self.features, self.slipped.tolist(), strict=True)


@dataclass(frozen=True, slots=True)
class Plan:
    """How much is trained."""

    seeds: int
    """Splits of the objects, and trainings of each fold."""
    folds: int = DAYS_FOLDS
    """Folds of each split that are judged."""
    epochs: int | None = None
    """None: as many as the systems have themselves."""


@dataclass(frozen=True, slots=True, eq=False)
class Life:
    """What was said of a stream's grasps (N,), each after the outcomes of those before it."""

    p_slip: NDArray[np.float64]
    stable: NDArray[np.bool_]
    within: bool
    """True if slips among stable lifts never exceeded the bound."""


def streams(grasps: Grasps, plan: Plan) -> Iterator[Stream]:
    """Train the networks of each day and fold; yield the streams of the three tables."""
    names = np.array([file.name for file in grasps.files])[grasps.table_of]
    for seed, fold in itertools.product(range(plan.seeds), range(plan.folds)):
        fold_of = object_folds(grasps.objects, DAYS_FOLDS, seed)
        for protocol, training, tables in DAYS:
            progress(
                f"seed {seed + 1} of {plan.seeds}, fold {fold + 1} of {plan.folds}, {protocol}"
            )
            others = grasps.rows(np.flatnonzero(np.isin(names, training) & (fold_of != fold)))
            random = np.random.default_rng([seed, fold])
            kinds, rows = [], []
            for table, _ in itertools.product(tables, range(DRAWS)):
                inside = np.flatnonzero((names == table) & (fold_of == fold))
                kinds.append(table)
                rows.append(random.permutation(inside))
            counts = [grasps.counts[chosen] for chosen in rows]
            own, published = (
                judged(_system(name, plan), others, counts, fold_seed(seed, fold))
                for name in (OWN, PUBLISHED)
            )
            for table, chosen, (margins, features), (theirs, _) in zip(
                kinds, rows, own, published, strict=True
            ):
                slipped = grasps.slipped[chosen]
                yield Stream(protocol, table, margins, features, theirs, slipped)


def _system(name: str, plan: Plan) -> System:
    system = SYSTEMS[name]
    return system if plan.epochs is None else with_recipes(system, epochs=plan.epochs)


def judged(
    system: System, training: Grasps, several: Sequence[NDArray[np.uint16]], seed: int
) -> list[tuple[NDArray[np.float64], NDArray[np.float32]]]:
    """Train a system; return its margins (N,) and inputs (N, ...) for streams of counts.

    Counts have the shape (N, 3, 24). Inputs are empty for a system without a session.
    """
    trained, takes = train(system, training, seed), system.input
    answers = []
    for counts in several:
        if trained.standards is not None and isinstance(takes, SessionFeatures):
            session = trained.standards.statistics()
            builds = SessionBuilder(counts.shape[1], takes.clip)
            inputs = np.empty((len(counts), *builds.shape), np.float32)
            for row, reading in zip(inputs, counts, strict=True):
                builds.use(session.mean, session.spread)
                builds.build(reading, row)
                session.observe(raw_features(reading))
            answers.append((trained.fitted.margins(inputs), inputs))
        elif not isinstance(takes, SessionFeatures):
            images, _ = builder(takes, counts.shape[1]).build_batch(counts)
            answers.append((trained.fitted.margins(images), np.empty((len(counts), 0), np.float32)))
    return answers


def live(stream: Stream, limits: RiskLimits, *, every: bool) -> Life:
    """Judge, lift and tell one grasp after the other.

    Without `every`, only stable and supervised grasps are lifted and their outcomes told.
    """
    trust, count = Trust("worth", stream.features.shape[1], limits), len(stream.slipped)
    p_slip, stable, within = np.empty(count), np.zeros(count, np.bool_), True
    for index, (margin, row, slipped) in enumerate(stream.rows()):
        grasp = GraspId(stream.table, index)
        assessed = trust.judge(grasp, sigmoid(margin), margin, row)
        p_slip[index] = sigmoid(margin) if assessed.p_slip is None else assessed.p_slip
        stable[index] = assessed.permission is Permission.ALLOWED and p_slip[index] < 0.5
        trust.note(grasp, assessed, stable=bool(stable[index]))
        if every or stable[index] or assessed.supervised:
            trust.outcome(grasp, slipped=slipped)
        within &= trust.risk.bound is None or trust.risk.slips <= trust.risk.bound + 1e-9
    return Life(p_slip, stable, within)
