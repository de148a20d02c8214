"""Check, before training starts, that every training of a plan has enough grasps of both labels,
and say what its model will not be able to do."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator

import numpy as np

from graspd.models.training.arrays import Ints
from graspd.models.training.data.datasets import Grasps, lab_table_names
from graspd.models.training.data.lab_tables import ENOUGH_GRASPS
from graspd.models.training.data.protocols import TooFewGraspsError, splits
from graspd.models.training.evaluating.broken import left_out
from graspd.models.training.making.plan import TrainingPlan
from graspd.models.training.systems.system import SessionFeatures

FEWEST_FOLDS = 2
FEW_OBJECTS = 10
"""The default folds leave out one object each then; the published tables have 41."""
FEW_OF_A_KIND = 20
"""One grasp less is then five percent of what is known of a kind."""
FEWEST_STANDARD = 2
"""Grasps of a table that a session model standardises it by: one alone has no spread."""


def preflight(plan: TrainingPlan, grasps: Grasps) -> None:
    """Raise `TooFewGraspsError` if a training of the plan lacks grasps of a label.
    That of a session model also needs `FEWEST_STANDARD` of each table that it is judged by."""
    session = isinstance(plan.system.input, SessionFeatures)
    for where, of, train, test in _trainings(plan, grasps):
        slips = int(of.slipped[train].sum())
        for kind, number in (("slipped", slips), ("stayed", len(train) - slips)):
            if not number:
                raise TooFewGraspsError(f"{where} has 0 grasps that {kind} to train on, not 1")
        trained = np.bincount(of.table_of[train], minlength=len(of.files))
        for table in np.unique(of.table_of[test]) if session else ():
            if trained[table] < FEWEST_STANDARD:
                raise TooFewGraspsError(
                    f"{where} leaves out all objects of {of.files[table].name}, by "
                    "whose other grasps a session model knows the sensors: put the tables of "
                    "a session together"
                )


def enough_folds(plan: TrainingPlan, grasps: Grasps) -> int | None:
    """The most folds, fewer than the plan's, that these grasps are enough for; None if none are."""
    for folds in range(plan.folds - 1, FEWEST_FOLDS - 1, -1):
        try:
            preflight(dataclasses.replace(plan, folds=folds), grasps)
        except TooFewGraspsError:
            continue
        return folds
    return None


def with_enough_folds(plan: TrainingPlan, grasps: Grasps) -> tuple[TrainingPlan, str]:
    """Return the plan with the most folds, up to its own, that these grasps are enough for, and
    why they are fewer: "" if they are not. Raises `TooFewGraspsError` if there are none."""
    try:
        preflight(plan, grasps)
    except TooFewGraspsError as error:
        folds = enough_folds(plan, grasps)
        if folds is None:
            raise
        return dataclasses.replace(plan, folds=folds), str(error)
    return plan, ""


def limits(plan: TrainingPlan, grasps: Grasps) -> Iterator[str]:
    """What a model of these grasps will not be able to do, one sentence each."""
    grasps = plan.chosen(grasps)
    objects, slips = len(set(grasps.objects)), int(grasps.slipped.sum())
    own = lab_table_names(grasps.files)
    if len(own) == len(grasps.files) and len(grasps) < ENOUGH_GRASPS:
        yield (
            f"{len(grasps)} grasps are few: the daemon will take many others for unlike the "
            f"training, and call them unknown; {ENOUGH_GRASPS} are enough"
        )
    if not isinstance(plan.system.input, SessionFeatures):
        yield (
            f"{plan.system.name} is not calibrated by the session: when the sensors drift, or on "
            "another day, it will be wrong far more often (small-session is)"
        )
    if sum(file.rows > 0 for file in grasps.files) == 1:
        yield "one table is one day: what the model is worth on another one is not measured"
    if objects < FEW_OBJECTS:
        known = "one object" if objects == 1 else f"{objects} objects"
        yield f"of {known} little is learned about others: {FEW_OBJECTS} or more are wanted"
    for kind, number in (("slipped", slips), ("stayed", len(grasps) - slips)):
        if number < FEW_OF_A_KIND:
            yield (
                f"only {number} grasps {kind}: {FEW_OF_A_KIND} or more are wanted; lift some that "
                "are not `stable` too (deploy/RECORDING.md)"
            )
    if plan.only is not None:
        yield f"with --only {plan.only} nothing else is measured, broken electrodes neither"


def _trainings(plan: TrainingPlan, grasps: Grasps) -> Iterator[tuple[str, Grasps, Ints, Ints]]:
    """Yield each training's name and grasps, and the rows that it trains on and is judged by.
    A session that is calibrated while it is judged needs no rows of the training."""
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
