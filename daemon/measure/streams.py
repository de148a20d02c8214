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
from daemon.trust.trust import Permission, RiskLimits, Trust
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

    margins: NDArray[np.float64]
    """Log-odds of slip (N,) of graspd's network."""
    features: NDArray[np.float32]
    """Inputs of that network, shape (N, 78)."""
    published: NDArray[np.float64]
    """Log-odds of slip (N,) of the published network."""
    slipped: NDArray[np.bool_]


def streams(
    grasps: Grasps, seeds: int, folds: int = DAYS_FOLDS, epochs: int | None = None
) -> Iterator[Stream]:
    """Train the networks of each day and fold; yield the streams of the three tables.

    Objects are split `seeds` times; `folds` of each are judged. `epochs` None: the systems' own.
    """
    systems = [SYSTEMS[name] for name in (OWN, PUBLISHED)]
    if epochs is not None:
        systems = [with_recipes(system, epochs=epochs) for system in systems]
    names = np.array([file.name for file in grasps.files])[grasps.table_of]
    for seed, fold in itertools.product(range(seeds), range(folds)):
        fold_of = object_folds(grasps.objects, DAYS_FOLDS, seed)
        for protocol, training, tables in DAYS:
            progress(f"seed {seed + 1} of {seeds}, fold {fold + 1} of {folds}, {protocol}")
            others = grasps.rows(np.flatnonzero(np.isin(names, training) & (fold_of != fold)))
            random = np.random.default_rng([seed, fold])
            rows = []
            for table, _ in itertools.product(tables, range(DRAWS)):
                inside = np.flatnonzero((names == table) & (fold_of == fold))
                rows.append(random.permutation(inside))
            counts = [grasps.counts[chosen] for chosen in rows]
            own, published = (
                judged(system, others, counts, fold_seed(seed, fold)) for system in systems
            )
            for chosen, (margins, features), (theirs, _) in zip(rows, own, published, strict=True):
                yield Stream(margins, features, theirs, grasps.slipped[chosen])


def judged(
    system: System, training: Grasps, several: Sequence[NDArray[np.uint16]], seed: int
) -> list[tuple[NDArray[np.float64], NDArray[np.float32]]]:
    """Train a system; return its margins (N,) and inputs (N, ...) for streams of counts (N, 3, 24).
    Inputs are empty for a system without a session."""
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


def stable_of(stream: Stream, limits: RiskLimits) -> NDArray[np.bool_]:
    """Judge, lift and tell one grasp after the other; return which were said to be stable (N,)."""
    trust = Trust("worth", stream.features.shape[1], limits)
    verdicts = []
    for index, margin in enumerate(stream.margins.tolist()):
        grasp = GraspId("worth", index)
        assessed = trust.judge(grasp, sigmoid(margin), margin, stream.features[index])
        p_slip = sigmoid(margin) if assessed.p_slip is None else assessed.p_slip
        stable = assessed.permission is Permission.ALLOWED and p_slip < 0.5
        trust.note(grasp, assessed, stable=stable)
        trust.outcome(grasp, slipped=bool(stream.slipped[index]))
        verdicts.append(stable)
    return np.array(verdicts, np.bool_)
