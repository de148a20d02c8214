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
class Trained:
    """A system with its training data."""

    system: System
    fitted: Fitted
    grasps: Grasps
    standards: TrainingStandards | None
    """Standards of a session system's features; None for other systems."""
    sensors: TrainingStandards | None
    """Standards of the counts (fingers * 24,) for a session system, to map tables to `prior`."""

    def margins(self, counts: Numbers, table_of: Ints) -> Floats:
        """Return uncalibrated log-odds of slip (N,) of counts (N, fingers, 24) and tables (N,)."""
        return self.fitted.margins(_inputs(self.system, self.standards, counts, table_of))

    def mapped(self, counts: Numbers, table_of: Ints) -> Floats:
        """Return counts (N, fingers, 24) of tables (N,) as the training's sensors would read them.

        Each table is mapped by its own mean and spread, as the daemon maps a session. A model
        without a session takes the counts unchanged.
        """
        values = counts.astype(np.float64)
        if self.sensors is None:
            return values
        return _moved(values, self.sensors.each(table_of), self.sensors.prior)

    def unmapped(self, values: Floats, table_of: Ints) -> Floats:
        """Return the inverse of `mapped`."""
        if self.sensors is None:
            return values
        return _moved(values, self.sensors.prior, self.sensors.each(table_of))

    @property
    def margin(self) -> int:
        """Counts outside the training range that still pass as seen."""
        return MARGIN_COUNTS if self.sensors is None else SESSION_MARGIN_COUNTS

    def seen(self) -> SeenCounts:
        """Description of the training counts, to find readings unlike them."""
        return seen_counts(self.mapped(self.grasps.counts, self.grasps.table_of), self.margin)


def train(system: System, grasps: Grasps, seed: int) -> Trained:
    """Train a system on grasps with only its fingers, on one thread.

    Raises `ValueError` if they are too few.
    """
    counts, table_of = grasps.counts, grasps.table_of
    session = isinstance(system.input, SessionFeatures)
    standards = TrainingStandards.of(raw_features(counts), table_of) if session else None
    inputs = _inputs(system, standards, counts, table_of)
    fitted = fit(system, inputs, grasps.slipped, seed=seed)
    sensors = sensor_standards(counts, table_of) if session else None
    return Trained(system, fitted, grasps, standards, sensors)


def sensor_standards(counts: Numbers, table_of: Ints) -> TrainingStandards:
    """Return the standards of counts (N, fingers, 24); the prior is the mean of the tables."""
    tables = TrainingStandards.of(counts.reshape(len(counts), -1).astype(np.float64), table_of)
    centre = np.mean([table.mean for table in tables.tables.values()], axis=0)
    return replace(tables, prior=Standards(centre, tables.prior.spread))


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
