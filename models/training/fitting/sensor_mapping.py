"""Counts of one session as the sensors of the training would read them."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from models.training.arrays import Floats, Ints, Numbers
from models.training.fitting.novelty import MARGIN_COUNTS, SESSION_MARGIN_COUNTS
from models.training.fitting.standards import Standards, TrainingStandards


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


def _moved(values: Floats, source: Standards, to: Standards) -> Floats:
    flat = (values.reshape(len(values), -1) - source.mean) / source.spread
    moved: Floats = flat * to.spread + to.mean
    return moved.reshape(values.shape)
