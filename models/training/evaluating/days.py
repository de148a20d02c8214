"""Judge grasps of another day one after the other, without labels, as the daemon does."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from graspd.models.inputs import builder
from graspd.models.judge.grasp_judge import GraspJudge
from graspd.models.training.arrays import Bools, Floats, Ints
from graspd.models.training.data.datasets import Grasps
from graspd.models.training.fitting.standards import Variant
from graspd.models.training.fitting.trained import Trained
from graspd.models.training.systems.registry import SessionFeatures
from graspd.models.trust.learner import sigmoid


def verdicts(
    variant: Variant,
    rows: Ints,
    margins: Floats,
    refused: Bools | None = None,
    ages: Ints | None = None,
) -> pd.DataFrame:
    """Return a variant's verdicts on these rows of grasps: the first 5 columns of `frame.judged`.

    `refused` None: not known; `ages` None: there is no running session.
    """
    unknown = [None] * len(rows)
    return pd.DataFrame(
        {
            "variant": str(variant),
            "grasp": rows,
            "margin": margins,
            "refused": pd.array(unknown if refused is None else refused, dtype="boolean"),
            "age": pd.array(unknown if ages is None else ages, dtype="Int64"),
        }
    )


def judged_days(trained: Trained, grasps: Grasps, test: Ints, seed: int) -> Iterator[pd.DataFrame]:
    """Judge the rows `test` of grasps with a trained system; each table is a new session.

    Yields one frame of verdicts, or two for a session system, which judges all rows in random
    order, then again object by object. Refused grasps also have margins.
    """
    counts, table_of = grasps.counts[test], grasps.table_of[test]
    if not isinstance(trained.system.input, SessionFeatures):
        day = Day(trained)
        found = [day.judge_of.examine(reading) for reading in counts]
        inputs, _ = day.network.inputs.build_batch(np.stack([each.counts for each in found]))
        refused = np.array([each.refusal is not None for each in found])
        yield verdicts(Variant.NONE, test, trained.fitted.margins(inputs), refused)
        return
    random = np.random.default_rng(seed)
    for variant in (Variant.RUNNING, Variant.RUNNING_SORTED):
        days = [Day(trained) for _ in grasps.files]
        margins, refused = np.empty(len(test)), np.empty(len(test), np.bool_)
        ages = np.empty(len(test), np.int64)
        order = random.permutation(len(test))
        if variant == Variant.RUNNING_SORTED:
            order = by_object(random, order, np.array(grasps.objects)[test[order]])
        for place in order.tolist():
            day = days[table_of[place]]
            ages[place] = day.grasps
            margins[place], refused[place] = day.judge(counts[place])
        yield verdicts(variant, test, margins, refused, ages)


def by_object(random: np.random.Generator, rows: Ints, objects: NDArray[np.str_]) -> Ints:
    """Return rows (N,) grouped by their `objects` (N,), with the objects in random order.

    The rows of each object stay in the order given.
    """
    several = random.permutation(np.unique(objects))
    return np.concatenate([rows[objects == name] for name in several])


class Day:
    """Judges the grasps of one day in turn; a session system starts with an empty session."""

    def __init__(self, trained: Trained) -> None:
        self.network = TrainedNetwork(trained)
        fingers, seen = trained.system.fingers, trained.seen()
        self.judge_of = GraspJudge(self.network, trained.takes(), fingers, seen)

    @property
    def grasps(self) -> int:
        """Number of grasps that the session has taken in; 0 without a session."""
        return 0 if self.judge_of.session is None else self.judge_of.session.grasps

    def judge(self, counts: NDArray[np.uint16]) -> tuple[float, bool]:
        """Return log-odds of slip, also of a refused grasp, and True if it is refused; then let the
        session take the grasp in."""
        examined = self.judge_of.examine(counts)
        opinion = self.judge_of.judge(examined)
        if opinion.refusal is not None:
            self.judge_of.prepare(counts)
            self.network.run()
        self.judge_of.observe(examined, opinion)
        return self.network.margin, opinion.refusal is not None


class TrainedNetwork:
    """Adapter that lets a `GraspJudge` use a trained system without a model file."""

    def __init__(self, trained: Trained) -> None:
        self._fitted = trained.fitted
        self.inputs = builder(trained.takes(), len(trained.system.fingers))
        self.input = np.zeros(self.inputs.shape, np.float32)
        self.margin = 0.0
        """Log-odds of slip of the last run."""

    def run(self) -> tuple[float, float]:
        """Return the probabilities (stable, slip) for `input`, and set `margin`."""
        (self.margin,) = self._fitted.margins(self.input[np.newaxis]).tolist()
        p_slip = sigmoid(self.margin)
        return 1.0 - p_slip, p_slip
