"""Mean and spread that standardise a session model's features, in training and evaluation."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from graspd.models.session_statistics import SessionStatistics
from graspd.models.training.arrays import Floats, Floats32, Ints

PRIOR_GRASPS = 1.0
"""Weight of the training's statistics in a new session, grasps."""
CALIBRATED_FROM = 20.0
"""Number of grasps from which on a session counts as calibrated; more gain at most two points."""


class Variant(StrEnum):
    """Grasps whose mean and spread standardise the features of a judged grasp."""

    NONE = "none"
    """All training grasps, but not the judged session; also used without a session model."""
    N5 = "n5"
    """Five unlabelled grasps of the judged session, of other objects, drawn at random."""
    N10 = "n10"
    N20 = "n20"
    N50 = "n50"
    ALL = "all"
    """All grasps of the judged session that are of other objects."""
    RUNNING = "running"
    """The grasps of the session judged before, from an empty start; objects are mixed."""
    RUNNING_SORTED = "running-sorted"
    """As `RUNNING`, but one object after the other."""
    TRAINING = "training"
    """The training grasps of the judged grasp's own table."""


SESSION_VARIANTS = tuple(variant for variant in Variant if variant != Variant.TRAINING)
"""Variants of the protocol `session`."""
DRAWN = {Variant.N5: 5, Variant.N10: 10, Variant.N20: 20, Variant.N50: 50}
"""Number of grasps that are drawn, by variant."""


@dataclass(frozen=True, slots=True, eq=False)
class Standards:
    """Mean and spread of features, each of shape (M,) or, one per grasp, (N, M)."""

    mean: Floats
    spread: Floats
    """Spread, above zero."""

    @classmethod
    def of(cls, features: Floats) -> Standards:
        """Return mean and spread of features (N, M); a constant feature has spread 1."""
        return cls(features.mean(axis=0), _positive(features.std(axis=0)))

    def apply(self, features: Floats, clip: float) -> Floats32:
        """Return features (N, M) standardised and clipped, as by `SessionBuilder`."""
        standard: Floats = (features - self.mean) * (1.0 / self.spread)
        return np.clip(standard, -clip, clip).astype(np.float32)


@dataclass(frozen=True, slots=True, eq=False)
class TrainingStandards:
    """Mean and spread of the training rows of each table; each table counts as a session."""

    tables: dict[int, Standards]
    """Standards of each table by its index."""
    prior: Standards
    """Standards at the start of a new session: mean of all rows, spread within a table."""

    @classmethod
    def of(cls, features: Floats, table_of: Ints) -> TrainingStandards:
        """Return the standards of training features (N, M), by their tables (N,)."""
        tables, within = {}, np.empty_like(features)
        for table in np.unique(table_of):
            inside = table_of == table
            tables[int(table)] = Standards.of(features[inside])
            within[inside] = features[inside] - tables[int(table)].mean
        spread = _positive(np.sqrt((within**2).mean(axis=0)))
        return cls(tables, Standards(features.mean(axis=0), spread))

    def each(self, table_of: Ints) -> Standards:
        """Return each grasp's standards by its table (N,), shape (N, M).

        Raises `KeyError` for a table without training rows.
        """
        standards = [self.tables[int(table)] for table in table_of]
        return Standards(
            np.stack([one.mean for one in standards]), np.stack([one.spread for one in standards])
        )

    def statistics(self) -> SessionStatistics:
        """Return the statistics of a new session."""
        return SessionStatistics(self.prior.mean, self.prior.spread, PRIOR_GRASPS)


def later_session(
    features: Floats, test: Ints, pool: Ints, training: TrainingStandards, seed: int
) -> tuple[dict[Variant, Standards], dict[Variant, Ints]]:
    """Return standards for the rows `test` of features (all grasps, M), by variant.

    The second result has, for running variants, the number of grasps before each test grasp (N,).
    `pool`: rows of the session from which the other variants draw. `NONE` uses training alone.
    """
    random = np.random.default_rng(seed)
    standards = {Variant.NONE: training.prior, Variant.ALL: Standards.of(features[pool])}
    for variant, number in DRAWN.items():
        statistics = training.statistics()
        for row in random.permutation(pool)[:number]:
            statistics.observe(features[row])
        standards[variant] = Standards(statistics.mean, statistics.spread)
    ages: dict[Variant, Ints] = {}
    session = np.sort(np.concatenate((test, pool)))
    mixed = random.permutation(session)
    for variant, order in ((Variant.RUNNING, mixed), (Variant.RUNNING_SORTED, session)):
        standards[variant], ages[variant] = _running(features, order, test, training)
    return standards, ages


def _running(
    features: Floats, order: Ints, test: Ints, training: TrainingStandards
) -> tuple[Standards, Ints]:
    """Return standards (len(test), M), and the session's age in grasps (len(test),), at each test
    row."""
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
