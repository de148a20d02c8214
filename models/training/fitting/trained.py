"""A system trained on tables, that judges counts: what a model file is made from."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from models.inputs import builder, raw_features
from models.training.data.datasets import Grasps
from models.training.fitting.fitting import Fitted, fit
from models.training.fitting.looks import Looks
from models.training.fitting.standards import TrainingStandards
from models.training.systems.system import SessionFeatures, System, with_recipes


@dataclass(frozen=True, slots=True, eq=False)
class Trained:
    """A system and what it was trained on."""

    system: System
    fitted: Fitted
    grasps: Grasps
    looks: Looks
    standards: TrainingStandards | None
    """Of a session system."""

    def margins(
        self, counts: NDArray[np.generic], table_of: NDArray[np.int64]
    ) -> NDArray[np.float64]:
        """Log-odds of slip (N,), uncalibrated, of counts (N, fingers, 24) of known tables (N,)."""
        return self.fitted.margins(_inputs(self.system, self.standards, counts, table_of))


def train(system: System, grasps: Grasps, seed: int) -> Trained:
    """The system trained on these grasps, of its fingers alone, on one thread.

    Raises `ValueError` for too few.
    """
    counts, table_of = grasps.counts, grasps.table_of
    session = isinstance(system.input, SessionFeatures)
    standards = TrainingStandards.of(raw_features(counts), table_of) if session else None
    inputs = _inputs(system, standards, counts, table_of)
    fitted = fit(with_recipes(system, threads=1), inputs, grasps.slipped, seed=seed)
    looks = Looks.of(counts, table_of, session=session)
    return Trained(system, fitted, grasps, looks, standards)


def _inputs(
    system: System,
    standards: TrainingStandards | None,
    counts: NDArray[np.generic],
    table_of: NDArray[np.int64],
) -> NDArray[np.float32]:
    if isinstance(system.input, SessionFeatures):
        if standards is None:
            raise ValueError("a session system needs standards")
        return standards.apply(raw_features(counts), table_of, system.input.clip)
    return builder(system.input, len(system.fingers)).build_batch(counts)[0]
