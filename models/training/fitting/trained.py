"""A system trained on tables, that judges counts: what a model file is made from."""

from __future__ import annotations

from dataclasses import dataclass

from models.contract import SeenCounts
from models.inputs import builder, raw_features
from models.training.arrays import Floats, Floats32, Ints, Numbers
from models.training.data.datasets import Grasps
from models.training.fitting.fit import Fitted, fit
from models.training.fitting.novelty import seen_counts
from models.training.fitting.sensor_mapping import SensorMapping
from models.training.fitting.standards import TrainingStandards
from models.training.systems.system import SessionFeatures, System, with_recipes


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
    """The system trained on these grasps, which have its fingers alone, on one thread.

    Raises `ValueError` if they are too few.
    """
    counts, table_of = grasps.counts, grasps.table_of
    session = isinstance(system.input, SessionFeatures)
    standards = TrainingStandards.of(raw_features(counts), table_of) if session else None
    inputs = _inputs(system, standards, counts, table_of)
    fitted = fit(with_recipes(system, threads=1), inputs, grasps.slipped, seed=seed)
    sensors = SensorMapping.of(counts, table_of, session=session)
    return Trained(system, fitted, grasps, sensors, standards)


def _inputs(
    system: System, standards: TrainingStandards | None, counts: Numbers, table_of: Ints
) -> Floats32:
    if isinstance(system.input, SessionFeatures):
        if standards is None:
            raise ValueError("a session system needs standards")
        return standards.apply(raw_features(counts), table_of, system.input.clip)
    return builder(system.input, len(system.fingers)).build_batch(counts)[0]
