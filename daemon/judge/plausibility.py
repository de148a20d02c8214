"""Whether counts look like grasps that the model has seen, and repair of what contradicts."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from daemon.judge.health import too_many
from daemon.judge.reasons import Reason
from drivers.base import COUNT_MAX, ELECTRODES
from models.contract import SeenCounts
from models.electrodes import Electrodes
from models.novelty import NoveltyCheck

if TYPE_CHECKING:
    from daemon.judge.calibration import SessionCalibration

CONTRADICTING_MAX = 2
"""Electrodes that may contradict the others without anything else being known against them. Of
held-out grasps 99 % are judged with it; of readings with each electrode from another grasp none is,
and with a limit of four a tenth would be."""
FLAT_SPREAD_COUNTS = 70.0
"""Standard deviation of a finger's electrodes below which it is not touching, or not working: half
of the smallest of 4682 real grasps, 148."""
ONES = np.ones(ELECTRODES)


@dataclass(frozen=True, slots=True, eq=False)
class Findings:
    """What was found in the counts of one grasp."""

    reasons: tuple[Reason, ...]
    """Against judging it; none if it is sound, or has been repaired."""
    counts: NDArray[np.generic]
    """Shape (fingers, 24), with the broken electrodes repaired; as read where there are reasons."""
    repaired: NDArray[np.bool_] | None = None
    """Shape (fingers, 24); None if nothing had to be."""
    grasp: NDArray[np.generic] | None = None
    """Shape (fingers, 24): what a session may take in, even if it is like nothing that was seen
    before, because that is how a drifted sensor starts. Only electrodes that are certainly broken
    are repaired in it. None where the reading tells nothing."""


class Plausibility:
    """Compares counts with the training's."""

    def __init__(
        self, seen: SeenCounts, electrodes: Electrodes, session: SessionCalibration | None = None
    ) -> None:
        """`seen` is what the model was trained on, `session` how today's sensors differ from it."""
        self._seen = NoveltyCheck(seen)
        self._electrodes = electrodes
        self._session = session

    def examine(self, counts: NDArray[np.uint16], broken: NDArray[np.bool_]) -> Findings:
        """Reasons against judging these counts, or those to judge by; shapes (fingers, 24)."""
        if _is_flat(counts, broken):
            return Findings((Reason.FLAT,), counts)
        values = self._to_training(counts)
        grasp, values = self._repair(counts, values, broken)
        at_most = int(np.count_nonzero(broken)) + CONTRADICTING_MAX + 1
        found = self._electrodes.implausible(values, broken, at_most)
        number = int(np.count_nonzero(found))
        if number == at_most or too_many(found):
            # So much does not fit that the reading as a whole is like nothing in the training.
            return self._never_seen(counts, grasp)
        repaired, values = self._repair(counts, values, found)
        if self._session is not None and self._is_odd(self._session, repaired):
            return self._never_seen(counts, grasp)
        if not self._seen.is_seen(values, number):
            return self._never_seen(counts, grasp)
        return Findings((), repaired, found if number else None, grasp)

    def _never_seen(self, counts: NDArray[np.uint16], grasp: NDArray[np.generic]) -> Findings:
        """Refused; a session learns from it only while it is young: that is how drift begins.

        A calibrated one does not, or a sensor that fails would slowly become its own standard.
        """
        young = self._session is None or not self._session.calibrated
        return Findings((Reason.NEVER_SEEN,), counts, None, grasp if young else None)

    def _is_odd(self, session: SessionCalibration, counts: NDArray[np.generic]) -> bool:
        """Whether session or reading cannot be of grasps, whatever the session's spreads make it.

        The reading is compared once more with only the session's mean taken off: how much the
        electrodes of a finger vary, and with one another, hardly differs from day to day.
        """
        return session.odd or self._seen.is_far(
            self._electrodes.centre + (counts.astype(np.float64) - session.counts_mean)
        )

    def _repair(
        self,
        counts: NDArray[np.uint16],
        values: NDArray[np.float64],
        broken: NDArray[np.bool_],
    ) -> tuple[NDArray[np.generic], NDArray[np.float64]]:
        """Counts, and their values with the training's sensors, with the broken ones repaired."""
        if not np.count_nonzero(broken):
            return counts, values
        values = self._electrodes.repaired(values, broken)
        return np.where(broken, self._from_training(values), counts), values

    def _to_training(self, counts: NDArray[np.generic]) -> NDArray[np.float64]:
        """What the counts would have been with the training's sensors."""
        if self._session is None:
            return counts.astype(np.float64)
        return self._session.to_training(counts)

    def _from_training(self, values: NDArray[np.float64]) -> NDArray[np.float64]:
        counts = values if self._session is None else self._session.from_training(values)
        return np.minimum(np.maximum(counts, 0.0), COUNT_MAX)


def _is_flat(counts: NDArray[np.uint16], broken: NDArray[np.bool_]) -> bool:
    """Whether the sound electrodes of a finger read about the same."""
    values, numbers = counts.astype(np.float64), [ELECTRODES] * len(counts)
    if np.count_nonzero(broken):
        values[broken] = 0.0
        numbers = (~broken).sum(axis=1).tolist()
    sums = (values @ ONES).tolist()
    squares = (values**2 @ ONES).tolist()
    # Sums of whole numbers are exact, so nothing is lost when they cancel.
    return any(
        number * square - total * total < (number * FLAT_SPREAD_COUNTS) ** 2
        for number, total, square in zip(numbers, sums, squares, strict=True)
    )
