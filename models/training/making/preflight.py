"""Check, before training starts, that every training of a plan has enough grasps of both labels."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from models.training.arrays import Ints
from models.training.data.datasets import Grasps
from models.training.data.folds import TooFewGraspsError
from models.training.data.protocols import splits
from models.training.evaluating.broken import left_out
from models.training.making.plan import TrainingPlan
from models.training.systems.system import DistilConfig, SessionFeatures

FEWEST_STANDARD = 2
"""Grasps of a table that a session model standardises it by: one alone has no spread."""


def preflight(plan: TrainingPlan, grasps: Grasps) -> None:
    """Raise `TooFewGraspsError` if one of the plan's trainings lacks grasps of a label.

    A training of a session model also needs `FEWEST_STANDARD` of each table that it is judged by.
    """
    estimator = plan.system.estimator
    least = estimator.inner_folds if isinstance(estimator, DistilConfig) else 1
    session = isinstance(plan.system.input, SessionFeatures)
    for where, of, train, test in _trainings(plan, grasps):
        slips = int(of.slipped[train].sum())
        for kind, number in (("slipped", slips), ("stayed", len(train) - slips)):
            if number < least:
                raise TooFewGraspsError(
                    f"{where} has {number} grasps that {kind} to train on, not {least}"
                )
        trained = np.bincount(of.table_of[train], minlength=len(of.files))
        for table in np.unique(of.table_of[test]) if session else ():
            if trained[table] < FEWEST_STANDARD:
                raise TooFewGraspsError(
                    f"{where} leaves out all objects of {of.files[table].name}, by "
                    "whose other grasps a session model knows the sensors: put the tables of "
                    "a session together"
                )


def _trainings(plan: TrainingPlan, grasps: Grasps) -> Iterator[tuple[str, Grasps, Ints, Ints]]:
    """Of each training: its name, grasps, and the rows that it trains on and is judged by.

    A session that is calibrated while it is judged needs nothing of the training: no rows.
    """
    for protocol in plan.protocols(grasps):
        for split in splits(protocol, grasps, plan.seed, plan.folds):
            alone = protocol == "days" or split.calibration is not None
            test = split.test[:0] if alone else split.test
            yield f"{protocol}, {split.name},", grasps, split.train, test
    if plan.only is None:
        kept = plan.chosen(grasps)
        for out in left_out(kept, plan.seed):
            rest, test = np.flatnonzero(~out), np.flatnonzero(out)
            yield "the study of broken electrodes", kept, rest, test
