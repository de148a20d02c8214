"""By what a session model's features are standardised: in training, and when it is judged."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from models.session_statistics import SessionStatistics

PRIOR_GRASPS = 1.0
"""Weight of the training's statistics in a new session, grasps."""
NONE, TRAINING, ALL = "none", "training", "all"
"""Variants: nothing calibrated; by the training rows of one's own table; by the whole pool."""
RUNNING, RUNNING_SORTED = "running", "running-sorted"
"""Variants: each grasp by what came before it, from nothing; objects mixed, or one by one."""
DRAWS = (5, 10, 20, 50)
"""Variants `n5` ...: by so many grasps of the pool, drawn at random."""
SESSION_VARIANTS = (NONE, *(f"n{number}" for number in DRAWS), ALL, RUNNING, RUNNING_SORTED)


@dataclass(frozen=True, slots=True, eq=False)
class Standards:
    """Mean and spread of features, each of shape (M,) or, one per grasp, (N, M)."""

    mean: NDArray[np.float64]
    spread: NDArray[np.float64]

    @classmethod
    def of(cls, features: NDArray[np.float64]) -> Standards:
        """Of features (N, M). What does not vary keeps its unit."""
        spread = features.std(axis=0)
        return cls(features.mean(axis=0), np.where(spread > 0.0, spread, 1.0))

    def apply(self, features: NDArray[np.float64], clip: float) -> NDArray[np.float32]:
        """Standardised and clipped features (N, M), as `SessionBuilder` makes them."""
        standard: NDArray[np.float64] = (features - self.mean) * (1.0 / self.spread)
        return np.clip(standard, -clip, clip).astype(np.float32)


@dataclass(frozen=True, slots=True, eq=False)
class TrainingStandards:
    """Statistics of the training rows of each table, which stands for a session."""

    tables: dict[int, Standards]
    """By index of the table."""
    prior: Standards
    """Mean of all rows, and spread within a table: where a new session starts from."""

    @classmethod
    def of(cls, features: NDArray[np.float64], table_of: NDArray[np.int64]) -> TrainingStandards:
        """Of training features (N, M) and their tables (N,)."""
        tables = {
            int(table): Standards.of(features[table_of == table]) for table in np.unique(table_of)
        }
        within = features - _each(tables, table_of).mean
        spread = np.sqrt((within**2).mean(axis=0))
        spread = np.where(spread > 0.0, spread, 1.0)
        return cls(tables, Standards(features.mean(axis=0), spread))

    def apply(
        self, features: NDArray[np.float64], table_of: NDArray[np.int64], clip: float
    ) -> NDArray[np.float32]:
        """Features (N, M), each standardised by its own table. Raises `KeyError` for a new one."""
        return _each(self.tables, table_of).apply(features, clip)

    def each(self, table_of: NDArray[np.int64]) -> Standards:
        """Of each grasp (N,), by its table. Raises `KeyError` for a new one."""
        return _each(self.tables, table_of)

    def statistics(self, prior_grasps: float = PRIOR_GRASPS) -> SessionStatistics:
        """A session that starts here."""
        return SessionStatistics(self.prior.mean, self.prior.spread, prior_grasps)


@dataclass(frozen=True, slots=True, eq=False)
class Sitting:
    """A later session as it is judged: standards of its test grasps, by variant."""

    standards: dict[str, Standards]
    ages: dict[str, NDArray[np.int64]]
    """Of the running variants, shape (N,): grasps seen before each test grasp."""


def sit(
    features: NDArray[np.float64],
    test: NDArray[np.int64],
    pool: NDArray[np.int64],
    training: TrainingStandards,
    seed: int,
) -> Sitting:
    """All variants of judging the test rows of features (all grasps, M).

    Only the rows of the pool calibrate `n5` ... and `all`; in a running session every grasp counts
    after it was judged. No label is looked at.
    """
    random = np.random.default_rng(seed)
    standards = {NONE: training.prior, ALL: Standards.of(features[pool])}
    for number in DRAWS:
        drawn = random.permutation(pool)[:number]
        standards[f"n{number}"] = _after(features[drawn], training)
    ages = {}
    session = np.sort(np.concatenate((test, pool)))
    for variant, order in ((RUNNING, random.permutation(session)), (RUNNING_SORTED, session)):
        standards[variant], ages[variant] = _running(features, order, test, training)
    return Sitting(standards, ages)


def _after(features: NDArray[np.float64], training: TrainingStandards) -> Standards:
    statistics = training.statistics()
    for row in features:
        statistics.observe(row)
    return Standards(statistics.mean, statistics.spread)


def _running(
    features: NDArray[np.float64],
    order: NDArray[np.int64],
    test: NDArray[np.int64],
    training: TrainingStandards,
) -> tuple[Standards, NDArray[np.int64]]:
    """Standards (len(test), M) and ages (len(test),) at the moment each test row comes."""
    place = {int(row): index for index, row in enumerate(test)}
    statistics = training.statistics()
    mean = np.empty((len(test), features.shape[1]))
    spread, ages = np.empty_like(mean), np.empty(len(test), dtype=np.int64)
    for row in order:
        index = place.get(int(row))
        if index is not None:
            mean[index], spread[index] = statistics.mean, statistics.spread
            ages[index] = statistics.grasps
        statistics.observe(features[row])
    return Standards(mean, spread), ages


def _each(tables: dict[int, Standards], table_of: NDArray[np.int64]) -> Standards:
    return Standards(
        np.stack([tables[int(table)].mean for table in table_of]),
        np.stack([tables[int(table)].spread for table in table_of]),
    )
