"""Plan of one `graspd train`: the model to make, and the trainings that measure it."""

from __future__ import annotations

import re
import shlex
from dataclasses import dataclass
from pathlib import Path

from graspd.models.bts3 import NEW_SESSION, TABLES, WHOLE
from graspd.models.own import NAME_MAX
from graspd.models.training.data.datasets import Grasps
from graspd.models.training.data.protocols import EvalProtocol
from graspd.models.training.evaluating.jobs import Job, jobs_of
from graspd.models.training.systems.system import System


@dataclass(frozen=True, slots=True)
class TrainingPlan:
    """A system, the folds and the seed that it is measured with."""

    system: System
    folds: int
    seed: int
    processes: int = 1
    only: EvalProtocol | None = None
    """Protocol that alone measures the model, without the study of broken electrodes.

    It is for a model that is only compared. None: all protocols.
    """
    lab_files: tuple[str, ...] = ()
    """File names of the lab tables that are trained on, with their endings."""
    name: str | None = None
    """Name of the model; None: made from the system and its lab tables."""

    @property
    def model(self) -> str:
        """Name of the model and of its files: small-session, small-session-monday."""
        if self.name is not None:
            return self.name
        words = "-".join((self.system.name, *(Path(name).stem for name in self.lab_files)))
        return re.sub(r"[^A-Za-z0-9._]+", "-", words)[:NAME_MAX].rstrip("-.")

    def protocols(self, grasps: Grasps) -> tuple[EvalProtocol, ...]:
        """Return the protocols that measure it: `cv`, then new objects, which calibrate it."""
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
        """Return the grasps of the tables that the kept model is trained on."""
        return grasps.rows(grasps.rows_of(self.system.tables))

    @property
    def command(self) -> str:
        """Return the command line that repeats it, without folders of this machine."""
        published = any(table.name in self.system.tables for table in TABLES)
        data = ["--data DIR"] if published else []
        data += [f"--own {shlex.quote(name)}" for name in self.lab_files]
        only = [] if self.only is None else [f"--only {self.only}"]
        name = [] if self.name is None else [f"--name {self.name}"]
        words = (*data, f"--seed {self.seed}", f"--folds {self.folds}", *only, *name)
        return " ".join(("graspd train", self.system.name, *words))
