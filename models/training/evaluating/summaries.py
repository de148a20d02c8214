"""Figures of a system in a protocol, from all its jobs, in one JSON file."""

from __future__ import annotations

import importlib.metadata
import logging
import os
import platform
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import msgspec
import numpy as np
from sklearn.metrics import confusion_matrix, f1_score

from graspd.models.contract import ConfidenceStep, Dataset
from graspd.models.training.arrays import Bools, Floats
from graspd.models.training.data.datasets import Grasps
from graspd.models.training.data.protocols import DAYS, PROTOCOLS, EvalProtocol
from graspd.models.training.evaluating import metrics
from graspd.models.training.evaluating.files import to_json, write_whole
from graspd.models.training.evaluating.jobs import Job, JobResult
from graspd.models.training.systems.registry import digest

FORMAT = 1
HEADLINE = "n50"
"""Variant that is quoted for a session system in a later session: 50 unlabelled grasps before."""
WANTED_ACCURACIES = (0.9, 0.95, 0.98, 0.99)
COVERAGES = (0.9, 0.8, 0.5)
AGES = (0, 5, 10, 20, 50, 100, 300)
"""Limits of the groups of grasps by the age of a running session, grasps."""
LIBRARIES = ("numpy", "scikit-learn", "torch")
STREAMS = [f"{day} {table}" for day, _, judged in DAYS for table in judged]
"""Names of the streams of `days`: `A`, `B` or `C`, and the table that is judged."""
GROUPS = {
    **{name: [name] for name in STREAMS},
    "A and C": [name for name in STREAMS if not name.startswith("B")],
    "all": STREAMS,
}
"""Streams that are counted together, by the name of the group."""

_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class ObjectFigures:
    """Figures of one object's grasps."""

    share: metrics.Fraction
    f1: float
    """Slip positive; 0 for an object that never slipped."""


@dataclass(frozen=True, slots=True)
class AgeFigures:
    """Figures of grasps by the number before in a session."""

    grasps_before: int
    """Lowest age of the group, grasps; it ends below that of the next group."""
    share: metrics.Fraction
    temperature: float


@dataclass(frozen=True, slots=True)
class VerdictFigures:
    """Figures of verdicts as fractions; slip is positive."""

    grasps: int
    f1: float
    slips_among_stable: float | None
    """Share of slips among the grasps called stable; None: no such grasp."""
    slips_called_stable: float | None
    """Share of the slips that are called stable; None: no slip."""
    stable_called_slip: float | None
    """Share of the stable grasps that are called slip; None: no stable grasp."""

    @classmethod
    def of(cls, called_slip: Bools, slipped: Bools) -> VerdictFigures:
        """Return the figures of verdicts and outcomes, shape (N,) each."""
        missed, alarms = ~called_slip & slipped, called_slip & ~slipped
        f1 = f1_score(slipped, called_slip, zero_division=0.0) if len(slipped) else 0.0
        return cls(
            len(slipped),
            float(f1),
            _share(missed, ~called_slip),
            _share(missed, slipped),
            _share(alarms, ~slipped),
        )


@dataclass(frozen=True, slots=True)
class DayFigures:
    """Figures of grasps of another day."""

    every: VerdictFigures
    """Figures of all grasps, also those that the daemon would refuse."""
    judged: VerdictFigures
    """Figures of the grasps that the daemon would judge."""
    coverage: float
    """Fraction of the grasps that would be judged."""
    refused_slipped: float | None
    """Fraction of slips among the refused grasps; None: no such grasp."""


@dataclass(frozen=True, slots=True)
class Variant:
    """Figures of one way of judging. Grasps of all seeds count alike."""

    spreads: dict[str, metrics.Spread]
    """Mean and spread of each figure, by its name."""
    figures: dict[str, list[list[float | None]]]
    """Each figure in each fold (seeds, folds), by its name."""
    temperature: float
    """Temperature of all margins together; probabilities of the figures are cross-fitted."""
    confusion: list[list[int]]
    """Grasps of all seeds: rows stable, slip as it was; columns as it was judged."""
    objects: dict[str, ObjectFigures]
    palms: dict[str, metrics.Fraction]
    """Share of right verdicts by name of the table."""
    curve: list[ConfidenceStep]
    coverages: dict[str, float]
    """Accuracy of the most confident grasps, by their share."""
    thresholds: dict[str, ConfidenceStep | None]
    """Lowest confidence that reaches an accuracy, by that accuracy."""
    bins: list[tuple[float, float, int]]
    """Mean slip probability, share that slipped, grasps."""
    ages: list[AgeFigures]
    """Figures of running variants, by age of the session."""
    days: dict[str, DayFigures] = field(default_factory=dict)
    """Figures of the protocol `days`, by group of streams."""


@dataclass(frozen=True, slots=True)
class SystemSummary:
    """All figures of a system in one protocol."""

    format: int
    system: str
    description: str
    digest: str
    """Digest of the system's configuration; `data` is that of the grasps."""
    protocol: EvalProtocol
    data: str
    files: tuple[Dataset, ...]
    seeds: tuple[int, ...]
    folds: int
    train_grasps: float
    """Number of training grasps, mean over the trainings."""
    test_grasps: float
    parameters: int
    """Numbers that a trained system consists of, mean over the trainings."""
    seconds: float
    """Time of all trainings, one thread each, s."""
    headline: str
    """The variant whose figures are quoted for the system."""
    variants: dict[str, Variant]
    made_with: dict[str, str]

    @property
    def main(self) -> Variant:
        """The variant whose figures are quoted."""
        return self.variants[self.headline]


def summarise(found: Mapping[Job, JobResult], grasps: Grasps) -> SystemSummary:
    """Return the figures of a system in a protocol.
    `found` has its jobs, all folds of every seed in their order, and their results."""
    flat = list(found.values())
    names = list(flat[0].margins)
    job = next(iter(found))
    system = job.system
    by_seed: dict[int, list[JobResult]] = {}
    for each, result in found.items():
        by_seed.setdefault(each.seed, []).append(result)
    seeds = list(by_seed.values())
    return SystemSummary(
        format=FORMAT,
        system=system.name,
        description=system.description,
        digest=digest(system),
        protocol=job.protocol,
        data=grasps.digest(),
        files=grasps.files,
        seeds=tuple(by_seed),
        folds=len(seeds[0]),
        train_grasps=float(np.mean([result.train_grasps for result in flat])),
        test_grasps=float(np.mean([len(result.test) for result in flat])),
        parameters=round(float(np.mean([result.parameters for result in flat]))),
        seconds=sum(result.seconds for result in flat),
        headline=HEADLINE if HEADLINE in names else names[0],
        variants={name: _variant(name, seeds, grasps) for name in names},
        made_with=made_with(),
    )


def made_with(libraries: Sequence[str] = LIBRARIES) -> dict[str, str]:
    """Machine, Python and versions of libraries that decide the last digits."""
    versions = {name: importlib.metadata.version(name) for name in libraries}
    machine = f"{platform.machine()}, {os.cpu_count()} cores"
    return {"machine": machine, "python": platform.python_version(), **versions}


def write_summary(summary: SystemSummary, folder: Path) -> None:
    """Store a summary as `SYSTEM.PROTOCOL.json` in the folder. Raises `OSError`."""
    write_whole(folder / f"{summary.system}.{summary.protocol}.json", to_json(summary))


def read_summaries(folder: Path, data: str, digests: Mapping[str, str]) -> list[SystemSummary]:
    """Return the folder's summaries of this data (a digest), by system and then by protocol.

    `digests`: those of the systems by name, in their order. A summary that is of another
    configuration or cannot be read is left out, with a warning.
    """
    found = []
    for path in sorted(folder.glob("*.json")):
        if path.name.endswith(".grid.json"):
            continue
        try:
            summary = msgspec.json.decode(path.read_bytes(), type=SystemSummary)
            if summary.format != FORMAT:
                raise ValueError(f"format {summary.format}, not {FORMAT}")
        except ValueError as error:
            _log.warning("%s is left out: %s", path, error)
            continue
        if summary.data == data and digests.get(summary.system) == summary.digest:
            found.append(summary)
        else:
            _log.warning("%s is left out: it is of other data or another configuration", path)
    systems = list(digests)
    return sorted(found, key=lambda one: (systems.index(one.system), PROTOCOLS.index(one.protocol)))


def _variant(name: str, seeds: Sequence[Sequence[JobResult]], grasps: Grasps) -> Variant:
    """Return the figures of one way of judging; `seeds` has, for each, the results of all folds."""
    results = [result for folds in seeds for result in folds]
    rows = np.concatenate([result.test for result in results])
    margins = np.concatenate([result.margins[name] for result in results])
    probability = np.concatenate([_probability(name, folds, grasps) for folds in seeds])
    ends = np.cumsum([len(result.test) for result in results])[:-1]
    of_folds = iter(np.split(probability, ends))
    scores = [
        [
            metrics.score(fold.margins[name], grasps.slipped[fold.test], next(of_folds))
            for fold in folds
        ]
        for folds in seeds
    ]
    figures = {
        metric: [[fold[metric] for fold in folds] for folds in scores] for metric in scores[0][0]
    }
    slipped, verdict = grasps.slipped[rows], margins > 0.0
    objects, tables = np.array(grasps.objects)[rows], grasps.table_of[rows]

    def share(inside: Bools) -> metrics.Fraction:
        # A grasp that was judged once per seed is one grasp to the interval.
        right = verdict[inside] == slipped[inside]
        return metrics.wilson(float(right.mean()), max(1, len(right) // len(seeds)))

    def by_object(inside: Bools) -> ObjectFigures:
        f1 = f1_score(slipped[inside], verdict[inside], zero_division=0.0)
        return ObjectFigures(share(inside), float(f1))

    def by_age(group: int, inside: Bools) -> AgeFigures:
        temperature = metrics.fit_temperature(margins[inside], slipped[inside])
        return AgeFigures(AGES[group], share(inside), temperature)

    ages = [result.ages[name] for result in results if name in result.ages]
    groups = np.searchsorted(AGES, np.concatenate(ages), side="right") - 1 if ages else np.array([])
    return Variant(
        spreads={metric: metrics.over_seeds(values) for metric, values in figures.items()},
        figures=figures,
        temperature=metrics.fit_temperature(margins, slipped),
        confusion=confusion_matrix(slipped, verdict, labels=(False, True)).tolist(),
        objects={name: by_object(objects == name) for name in np.unique(objects).tolist()},
        palms={grasps.files[table].name: share(tables == table) for table in np.unique(tables)},
        curve=metrics.coverage_curve(probability, slipped),
        coverages={f"{c:g}": metrics.accuracy_at(probability, slipped, c) for c in COVERAGES},
        thresholds={
            f"{a:g}": metrics.reject_threshold(probability, slipped, a, len(seeds))
            for a in WANTED_ACCURACIES
        },
        bins=metrics.reliability_bins(probability, slipped),
        ages=[by_age(group, groups == group) for group in np.unique(groups)],
        days=day_figures(name, seeds, grasps) if results[0].refused else {},
    )


def day_figures(
    variant: str, folds: Sequence[Sequence[JobResult]], grasps: Grasps
) -> dict[str, DayFigures]:
    """Return the figures by group of streams. `folds`: results of `days` for each seed."""
    results = [result for each in folds for result in each]
    rows = np.concatenate([result.test for result in results])
    slip = np.concatenate([result.margins[variant] for result in results]) > 0.0
    refused = np.concatenate([result.refused[variant] for result in results])
    slipped, tables = grasps.slipped[rows], [grasps.files[t].name for t in grasps.table_of[rows]]
    # The splits of a seed are those of the first of `DAYS`, then of the next.
    days = [DAYS[fold * len(DAYS) // len(each)][0] for each in folds for fold in range(len(each))]
    day_of = np.repeat(days, [len(result.test) for result in results])
    streams = [f"{day} {table}" for day, table in zip(day_of, tables, strict=True)]
    made = {}
    for group, names in GROUPS.items():
        every = np.isin(streams, names)
        judged = every & ~refused
        made[group] = DayFigures(
            VerdictFigures.of(slip[every], slipped[every]),
            VerdictFigures.of(slip[judged], slipped[judged]),
            float(1.0 - refused[every].mean()),
            _share(every & slipped & refused, every & refused),
        )
    return made


def _probability(name: str, folds: Sequence[JobResult], grasps: Grasps) -> Floats:
    """Return the slip probability of a seed's test grasps, calibrated by its other folds.

    A single fold is calibrated by its other objects.
    """
    rows = np.concatenate([fold.test for fold in folds])
    margins = np.concatenate([fold.margins[name] for fold in folds])
    if len(folds) > 1:
        groups = np.repeat(np.arange(len(folds)), [len(fold.test) for fold in folds])
    else:
        objects = np.array(grasps.objects)[rows]
        groups = np.unique(objects, return_inverse=True)[1].astype(np.int64)
    if len(np.unique(groups)) == 1:
        return metrics.p_slip(margins)
    return metrics.cross_fitted_p_slip(margins, grasps.slipped[rows], groups)


def _share(some: Bools, of: Bools) -> float | None:
    return float(some.sum() / of.sum()) if of.any() else None
