"""Study of broken electrodes: their cost in F1, unnoticed and after repair."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from sklearn.metrics import f1_score

from graspd.biotac import COUNT_MAX
from graspd.models.electrodes import BROKEN_MAX, Electrodes
from graspd.models.training.arrays import Bools, Numbers
from graspd.models.training.data.datasets import Grasps
from graspd.models.training.data.protocols import fewest_grasps, fold_seed, folds_of
from graspd.models.training.fitting.trained import Trained, train
from graspd.models.training.systems.registry import System

FOLDS, JUDGED_FOLDS = 10, 3
"""Number of stratified folds, and of folds judged; three show a difference of a few points."""
NUMBERS = (1, 2, 4, 8, 12)
LOOKED_FOR_MAX = BROKEN_MAX + 1
"""Most broken electrodes that a search may find: one more than the daemon repairs."""

Breakage = Callable[[Numbers, np.random.Generator], Numbers]
KINDS: dict[str, Breakage] = {
    "at 0": lambda counts, _: np.zeros_like(counts),
    "at 4095": lambda counts, _: np.full_like(counts, COUNT_MAX),
    "anywhere": lambda counts, random: random.integers(200, 3500, counts.shape).astype(np.uint16),
    "500 too high": lambda counts, _: np.minimum(counts + 500, COUNT_MAX - 1).astype(np.uint16),
}
"""Functions of counts (and a generator) to the counts of broken electrodes, by kind of damage."""


def broken_study(system: System, grasps: Grasps, seed: int) -> dict[str, Any]:
    """Train on folds of the grasps, break electrodes of the held-out grasps, and judge those.

    `grasps` have only the system's fingers. Raises `TooFewGraspsError`.

    Returns `grasps`, the number judged, and F1, 0..1, slip positive: `sound`, as read;
    `sound_repaired`, after a search for broken electrodes repaired what it found, all falsely.
    `false_alarms`: fraction of the grasps so repaired.

    `broken`: a dict for each of `KINDS` (`reads`) and each `number` of electrodes broken at random
    places. F1 `unnoticed`: none repaired; `known`: all of them repaired; `found`: those repaired
    that the search finds. `detected`: fraction of the broken ones that it finds.
    """
    folds = [
        _Fold(system, grasps, out, fold_seed(seed, fold))
        for fold, out in enumerate(left_out(grasps, seed))
    ]
    nothing = [fold.judge(fold.counts) for fold in folds]
    alarms = [fold.find(fold.counts) for fold in folds]
    repaired = [
        fold.judge(fold.repair(fold.counts, found))
        for fold, found in zip(folds, alarms, strict=True)
    ]
    random = np.random.default_rng(seed)
    return {
        "grasps": sum(len(fold.counts) for fold in folds),
        "sound": np.mean(nothing),
        "false_alarms": np.concatenate([found.any(axis=(1, 2)) for found in alarms]).mean(),
        "sound_repaired": np.mean(repaired),
        "broken": [_break(folds, number, reads, random) for reads in KINDS for number in NUMBERS],
    }


def left_out(grasps: Grasps, seed: int) -> list[Bools]:
    """Return for each training a mask of its held-out grasps, shape (N,).

    Raises `TooFewGraspsError` for fewer than two grasps of a label.
    """
    folds = min(FOLDS, max(2, fewest_grasps(grasps)))
    fold_of = folds_of(grasps, folds, seed)
    return [fold_of == fold for fold in range(min(JUDGED_FOLDS, folds))]


class _Fold:
    """A system trained without some grasps, and the held-out grasps."""

    def __init__(self, system: System, grasps: Grasps, left_out: Bools, seed: int) -> None:
        rest = grasps.rows(np.flatnonzero(~left_out).astype(np.int64))
        self.counts = grasps.counts[left_out]
        self._slipped = grasps.slipped[left_out]
        self._table_of = grasps.table_of[left_out]
        self._trained: Trained = train(system, rest, seed)
        self._electrodes = Electrodes(self._trained.seen())

    def judge(self, counts: Numbers) -> float:
        verdict = self._trained.margins(counts, self._table_of) > 0.0
        return float(f1_score(self._slipped, verdict, zero_division=0.0))

    def find(self, counts: Numbers) -> Bools:
        values = self._trained.mapped(counts, self._table_of)
        nothing = np.zeros(counts.shape[1:], dtype=np.bool_)
        return np.array(
            [
                self._electrodes.implausible(
                    self._electrodes.compare(reading), nothing, LOOKED_FOR_MAX
                )
                for reading in values
            ]
        )

    def repair(self, counts: Numbers, broken: Bools) -> Numbers:
        values = self._trained.mapped(counts, self._table_of)
        for index in np.flatnonzero(broken.any(axis=(1, 2))):
            values[index] = self._electrodes.repaired(values[index], broken[index])
        repaired = self._trained.unmapped(values, self._table_of)
        return np.where(broken, np.clip(repaired, 0.0, COUNT_MAX), counts)


def _break(
    folds: list[_Fold], number: int, reads: str, random: np.random.Generator
) -> dict[str, Any]:
    rows = []
    for fold in folds:
        # The `number` electrodes of each reading with the smallest random values are broken.
        order = random.random((len(fold.counts), fold.counts[0].size)).argsort(axis=1)
        where: Bools = (order < number).reshape(fold.counts.shape)
        counts = np.where(where, KINDS[reads](fold.counts, random), fold.counts)
        marked = fold.find(counts)
        rows.append(
            {
                "unnoticed": fold.judge(counts),
                "known": fold.judge(fold.repair(counts, where)),
                "found": fold.judge(fold.repair(counts, marked)),
                "detected": (marked & where).sum() / where.sum(),
            }
        )
    means = {name: np.mean([row[name] for row in rows]) for name in rows[0]}
    return {"number": number, "reads": reads, **means}
