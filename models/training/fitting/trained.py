"""A trained system that judges counts; model files are made from it."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from graspd.models.contract import SeenCounts
from graspd.models.inputs import builder, raw_features
from graspd.models.training.arrays import Floats, Floats32, Ints, Numbers
from graspd.models.training.data.datasets import Grasps
from graspd.models.training.fitting.fit import Fitted, fit
from graspd.models.training.fitting.novelty import MARGIN_COUNTS, SESSION_MARGIN_COUNTS, seen_counts
from graspd.models.training.fitting.standards import Standards, TrainingStandards
from graspd.models.training.systems.system import SessionFeatures, System


@dataclass(frozen=True, slots=True, eq=False)
class SensorMapping:
    """Map the counts of each table's sensors to the training's sensors, and back.

    Each table is mapped by its own mean and spread, as the daemon maps a session. A model without a
    session takes the counts unchanged.
    """

    margin: int
    """Counts outside the training range that still pass as seen."""
    tables: TrainingStandards | None = None
    """Standards of the counts (fingers * 24,) of each table; all tables map to `prior`."""

    @classmethod
    def of(cls, counts: Numbers, table_of: Ints, *, session: bool) -> SensorMapping:
        """Return the mapping of training counts (N, fingers, 24), by their tables (N,)."""
        if not session:
            return cls(MARGIN_COUNTS)
        tables = TrainingStandards.of(counts.reshape(len(counts), -1).astype(np.float64), table_of)
        centre = np.mean([table.mean for table in tables.tables.values()], axis=0)
        prior = Standards(centre, tables.prior.spread)
        return cls(SESSION_MARGIN_COUNTS, replace(tables, prior=prior))

    def to_training(self, counts: Numbers, table_of: Ints) -> Floats:
        """Return counts (N, fingers, 24) of tables (N,) as read by the training's sensors."""
        values = counts.astype(np.float64)
        if self.tables is None:
            return values
        return _moved(values, self.tables.each(table_of), self.tables.prior)

    def from_training(self, values: Floats, table_of: Ints) -> Floats:
        """Return the inverse of `to_training`."""
        if self.tables is None:
            return values
        return _moved(values, self.tables.prior, self.tables.each(table_of))


@dataclass(frozen=True, slots=True, eq=False)
class Trained:
    """A system with its training data."""

    system: System
    fitted: Fitted
    grasps: Grasps
    sensors: SensorMapping
    standards: TrainingStandards | None
    """Standards of a session system's features; None for other systems."""

    def margins(self, counts: Numbers, table_of: Ints) -> Floats:
        """Return uncalibrated log-odds of slip (N,) of counts (N, fingers, 24) and tables (N,)."""
        return self.fitted.margins(_inputs(self.system, self.standards, counts, table_of))

    def mapped_counts(self) -> Floats:
        """Counts (N, fingers, 24) of `grasps`, of a session system mapped to common sensors."""
        return self.sensors.to_training(self.grasps.counts, self.grasps.table_of)

    def seen(self) -> SeenCounts:
        """Description of the training counts, to find readings unlike them."""
        return seen_counts(self.mapped_counts(), self.sensors.margin)


def train(system: System, grasps: Grasps, seed: int) -> Trained:
    """Train a system on grasps with only its fingers, on one thread.

    Raises `ValueError` if they are too few.
    """
    counts, table_of = grasps.counts, grasps.table_of
    session = isinstance(system.input, SessionFeatures)
    standards = TrainingStandards.of(raw_features(counts), table_of) if session else None
    inputs = _inputs(system, standards, counts, table_of)
    fitted = fit(system, inputs, grasps.slipped, seed=seed)
    sensors = SensorMapping.of(counts, table_of, session=session)
    return Trained(system, fitted, grasps, sensors, standards)


def _inputs(
    system: System, standards: TrainingStandards | None, counts: Numbers, table_of: Ints
) -> Floats32:
    if isinstance(system.input, SessionFeatures):
        if standards is None:
            raise ValueError("a session system needs standards")
        return standards.each(table_of).apply(raw_features(counts), system.input.clip)
    return builder(system.input, len(system.fingers)).build_batch(counts)[0]


def _moved(values: Floats, source: Standards, to: Standards) -> Floats:
    flat = (values.reshape(len(values), -1) - source.mean) / source.spread
    moved: Floats = flat * to.spread + to.mean
    return moved.reshape(values.shape)
