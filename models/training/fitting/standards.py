"""By what a session model's features are standardised: in training, and when it is judged."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from graspd.models.session_statistics import SessionStatistics
from graspd.models.training.arrays import Floats, Floats32, Ints

PRIOR_GRASPS = 1.0
"""Weight of the training's statistics in a new session, grasps."""
NONE, TRAINING, ALL = "none", "training", "all"
"""Variants: not calibrated; by the training rows of the same table; by the whole pool."""
RUNNING, RUNNING_SORTED = "running", "running-sorted"
"""Variants: each grasp by what came before it, from nothing; objects mixed, or one by one."""
DRAWS = (5, 10, 20, 50)
"""Variants `n5` ...: calibrated by 5 ... grasps of the pool, drawn at random."""
SESSION_VARIANTS = (NONE, *(f"n{number}" for number in DRAWS), ALL, RUNNING, RUNNING_SORTED)


@dataclass(frozen=True, slots=True, eq=False)
class Standards:
    """Mean and spread of features, each of shape (M,) or, one per grasp, (N, M)."""

    mean: Floats
    spread: Floats
    """Above zero."""

    @classmethod
    def of(cls, features: Floats) -> Standards:
        """Of features (N, M). The spread of one that does not vary is 1."""
        return cls(features.mean(axis=0), _positive(features.std(axis=0)))

    def apply(self, features: Floats, clip: float) -> Floats32:
        """Features (N, M) standardised and cut off at +-`clip`, as `SessionBuilder` does."""
        standard: Floats = (features - self.mean) * (1.0 / self.spread)
        return np.clip(standard, -clip, clip).astype(np.float32)


@dataclass(frozen=True, slots=True, eq=False)
class TrainingStandards:
    """Statistics of the training rows of each table; a table stands for a session."""

    tables: dict[int, Standards]
    """By index of the table."""
    prior: Standards
    """Mean of all rows, and spread within a table: where a new session starts from."""

    @classmethod
    def of(cls, features: Floats, table_of: Ints) -> TrainingStandards:
        """Of training features (N, M) and the tables (N,) that they are from."""
        tables, within = {}, np.empty_like(features)
        for table in np.unique(table_of):
            inside = table_of == table
            tables[int(table)] = Standards.of(features[inside])
            within[inside] = features[inside] - tables[int(table)].mean
        spread = _positive(np.sqrt((within**2).mean(axis=0)))
        return cls(tables, Standards(features.mean(axis=0), spread))

    def each(self, table_of: Ints) -> Standards:
        """Of shape (N, M): each grasp's by its table (N,). Raises `KeyError` for an unknown one."""
        standards = [self.tables[int(table)] for table in table_of]
        return Standards(
            np.stack([one.mean for one in standards]), np.stack([one.spread for one in standards])
        )

    def statistics(self) -> SessionStatistics:
        """Those of a new session."""
        return SessionStatistics(self.prior.mean, self.prior.spread, PRIOR_GRASPS)


def later_session(
    features: Floats, test: Ints, pool: Ints, training: TrainingStandards, seed: int
) -> tuple[dict[str, Standards], dict[str, Ints]]:
    """Return standards of the rows `test` of features (all grasps, M), by variant.

    And, of the running variants, the grasps (N,) that were seen before each test grasp.
    Only the rows `pool` calibrate `n5` ... and `all`; in a running session every grasp counts
    once it was judged. Labels are not used.
    """
    random = np.random.default_rng(seed)
    standards = {NONE: training.prior, ALL: Standards.of(features[pool])}
    for number in DRAWS:
        statistics = training.statistics()
        for row in random.permutation(pool)[:number]:
            statistics.observe(features[row])
        standards[f"n{number}"] = Standards(statistics.mean, statistics.spread)
    ages: dict[str, Ints] = {}
    session = np.sort(np.concatenate((test, pool)))
    for variant, order in ((RUNNING, random.permutation(session)), (RUNNING_SORTED, session)):
        standards[variant], ages[variant] = _running(features, order, test, training)
    return standards, ages


def _running(
    features: Floats, order: Ints, test: Ints, training: TrainingStandards
) -> tuple[Standards, Ints]:
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


def _positive(spread: Floats) -> Floats:
    return np.where(spread > 0.0, spread, 1.0)
