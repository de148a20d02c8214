"""Check, before training starts, that every training of a plan has enough grasps of both labels."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from models.training.data.datasets import Grasps
from models.training.data.folds import TooFewGraspsError
from models.training.data.protocols import splits
from models.training.evaluating.broken import left_out
from models.training.making.plan import TrainingPlan
from models.training.systems.system import DistilConfig, SessionFeatures

FEWEST_STANDARD = 2
"""Grasps of a table that a session model standardises it by: one alone has no spread."""


@dataclass(frozen=True, slots=True, eq=False)
class _Training:
    """One training, and what it is judged by."""

    where: str
    slipped: NDArray[np.bool_]
    """Shape (N,): labels of what it trains on."""
    tables: NDArray[np.int64]
    """Shape (tables,): grasps of each table that it trains on."""
    judged: frozenset[int]
    """Indices of the tables that it is judged by, standardised as in the training."""


def preflight(plan: TrainingPlan, grasps: Grasps) -> None:
    """Raise `TooFewGraspsError` if one of the plan's trainings lacks grasps of a label.

    A training of a session model also needs `FEWEST_STANDARD` of each table that it is judged by.
    """
    estimator = plan.system.estimator
    least = estimator.inner_folds if isinstance(estimator, DistilConfig) else 1
    session = isinstance(plan.system.input, SessionFeatures)
    for training in _trainings(plan, grasps):
        slips = int(training.slipped.sum())
        for kind, number in (("slipped", slips), ("stayed", len(training.slipped) - slips)):
            if number < least:
                raise TooFewGraspsError(
                    f"{training.where} has {number} grasps that {kind} to train on, not {least}"
                )
        for table in training.judged if session else ():
            if training.tables[table] < FEWEST_STANDARD:
                raise TooFewGraspsError(
                    f"{training.where} leaves out all objects of {grasps.files[table].name}, by "
                    "whose other grasps a session model knows the sensors: put the tables of "
                    "a session together"
                )


def _trainings(plan: TrainingPlan, grasps: Grasps) -> Iterator[_Training]:
    for protocol in plan.protocols(grasps):
        for split in splits(protocol, grasps, plan.seed, plan.folds):
            # A session that is calibrated while it is judged needs nothing of the training.
            test = split.test if split.calibration is None else split.test[:0]
            yield _training(f"{protocol}, {split.name},", grasps, split.train, test)
    if plan.only is None:
        kept = plan.chosen(grasps)
        for out in left_out(kept, plan.seed):
            rest, test = np.flatnonzero(~out), np.flatnonzero(out)
            yield _training("the study of broken electrodes", kept, rest, test)


def _training(
    where: str, grasps: Grasps, train: NDArray[np.int64], test: NDArray[np.int64]
) -> _Training:
    table_of = grasps.table_of
    tables = np.bincount(table_of[train], minlength=len(grasps.files))
    return _Training(where, grasps.slipped[train], tables, frozenset(table_of[test].tolist()))
