"""Plan of one `graspd train`: the model to make, the trainings that measure it, and its limits."""

from __future__ import annotations

import dataclasses
import re
import shlex
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from graspd.models.bts3 import NEW_SESSION, TABLES, WHOLE
from graspd.models.training.arrays import Ints
from graspd.models.training.data.datasets import ENOUGH_GRASPS, Grasps, lab_table_names
from graspd.models.training.data.protocols import (
    EvalProtocol,
    TooFewGraspsError,
    grasp_of,
    splits,
)
from graspd.models.training.evaluating.broken import left_out
from graspd.models.training.evaluating.frame import Job, jobs_of
from graspd.models.training.systems.registry import SessionFeatures, System
from graspd.models.zoo import NAME_MAX

FEWEST_FOLDS = 2
FEW_OBJECTS = 10
"""Number of objects at which each default fold leaves out one; published tables have 41."""
FEW_OF_A_KIND = 20
"""Number of grasps below which a share is coarse: one of 20 grasps is 5 %."""
FEWEST_STANDARD = 2
"""Fewest grasps of a table for a session model; a single grasp has no spread."""


@dataclass(frozen=True, slots=True)
class TrainingPlan:
    """A system, the folds and the seed that it is measured with."""

    system: System
    folds: int
    seed: int
    processes: int = 1
    only: EvalProtocol | None = None
    """Only protocol to measure the model by, without the study of broken electrodes.

    It is for a model that is only compared with others. None: all protocols.
    """
    lab_files: tuple[str, ...] = ()
    """File names of the user's own tables that are trained on, with their endings."""
    name: str | None = None
    """Name of the model; None: made from the names of the system and of the user's own tables."""
    read_as: str | None = None
    """How the user's own tables are read, `--as`."""

    @property
    def model(self) -> str:
        """Name of the model and of its files, such as small-session or small-session-monday."""
        if self.name is not None:
            return self.name
        published = {table.name for table in TABLES}
        own = (name for name in self.system.tables if name not in published)
        words = "-".join((self.system.name, *own))
        return re.sub(r"[^A-Za-z0-9._]+", "-", words)[:NAME_MAX].rstrip("-.")

    def protocols(self, grasps: Grasps) -> tuple[EvalProtocol, ...]:
        """Return the protocols of the measurement: `only` if set; else `cv`, then `objects` or
        `objects-whole`, which calibrates probabilities; with all published tables also `session`
        and `days`."""
        if self.only is not None:
            return (self.only,)
        there = {file.name for file in grasps.files}
        if not there.intersection(WHOLE):
            return ("cv", "objects")
        if NEW_SESSION not in there:
            return ("cv", "objects-whole")
        objects: EvalProtocol = "objects" if NEW_SESSION in self.system.tables else "objects-whole"
        return ("cv", objects, "session", "days")

    def jobs(self, grasps: Grasps) -> list[Job]:
        """Return all judged trainings: the folds of each protocol, in order."""
        return [
            job
            for protocol in self.protocols(grasps)
            for job in jobs_of(self.system, protocol, grasps, (self.seed,), self.folds)
        ]

    def chosen(self, grasps: Grasps) -> Grasps:
        """Return the grasps of the tables on which the final model is trained.

        Raises `ValueError` if one of these tables has no grasps.
        """
        for table in self.system.tables:
            if not len(grasps.rows_of((table,))):
                raise ValueError(f"there are no grasps of the table {table!r} to train on")
        return grasps.rows(grasps.rows_of(self.system.tables))

    @property
    def command(self) -> str:
        """Return the command line that repeats the plan, without folders of this computer."""
        published = any(table.name in self.system.tables for table in TABLES)
        data = ["--data DIR"] if published else []
        data += [f"--own {shlex.quote(name)}" for name in self.lab_files]
        data += [f"--as {self.read_as}"] if self.read_as else []
        only = [] if self.only is None else [f"--only {self.only}"]
        name = [] if self.name is None else [f"--name {self.name}"]
        words = (*data, f"--seed {self.seed}", f"--folds {self.folds}", *only, *name)
        return " ".join(("graspd train", self.system.name, *words))


def preflight(plan: TrainingPlan, grasps: Grasps) -> None:
    """Raise `TooFewGraspsError` if a training of the plan lacks grasps of a label.

    A session model also needs `FEWEST_STANDARD` training grasps of each table that tests it.
    """
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


def with_enough_folds(plan: TrainingPlan, grasps: Grasps) -> tuple[TrainingPlan, str]:
    """Return the plan, with fewer folds if the grasps are too few for its own, and the reason.

    The reason is "" if the folds stay. Raises `TooFewGraspsError` if the grasps are too few for
    any.
    """
    why = ""
    for folds in range(plan.folds, FEWEST_FOLDS - 1, -1):
        fewer = dataclasses.replace(plan, folds=folds)
        try:
            preflight(fewer, grasps)
        except TooFewGraspsError as error:
            why = why or str(error)
        else:
            return fewer, why
    raise TooFewGraspsError(why)


def limits(plan: TrainingPlan, grasps: Grasps) -> Iterator[str]:
    """Yield the limits of a model trained on these grasps, one sentence each."""
    grasps = plan.chosen(grasps)
    objects, slips = len(set(grasps.objects)), int(grasps.slipped.sum())
    own = lab_table_names(grasps.files)
    number = len(set(grasp_of(grasps).tolist()))
    if len(own) == len(grasps.files) and number < ENOUGH_GRASPS:
        yield (
            f"{number} grasps are few: the daemon will take many others for unlike the "
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
        yield f"of {known} little is learned about others: {FEW_OBJECTS} or more are needed"
    for kind, number in (("slipped", slips), ("stayed", len(grasps) - slips)):
        if number < FEW_OF_A_KIND:
            yield (
                f"only {number} grasps {kind}: {FEW_OF_A_KIND} or more are needed; lift some that "
                "are not `stable` too (deploy/RECORDING.md)"
            )
    if plan.only is not None:
        yield f"with --only {plan.only} nothing else is measured, broken electrodes neither"


def _trainings(plan: TrainingPlan, grasps: Grasps) -> Iterator[tuple[str, Grasps, Ints, Ints]]:
    """Yield each training's name and grasps, and its rows for training and judging. The rows for
    judging are empty where the judged session needs no training grasps of its table."""
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
