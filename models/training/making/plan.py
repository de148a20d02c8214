"""What one `graspd train` makes, and by which trainings it is measured."""

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
    """Measured by this protocol alone, and without the study of broken electrodes: for a model that
    is compared and not used."""
    lab_files: tuple[str, ...] = ()
    """File names of the lab tables that are trained on, with their endings."""
    name: str | None = None
    """Of the model that is made; that of the system and its lab tables unless given."""

    @property
    def model(self) -> str:
        """Name of the model and of its files: small-session, small-session-monday."""
        if self.name is not None:
            return self.name
        words = "-".join((self.system.name, *(Path(name).stem for name in self.lab_files)))
        return re.sub(r"[^A-Za-z0-9._]+", "-", words)[:NAME_MAX].rstrip("-.")

    def protocols(self, grasps: Grasps) -> tuple[EvalProtocol, ...]:
        """By what it is measured: `cv` first; the second, with new objects, calibrates it."""
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
        """Every training that is judged: the folds of each protocol, in the order of both."""
        return [
            job
            for protocol in self.protocols(grasps)
            for job in jobs_of(self.system, protocol, grasps, (self.seed,), self.folds)
        ]

    def chosen(self, grasps: Grasps) -> Grasps:
        """Those of the tables that the model that is kept is trained on."""
        return grasps.rows(grasps.rows_of(self.system.tables))

    @property
    def command(self) -> str:
        """The command line that repeats it, without the folders of this machine."""
        published = any(table.name in self.system.tables for table in TABLES)
        data = ["--data DIR"] if published else []
        data += [f"--own {shlex.quote(name)}" for name in self.lab_files]
        only = [] if self.only is None else [f"--only {self.only}"]
        name = [] if self.name is None else [f"--name {self.name}"]
        words = (*data, f"--seed {self.seed}", f"--folds {self.folds}", *only, *name)
        return " ".join(("graspd train", self.system.name, *words))
