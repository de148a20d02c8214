"""What a system reached in a protocol: all its jobs in one summary, kept as JSON."""

from __future__ import annotations

import importlib.metadata
import logging
import math
import os
import platform
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import msgspec
import numpy as np
from numpy.typing import NDArray

from models.contract import Dataset
from models.training.data.datasets import Grasps
from models.training.data.protocols import PROTOCOLS, Protocol
from models.training.evaluating.jobs import JobResult
from models.training.evaluating.metrics import (
    METRICS,
    CurvePoint,
    Fraction,
    Scores,
    Spread,
    accuracy_at,
    coverage_curve,
    over_seeds,
    reject_threshold,
    reliability_bins,
    score,
    wilson,
)
from models.training.fitting.calibration import cross_fitted_p_slip, fit_temperature, p_slip
from models.training.systems.system import System, digest

FORMAT = 1
HEADLINE = "n50"
"""Variant that speaks for a session system in a later session: 50 unlabelled grasps."""
WANTED_ACCURACIES = (0.9, 0.95, 0.98, 0.99)
COVERAGES = (0.9, 0.8, 0.5)
AGES = (0, 5, 10, 20, 50, 100, 300)
"""Bounds of the groups of grasps by what a running session had seen before, grasps."""
LIBRARIES = ("numpy", "scikit-learn", "torch")

_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class ObjectFigures:
    """Figures of one object's grasps."""

    share: Fraction
    f1: float
    """Slip positive; 0 for an object that never slipped."""


@dataclass(frozen=True, slots=True)
class AgeFigures:
    """Figures of the grasps that came when a running session was this old."""

    grasps_before: int
    """At least so many, and fewer than the next group's."""
    share: Fraction
    temperature: float
    """Makes these margins probabilities."""


@dataclass(frozen=True, slots=True)
class Variant:
    """Figures of one way of judging. Grasps of all seeds count alike."""

    spreads: dict[str, Spread]
    """By name of the figure."""
    figures: dict[str, list[list[float | None]]]
    """By name: of each fold (seeds, folds)."""
    temperature: float
    """Of all margins together; the figures' probabilities are cross-fitted."""
    confusion: tuple[tuple[int, int], tuple[int, int]]
    """Grasps of all seeds: rows stable, slip as it was; columns as it was judged."""
    objects: dict[str, ObjectFigures]
    palms: dict[str, Fraction]
    """By name of the table."""
    curve: list[CurvePoint]
    coverages: dict[str, float]
    """By share of the grasps, the most confident ones: accuracy."""
    thresholds: dict[str, CurvePoint | None]
    """By wanted accuracy: from which confidence on."""
    bins: list[tuple[float, float, int]]
    """Mean slip probability, share that slipped, grasps."""
    ages: list[AgeFigures]
    """Of running variants."""


@dataclass(frozen=True, slots=True)
class Summary:
    """All that is known of a system in one protocol."""

    format: int
    system: str
    description: str
    digest: str
    """Of the system's configuration."""
    protocol: Protocol
    data: str
    """Digest of the grasps."""
    files: tuple[Dataset, ...]
    seeds: tuple[int, ...]
    folds: int
    train_grasps: float
    """Mean over the trainings."""
    test_grasps: float
    parameters: int
    """Numbers that a trained system consists of, mean over the trainings."""
    seconds: float
    """Of all trainings, one thread each."""
    headline: str
    """The variant that speaks for the system."""
    variants: dict[str, Variant]
    made_with: dict[str, str]

    @property
    def main(self) -> Variant:
        """The variant that speaks for the system."""
        return self.variants[self.headline]


Results = Mapping[int, Sequence[JobResult]]
"""By seed: the results of all folds."""


def summarise(system: System, protocol: Protocol, results: Results, grasps: Grasps) -> Summary:
    """All jobs of a system in a protocol, in one."""
    flat = [result for folds in results.values() for result in folds]
    names = list(flat[0].margins)
    return Summary(
        format=FORMAT,
        system=system.name,
        description=system.description,
        digest=digest(system),
        protocol=protocol,
        data=grasps.digest(),
        files=grasps.files,
        seeds=tuple(results),
        folds=len(next(iter(results.values()))),
        train_grasps=float(np.mean([result.train_grasps for result in flat])),
        test_grasps=float(np.mean([len(result.test) for result in flat])),
        parameters=round(float(np.mean([result.parameters for result in flat]))),
        seconds=sum(result.seconds for result in flat),
        headline=HEADLINE if HEADLINE in names else names[0],
        variants={name: _variant(name, results, grasps) for name in names},
        made_with=made_with(),
    )


def made_with() -> dict[str, str]:
    """Machine and versions of what decides the last digits."""
    versions = {name: importlib.metadata.version(name) for name in LIBRARIES}
    machine = f"{platform.machine()}, {os.cpu_count()} cores"
    return {"machine": machine, "python": platform.python_version(), **versions}


def path_of(folder: Path, system: str, protocol: str) -> Path:
    """Where a summary is kept."""
    return folder / f"{system}.{protocol}.json"


def write(summary: Summary, folder: Path) -> None:
    """Store a summary, whole or not at all."""
    path = path_of(folder, summary.system, summary.protocol)
    part = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        part.write_bytes(to_json(summary))
        part.replace(path)
    finally:
        part.unlink(missing_ok=True)


def to_json(value: object) -> bytes:
    """Indented JSON with a newline."""
    return msgspec.json.format(msgspec.json.encode(value), indent=2) + b"\n"


def read(path: Path) -> Summary:
    """Read a summary. Raises `OSError`, or `ValueError` if it is none of this format."""
    summary = msgspec.json.decode(path.read_bytes(), type=Summary)
    if summary.format != FORMAT:
        raise ValueError(f"{path}: format {summary.format}, not {FORMAT}")
    return summary


def read_all_of(folder: Path, data: str, digests: Mapping[str, str]) -> list[Summary]:
    """Summaries in a folder that are of this data and of these systems, by name: digest.

    In the order of the systems and protocols. What is of another configuration or cannot be read
    is left out, with a warning.
    """
    found = []
    for path in sorted(folder.glob("*.json")):
        if path.name.endswith(".grid.json"):
            continue
        try:
            summary = read(path)
        except ValueError as error:
            _log.warning("%s is left out: %s", path, error)
            continue
        if summary.data == data and digests.get(summary.system) == summary.digest:
            found.append(summary)
        else:
            _log.warning("%s is left out: it is of other data or another configuration", path)
    systems = list(digests)
    return sorted(found, key=lambda one: (systems.index(one.system), PROTOCOLS.index(one.protocol)))


def _variant(name: str, results: Results, grasps: Grasps) -> Variant:
    pools = [_Pool(name, folds, grasps) for folds in results.values()]
    scores = [pool.scores() for pool in pools]
    figures = {
        metric: [[getattr(fold, metric) for fold in folds] for folds in scores]
        for metric in METRICS
    }
    rows = np.concatenate([pool.rows for pool in pools])
    margins = np.concatenate([pool.margins for pool in pools])
    probability = np.concatenate([pool.probability for pool in pools])
    slipped = grasps.slipped[rows]
    ages = [pool.ages for pool in pools if pool.ages is not None]
    return Variant(
        spreads={metric: over_seeds(values) for metric, values in figures.items()},
        figures={
            metric: [[None if math.isnan(value) else value for value in row] for row in values]
            for metric, values in figures.items()
        },
        temperature=fit_temperature(margins, slipped),
        confusion=_confusion(margins, slipped),
        objects=_by_object(margins, rows, grasps, len(pools)),
        palms=_by_palm(margins, rows, grasps, len(pools)),
        curve=coverage_curve(probability, slipped),
        coverages={f"{c:g}": accuracy_at(probability, slipped, c) for c in COVERAGES},
        thresholds={f"{a:g}": reject_threshold(probability, slipped, a) for a in WANTED_ACCURACIES},
        bins=reliability_bins(probability, slipped),
        ages=_by_age(margins, slipped, np.concatenate(ages), len(pools)) if ages else [],
    )


class _Pool:
    """The folds of one seed, one after the other, in one variant."""

    def __init__(self, variant: str, folds: Sequence[JobResult], grasps: Grasps) -> None:
        self._grasps = grasps
        self._fold_of = np.repeat(np.arange(len(folds)), [len(fold.test) for fold in folds])
        self.rows = np.concatenate([fold.test for fold in folds])
        self.margins = np.concatenate([fold.margins[variant] for fold in folds])
        self.ages: NDArray[np.int64] | None = None
        if variant in folds[0].ages:
            self.ages = np.concatenate([fold.ages[variant] for fold in folds])
        # Who has one fold only is calibrated by the other objects of it.
        groups = self._fold_of if len(folds) > 1 else self._object_of()
        slipped = grasps.slipped[self.rows]
        if len(np.unique(groups)) > 1:
            self.probability = cross_fitted_p_slip(self.margins, slipped, groups)
        else:
            self.probability = p_slip(self.margins)

    def scores(self) -> list[Scores]:
        """Of each fold."""
        made = []
        for fold in np.unique(self._fold_of):
            inside = self._fold_of == fold
            slipped = self._grasps.slipped[self.rows[inside]]
            made.append(score(self.margins[inside], slipped, self.probability[inside]))
        return made

    def _object_of(self) -> NDArray[np.int64]:
        names = np.array([self._grasps.objects[row] for row in self.rows])
        return np.unique(names, return_inverse=True)[1].astype(np.int64)


def _confusion(
    margins: NDArray[np.float64], slipped: NDArray[np.bool_]
) -> tuple[tuple[int, int], tuple[int, int]]:
    verdict = margins > 0.0
    stable, slip = (
        (int((~verdict[slipped == truth]).sum()), int(verdict[slipped == truth].sum()))
        for truth in (False, True)
    )
    return stable, slip


def _by_object(
    margins: NDArray[np.float64], rows: NDArray[np.int64], grasps: Grasps, seeds: int
) -> dict[str, ObjectFigures]:
    names = np.array([grasps.objects[row] for row in rows])
    made = {}
    for name in sorted(set(names.tolist())):
        inside = names == name
        one = score(margins[inside], grasps.slipped[rows[inside]])
        # A grasp that was judged once per seed is one grasp to the interval.
        made[name] = ObjectFigures(wilson(one.accuracy, one.grasps // seeds), one.f1)
    return made


def _by_palm(
    margins: NDArray[np.float64], rows: NDArray[np.int64], grasps: Grasps, seeds: int
) -> dict[str, Fraction]:
    right = (margins > 0.0) == grasps.slipped[rows]
    table_of = grasps.table_of[rows]
    return {
        grasps.files[table].name: wilson(
            float(right[table_of == table].mean()), int((table_of == table).sum()) // seeds
        )
        for table in np.unique(table_of)
    }


def _by_age(
    margins: NDArray[np.float64],
    slipped: NDArray[np.bool_],
    ages: NDArray[np.int64],
    seeds: int,
) -> list[AgeFigures]:
    """In a running session nearly every seed meets other grasps when it is young."""
    group_of = np.searchsorted(AGES, ages, side="right") - 1
    made = []
    for group in np.unique(group_of):
        inside = group_of == group
        right = (margins[inside] > 0.0) == slipped[inside]
        fraction = wilson(float(right.mean()), max(1, len(right) // seeds))
        temperature = fit_temperature(margins[inside], slipped[inside])
        made.append(AgeFigures(AGES[group], fraction, temperature))
    return made
