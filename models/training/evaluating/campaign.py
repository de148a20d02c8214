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
from models.training.data.protocols import FOLDS, Protocol, splits
from models.training.evaluating import summary as summaries
from models.training.evaluating.jobs import Job, JobResult
from models.training.evaluating.summary import Summary, summarise
from models.training.evaluating.sweep import sweep
from models.training.systems.system import System, digest, with_recipes

QUICK_GRASPS, QUICK_FOLDS, QUICK_EPOCHS = 400, 2, 1
"""Enough to see that everything runs; the figures mean nothing."""

Group = tuple[System, Protocol]


@dataclass(frozen=True, slots=True, eq=False)
class Campaign:
    """All jobs, and the grasps they are about."""

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
        """A summary per system and protocol, in their order; see `sweep` for the rest.

        Summaries are written into `folder`, unless not to `keep`, as soon as they are complete;
        what is stored of each job stands in its folder `jobs`.
        """
        collected: dict[tuple[str, Protocol], dict[Job, JobResult]] = {}
        made: dict[tuple[str, Protocol], Summary] = {}
        sizes = Counter((job.system.name, job.protocol) for job in self.jobs)

        def on_result(index: int, result: JobResult) -> None:
            job = self.jobs[index]
            key = (job.system.name, job.protocol)
            collected.setdefault(key, {})[job] = result
            if on_job is not None:
                on_job(f"{job.system.name} {job.protocol}")
            if len(collected[key]) < sizes[key]:
                return
            made[key] = _summary(collected.pop(key), self.grasps)
            if keep:
                summaries.write(made[key], folder)
            if on_summary is not None:
                on_summary(made[key])

        sweep(
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
    protocols: Sequence[Protocol],
    grasps: Grasps,
    *,
    seeds: int,
    quick: bool = False,
) -> Campaign:
    """All jobs of these systems. Raises `TooFewGraspsError` if the data do not have the splits."""
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


def _summary(results: dict[Job, JobResult], grasps: Grasps) -> Summary:
    ordered = sorted(results, key=lambda job: (job.seed, job.fold))
    by_seed: dict[int, list[JobResult]] = {}
    for job in ordered:
        by_seed.setdefault(job.seed, []).append(results[job])
    return summarise(ordered[0].system, ordered[0].protocol, by_seed, grasps)
