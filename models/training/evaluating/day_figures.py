"""Figures of verdicts on another day, such as the share of slips among `stable` ones."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from sklearn.metrics import f1_score

from graspd.models.bts3 import NEW_SESSION, WHOLE
from graspd.models.training.arrays import Bools
from graspd.models.training.data.datasets import Grasps
from graspd.models.training.data.protocols import DAYS
from graspd.models.training.evaluating.jobs import JobResult

A, B_DOWN, B_SIDE = f"A {NEW_SESSION}", f"B {WHOLE[0]}", f"B {WHOLE[1]}"
C_DOWN, C_SIDE = f"C {WHOLE[0]}", f"C {WHOLE[1]}"
GROUPS = {name: (name,) for name in (A, B_DOWN, B_SIDE, C_DOWN, C_SIDE)} | {
    "A and C": (A, C_DOWN, C_SIDE),
    "all": (A, B_DOWN, B_SIDE, C_DOWN, C_SIDE),
}
"""By name: the streams, each `A`, `B` or `C` and the table that is judged."""


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


def day_figures(
    variant: str, folds: Sequence[Sequence[JobResult]], grasps: Grasps
) -> dict[str, DayFigures]:
    """Return the figures by group of streams. `folds`: results of `days` for each seed."""
    parts: dict[str, list[JobResult]] = {}
    for results in folds:
        for index, result in enumerate(results):
            parts.setdefault(DAYS[index * len(DAYS) // len(results)][0], []).append(result)
    streams = {}
    for day, results in parts.items():
        test = np.concatenate([result.test for result in results])
        slip = np.concatenate([result.margins[variant] for result in results]) > 0.0
        refused = np.concatenate([result.refused[variant] for result in results])
        for table in np.unique(grasps.table_of[test]):
            inside = grasps.table_of[test] == table
            name = f"{day} {grasps.files[table].name}"
            streams[name] = slip[inside], grasps.slipped[test][inside], refused[inside]
    made = {}
    for group, names in GROUPS.items():
        several = [streams[name] for name in names]
        slip, slipped, refused = (np.concatenate(columns) for columns in zip(*several, strict=True))
        made[group] = DayFigures(
            VerdictFigures.of(slip, slipped),
            VerdictFigures.of(slip[~refused], slipped[~refused]),
            float(1.0 - refused.mean()),
            _share(slipped & refused, refused),
        )
    return made


def _share(some: Bools, of: Bools) -> float | None:
    return float(some.sum() / of.sum()) if of.any() else None
