"""Figures of a system in a protocol, computed from rows that are kept as Parquet."""

from __future__ import annotations

import importlib.metadata
import logging
import os
import platform
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from graspd.models.training.data.protocols import DAYS, PROTOCOLS, EvalProtocol
from graspd.models.training.evaluating import metrics
from graspd.models.training.evaluating.files import replacing
from graspd.models.training.fitting.standards import Variant

SCORED = ("margin", "slipped", "probability")
COVERAGES = (0.9, 0.8, 0.5)
AGES = (0, 5, 10, 20, 50, 100, 300)
"""Limits of the groups of grasps by the age of a running session, grasps."""
LIBRARIES = ("numpy", "scikit-learn", "torch")
STREAMS = [f"{day} {table}" for day, _, judged in DAYS for table in judged]
"""Names of the streams of `days`: `A`, `B` or `C`, and the judged table."""
GROUPS = {
    **{name: [name] for name in STREAMS},
    "A and C": [name for name in STREAMS if not name.startswith("B")],
    "all": STREAMS,
}
"""Streams that are counted together, by the name of the group."""

_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True, eq=False)
class Figures:
    """A system in one protocol: its rows, with probabilities, and their figures."""

    rows: pd.DataFrame
    scores: pd.DataFrame
    """Figures (columns) of each variant, seed and fold (rows)."""

    @classmethod
    def of(cls, rows: pd.DataFrame) -> Figures:
        """Score the rows of all folds of all seeds, for each variant, seed and fold."""
        scores = {
            key: metrics.score(*(part[name].to_numpy() for name in SCORED))
            for key, part in rows.groupby(["variant", "seed", "fold"], sort=False)
        }
        table = pd.DataFrame.from_dict(scores, orient="index")
        return cls(rows, table.rename_axis(["variant", "seed", "fold"]))

    @property
    def system(self) -> str:
        """Name of the system."""
        return str(self.rows["system"].iloc[0])

    @property
    def protocol(self) -> EvalProtocol:
        """Name of the protocol."""
        protocol: EvalProtocol = self.rows["protocol"].iloc[0]
        return protocol

    @property
    def variants(self) -> list[str]:
        """Variants of session calibration in the rows, in the order in which they were judged."""
        return list(self.rows["variant"].unique())

    @property
    def headline(self) -> str:
        """Variant whose figures are quoted for the system.

        It is `n50`, calibrated by 50 unlabelled grasps, if the rows have it; else the first.
        """
        return Variant.N50 if Variant.N50 in self.variants else self.variants[0]

    @property
    def trainings(self) -> pd.DataFrame:
        """Table with a row for each training."""
        return self.rows.drop_duplicates(["seed", "fold"])

    @property
    def seeds(self) -> list[int]:
        """Seeds of the splits."""
        return list(self.rows["seed"].unique())

    @property
    def folds(self) -> int:
        """Number of folds, which is the number of trainings of a seed."""
        return int(self.rows["fold"].nunique())

    @property
    def test_grasps(self) -> float:
        """Number of grasps that test a training, mean over the trainings."""
        return len(self.of_variant()) / len(self.trainings)

    @property
    def parameters(self) -> int:
        """Number of parameters of a trained system, mean over the trainings."""
        return round(float(self.trainings["parameters"].mean()))

    def of_variant(self, variant: str | None = None) -> pd.DataFrame:
        """Return the rows of a variant; None: of the quoted one."""
        return self.rows[self.rows["variant"] == (variant or self.headline)]

    def folds_of(self, figure: str, variant: str | None = None) -> pd.DataFrame:
        """Return a figure of a variant: a row for each seed, a column for each fold."""
        return self.scores[figure].unstack("fold").loc[variant or self.headline]

    def spread(self, figure: str = "f1", variant: str | None = None) -> metrics.Spread:
        """Return mean and spread of a figure of a variant."""
        return metrics.over_seeds(self.folds_of(figure, variant).to_numpy())

    def accuracy_at(self, coverage: float) -> float:
        """Return the accuracy of the most confident verdicts, a share `coverage` of all grasps."""
        rows = self.of_variant()
        return metrics.accuracy_at(rows["probability"], rows["slipped"], coverage)


def with_probability(rows: pd.DataFrame) -> pd.DataFrame:
    """Return the rows of a system in a protocol with `probability`, calibrated by other folds."""
    parts = [
        metrics.cross_fitted(part) for _, part in rows.groupby(["seed", "variant"], sort=False)
    ]
    return rows.assign(probability=pd.concat(parts))


def temperature(rows: pd.DataFrame) -> float:
    """Return the temperature fitted to the margins of all these rows together."""
    return metrics.fit_temperature(rows["margin"].to_numpy(), rows["slipped"].to_numpy())


def right(rows: pd.DataFrame) -> pd.Series:
    """Return for each row True if its verdict is right."""
    return (rows["margin"] > 0.0) == rows["slipped"]


def by_age(rows: pd.DataFrame) -> dict[int, pd.DataFrame]:
    """Return the rows of a running variant by the age of its session, the youngest first.

    A key is one of `AGES`: its rows are of sessions from this age to below the next of `AGES`.
    """
    group_of = np.searchsorted(AGES, rows["age"].to_numpy(np.int64), side="right") - 1
    return {AGES[group]: part for group, part in rows.groupby(group_of)}


def by_day(rows: pd.DataFrame) -> dict[str, dict[str, Any]]:
    """Return the figures of a variant of `days` by group of streams.

    `every`: `verdict_figures` of all grasps, also of those that the daemon would refuse; `judged`:
    of the rest; `coverage`: the rest as a fraction of all; `refused_slipped`: fraction of slips
    among the refused; None: no refused.
    """
    streams = rows["fold_name"].str[0] + " " + rows["table"]
    made = {}
    for group, names in GROUPS.items():
        every = rows[streams.isin(names)]
        refused = every["refused"].astype(bool)
        judged, out = every[~refused], every[refused]
        made[group] = {
            "every": metrics.verdict_figures(every),
            "judged": metrics.verdict_figures(judged),
            "coverage": float(1.0 - refused.mean()),
            "refused_slipped": float(out["slipped"].mean()) if len(out) else None,
        }
    return made


def write(figures: Figures, folder: Path) -> None:
    """Keep the rows as `SYSTEM.PROTOCOL.parquet` in the folder. Raises `OSError`."""
    folder.mkdir(parents=True, exist_ok=True)
    with replacing(folder / f"{figures.system}.{figures.protocol}.parquet") as part:
        figures.rows.to_parquet(part, index=False)


def read(folder: Path, data: str, digests: Mapping[str, str]) -> list[Figures]:
    """Return the figures in the folder's files that belong to `data`, by system and protocol.

    `data`: digest of the grasps. `digests`: digest of each system by name, in order. A file of
    another configuration, or one that cannot be read, is left out with a warning.
    """
    found = []
    for path in sorted(folder.glob("*.parquet")):
        try:
            rows = pd.read_parquet(path)
            causes = set(zip(rows["data"], rows["digest"], rows["system"], strict=True))
            if causes != {(data, digests.get(rows["system"].iloc[0]), rows["system"].iloc[0])}:
                raise ValueError("it is of other data or another configuration")
        except (ValueError, KeyError, OSError) as error:
            _log.warning("%s is left out: %s", path, error)
            continue
        found.append(Figures.of(rows))
    systems = list(digests)
    return sorted(found, key=lambda one: (systems.index(one.system), PROTOCOLS.index(one.protocol)))


def made_with(libraries: Sequence[str] = LIBRARIES) -> dict[str, str]:
    """Return machine, Python and versions of libraries, on which the last digits depend."""
    versions = {name: importlib.metadata.version(name) for name in libraries}
    machine = f"{platform.machine()}, {os.cpu_count()} cores"
    return {"machine": machine, "python": platform.python_version(), **versions}
