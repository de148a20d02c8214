"""What one `graspd evaluate` runs: systems times protocols times seeds times folds."""

from __future__ import annotations

import dataclasses
import itertools
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from models.training.data.datasets import Grasps
from models.training.data.protocols import FOLDS, EvalProtocol, splits
from models.training.evaluating.jobs import Job, JobResult
from models.training.evaluating.run_jobs import run_jobs
from models.training.evaluating.summaries import Summary, summarise, write_summary
from models.training.systems.system import System, digest, with_recipes

QUICK_GRASPS, QUICK_FOLDS, QUICK_EPOCHS = 400, 2, 1
"""Enough to see that everything runs; the figures mean nothing."""

Group = tuple[System, EvalProtocol]


@dataclass(frozen=True, slots=True, eq=False)
class Campaign:
    """All jobs, and the grasps that they train on and judge."""

    groups: tuple[Group, ...]
    jobs: tuple[Job, ...]
    grasps: Grasps

    @property
    def data(self) -> str:
        """Digest of the grasps."""
        return self.grasps.digest()

    def run(
        self,
        folder: Path,
        *,
        processes: int = 1,
        dask: str | None = None,
        on_job: Callable[[str], None] | None = None,
        on_summary: Callable[[Summary], None] | None = None,
        keep: bool = True,
    ) -> list[Summary]:
        """Run all jobs as `run_jobs` does; a summary per system and protocol, in their order.

        Results of jobs are stored in `folder`/jobs, and, if `keep`, each summary in `folder` as
        soon as it is complete. `on_job` is called with the job's system and protocol after each.
        """
        found: dict[Job, JobResult] = {}
        made: dict[tuple[str, EvalProtocol], Summary] = {}
        missing = Counter((job.system.name, job.protocol) for job in self.jobs)

        def on_result(index: int, result: JobResult) -> None:
            job = self.jobs[index]
            key = (job.system.name, job.protocol)
            found[job] = result
            missing[key] -= 1
            if on_job is not None:
                on_job(f"{job.system.name} {job.protocol}")
            if missing[key]:
                return
            by_seed: dict[int, list[JobResult]] = {}
            for each in self.jobs:
                if (each.system.name, each.protocol) == key:
                    by_seed.setdefault(each.seed, []).append(found.pop(each))
            made[key] = summarise(job.system, job.protocol, by_seed, self.grasps)
            if keep:
                write_summary(made[key], folder)
            if on_summary is not None:
                on_summary(made[key])

        run_jobs(
            self.jobs,
            self.grasps,
            folder / "jobs",
            processes=processes,
            dask=dask,
            on_result=on_result,
        )
        return [made[system.name, protocol] for system, protocol in self.groups]


def campaign(
    systems: Sequence[System],
    protocols: Sequence[EvalProtocol],
    grasps: Grasps,
    *,
    seeds: int,
    quick: bool = False,
) -> Campaign:
    """Every fold of these systems, protocols and seeds 0..seeds-1; fewer and smaller if `quick`.

    Raises `TooFewGraspsError` if the data do not have the splits.
    """
    folds = QUICK_FOLDS if quick else FOLDS
    if quick:
        systems = [quickened(system) for system in systems]
        chosen = np.random.default_rng(0).permutation(len(grasps))[:QUICK_GRASPS]
        grasps = grasps.rows(np.sort(chosen).astype(np.int64))
    groups = tuple((system, protocol) for system in systems for protocol in protocols)
    counts = {protocol: len(splits(protocol, grasps, 0, folds)) for protocol in protocols}
    jobs = tuple(
        Job(system, protocol, seed, fold, folds)
        for forms, protocol in itertools.product(_forms(systems), protocols)
        for seed in range(seeds)
        for fold in range(counts[protocol])
        for system in forms
    )
    return Campaign(groups, jobs, grasps)


def _forms(systems: Sequence[System]) -> list[list[System]]:
    """The systems, with those together that are one network in different forms.

    Their jobs of a fold follow each other, so it is trained once.
    """
    forms: dict[str, list[System]] = {}
    for system in systems:
        whole = dataclasses.replace(system, compression=None)
        forms.setdefault(digest(whole), []).append(system)
    return list(forms.values())


def quickened(system: System) -> System:
    """The system with networks that are hardly trained."""
    return with_recipes(system, epochs=QUICK_EPOCHS)
