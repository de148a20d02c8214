"""Training counts as the checks of a reading see them: a session's sensors mapped to the mean."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from models.training.fitting.seen import MARGIN_COUNTS, SESSION_MARGIN_COUNTS
from models.training.fitting.standards import TrainingStandards


@dataclass(frozen=True, slots=True, eq=False)
class Looks:
    """From the counts of each table's sensors to those of the training's, and back.

    As the daemon maps a session's counts: each table by its own mean and spread. A model without
    session calibration takes the counts as they are.
    """

    margin: int
    """Counts outside of the training range that are still taken for seen."""
    centre: NDArray[np.float64] | None = None
    own: TrainingStandards | None = None

    @classmethod
    def of(
        cls, counts: NDArray[np.generic], table_of: NDArray[np.int64], *, session: bool
    ) -> Looks:
        """Of training counts (N, fingers, 24) and their tables (N,)."""
        if not session:
            return cls(MARGIN_COUNTS)
        own = TrainingStandards.of(counts.reshape(len(counts), -1).astype(np.float64), table_of)
        centre = np.mean([table.mean for table in own.tables.values()], axis=0)
        return cls(SESSION_MARGIN_COUNTS, centre, own)

    def to_training(
        self, counts: NDArray[np.generic], table_of: NDArray[np.int64]
    ) -> NDArray[np.float64]:
        """Counts (N, fingers, 24) of these tables (N,) as the training's sensors would read."""
        values = counts.astype(np.float64)
        if self.own is None or self.centre is None:
            return values
        standard = self.own.each(table_of)
        flat = (values.reshape(len(values), -1) - standard.mean) / standard.spread
        mapped: NDArray[np.float64] = self.centre + self.own.prior.spread * flat
        return mapped.reshape(counts.shape)

    def from_training(
        self, values: NDArray[np.float64], table_of: NDArray[np.int64]
    ) -> NDArray[np.float64]:
        """The inverse of `to_training`."""
        if self.own is None or self.centre is None:
            return values
        standard = self.own.each(table_of)
        flat = (values.reshape(len(values), -1) - self.centre) / self.own.prior.spread
        counts: NDArray[np.float64] = flat * standard.spread + standard.mean
        return counts.reshape(values.shape)
