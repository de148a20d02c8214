"""A system trained on tables, that judges counts: what a model file is made from."""

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
    """From the counts of each table's sensors to those of the training's, and back.

    As the daemon maps a session's counts: each table by its own mean and spread. A model without
    session calibration takes the counts as they are.
    """

    margin: int
    """Counts outside of the training range that are still taken for seen."""
    tables: TrainingStandards | None = None
    """Of the counts (fingers * 24,) of each table; every table is mapped to `prior`."""

    @classmethod
    def of(cls, counts: Numbers, table_of: Ints, *, session: bool) -> SensorMapping:
        """Of training counts (N, fingers, 24) and the tables (N,) that they are from."""
        if not session:
            return cls(MARGIN_COUNTS)
        tables = TrainingStandards.of(counts.reshape(len(counts), -1).astype(np.float64), table_of)
        centre = np.mean([table.mean for table in tables.tables.values()], axis=0)
        prior = Standards(centre, tables.prior.spread)
        return cls(SESSION_MARGIN_COUNTS, replace(tables, prior=prior))

    def to_training(self, counts: Numbers, table_of: Ints) -> Floats:
        """Counts (N, fingers, 24) of these tables (N,) as the training's sensors would read."""
        values = counts.astype(np.float64)
        if self.tables is None:
            return values
        return _moved(values, self.tables.each(table_of), self.tables.prior)

    def from_training(self, values: Floats, table_of: Ints) -> Floats:
        """The inverse of `to_training`."""
        if self.tables is None:
            return values
        return _moved(values, self.tables.prior, self.tables.each(table_of))


@dataclass(frozen=True, slots=True, eq=False)
class Trained:
    """A system and what it was trained on."""

    system: System
    fitted: Fitted
    grasps: Grasps
    sensors: SensorMapping
    standards: TrainingStandards | None
    """Of a session system's features."""

    def margins(self, counts: Numbers, table_of: Ints) -> Floats:
        """Log-odds of slip (N,), uncalibrated, of counts (N, fingers, 24) of known tables (N,)."""
        return self.fitted.margins(_inputs(self.system, self.standards, counts, table_of))

    def mapped_counts(self) -> Floats:
        """Counts (N, fingers, 24) of `grasps`, of a session system mapped to common sensors."""
        return self.sensors.to_training(self.grasps.counts, self.grasps.table_of)

    def seen(self) -> SeenCounts:
        """What the training counts look like, for the check of a reading's novelty."""
        return seen_counts(self.mapped_counts(), self.sensors.margin)


def train(system: System, grasps: Grasps, seed: int) -> Trained:
    """Train a system on these grasps, which have its fingers alone, on one thread.
    Raises `ValueError` if they are too few."""
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
