"""Streams of grasps of another day, and graspd's verdicts on them as outcomes are reported.

Networks saw neither the objects nor the pose of a stream. The days are those of the protocol
`days`. Each stream is a session that starts empty, as in the daemon, with the daemon's refusals.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Final

import numpy as np
import pandas as pd

from graspd.models.training.arrays import Bools, Floats, Floats32, Ints
from graspd.models.training.data.datasets import Grasps
from graspd.models.training.data.protocols import DAYS, DAYS_FOLDS, fold_seed, object_folds
from graspd.models.training.evaluating.days import Day, by_object
from graspd.models.training.fitting.trained import Trained, train
from graspd.models.training.systems.registry import SYSTEMS, with_recipes
from graspd.models.trust.assessment import assess
from graspd.models.trust.learner import SCALE, Learner, sigmoid
from graspd.models.trust.risk import Permission, Risk, RiskLimits

OWN, PUBLISHED = "small-session", "cnn1"
"""Systems that judge: graspd's default, and the published network."""
DRAWS: Final = 2
"""Number of streams for each table, fold and order."""
ORDERS: Final = ("random", "by object")


@dataclass(frozen=True, slots=True, eq=False)
class Stream:
    """The grasps of one table and of some objects, in the order of one session."""

    rows: pd.DataFrame
    """A row per grasp: `session`, number of the stream; `split` (seed) and `fold` of the objects,
    which no other fold of the split has; `day`, `table` and `order`; `grasp`, its place in the
    session; log-odds of slip of graspd's network (`margin`) and of the `published` one; `refused`,
    true if the daemon does not judge it, which the published network always does; `slipped`."""
    features: Floats32
    """Inputs of graspd's network, shape (N, 78)."""


def streams(
    grasps: Grasps,
    seeds: int,
    folds: int = DAYS_FOLDS,
    epochs: int | None = None,
    on_day: Callable[[str], None] = lambda _day: None,
) -> Iterator[Stream]:
    """Train the networks of each day and fold; yield the streams of the three tables.

    Objects are split `seeds` times; `folds` of each are judged. `epochs` None: the systems' own.
    `on_day` is called with a text after the streams of each of `DAYS`, in each fold.
    """
    systems = [SYSTEMS[name] for name in (OWN, PUBLISHED)]
    if epochs is not None:
        systems = [with_recipes(system, epochs=epochs) for system in systems]
    names = np.array([file.name for file in grasps.files])[grasps.table_of]
    sessions = itertools.count()
    for seed, fold in itertools.product(range(seeds), range(folds)):
        fold_of = object_folds(grasps.objects, DAYS_FOLDS, seed)
        for day, training, tables in DAYS:
            others = grasps.rows(np.flatnonzero(np.isin(names, training) & (fold_of != fold)))
            own, published = (train(system, others, fold_seed(seed, fold)) for system in systems)
            random = np.random.default_rng([seed, fold])
            for table, _, order in itertools.product(tables, range(DRAWS), ORDERS):
                inside = np.flatnonzero((names == table) & (fold_of == fold))
                rows = random.permutation(inside)
                if order == "by object":
                    rows = by_object(random, rows, np.array(grasps.objects)[rows])
                margins, features, refused = judged(own, grasps, rows)
                frame = pd.DataFrame(
                    {
                        "session": next(sessions),
                        "split": seed,
                        "fold": fold,
                        "day": day,
                        "table": table,
                        "order": order,
                        "grasp": np.arange(len(rows)),
                        "margin": margins,
                        "refused": refused,
                        "published": published.margins(grasps.counts[rows], grasps.table_of[rows]),
                        "slipped": grasps.slipped[rows],
                    }
                )
                yield Stream(frame, features)
            on_day(f"seed {seed + 1} of {seeds}, fold {fold + 1} of {folds}, {day}")


def judged(trained: Trained, grasps: Grasps, rows: Ints) -> tuple[Floats, Floats32, Bools]:
    """Judge rows as one session; return margins (N,), inputs (N, features) and refusals (N,)."""
    day = Day(trained)
    margins, refused = np.empty(len(rows)), np.empty(len(rows), np.bool_)
    inputs = np.empty((len(rows), *day.network.input.shape), np.float32)
    for index, counts in enumerate(grasps.counts[rows]):
        margins[index], refused[index] = day.judge(counts)
        inputs[index] = day.network.input
    return margins, inputs, refused


def live(stream: Stream, limits: RiskLimits, *, every: bool, scale: float = SCALE) -> pd.DataFrame:
    """Simulate a session: judge, lift and report each grasp in turn; refused ones are not lifted.

    `every`: False lifts, and reports, only stable and supervised grasps. `scale` replaces the
    learner's own.

    Returns the stream's rows with the verdict, after the outcomes of the grasps before: `p_slip`,
    NaN of a refused one; `stable`; `supervised`, true if a lift under supervision was asked for;
    `outcomes`, the number that it rests on.
    """
    learner, risk = Learner(stream.features.shape[1]), Risk(limits)
    rows, count = stream.rows, len(stream.rows)
    learner.scale, name = scale, f"{rows['table'].iloc[0]} {rows['order'].iloc[0]}"
    p_slip, stable = np.full(count, np.nan), np.zeros(count, np.bool_)
    supervised, outcomes = np.zeros(count, np.bool_), np.zeros(count, np.int64)
    margins, ended = rows["margin"].tolist(), rows["slipped"].tolist()
    for index in np.flatnonzero(~rows["refused"]).tolist():
        margin, slipped, inputs = margins[index], ended[index], stream.features[index]
        assessed = assess(
            learner, risk, sigmoid(margin), margin, inputs, name=(name, index), awaited=0
        )
        p_slip[index] = assessed.p_slip
        supervised[index], outcomes[index] = assessed.supervised, assessed.outcomes
        stable[index] = assessed.permission is Permission.ALLOWED and p_slip[index] < 0.5
        if every or stable[index] or assessed.supervised:
            risk.take(stable=bool(stable[index]), slipped=slipped, proves=True)
            learner.learn(np.frombuffer(assessed.features, "<f8"), slipped=slipped)
    return rows.assign(p_slip=p_slip, stable=stable, supervised=supervised, outcomes=outcomes)
