"""Whether counts look like grasps that the model has seen, and repair of what contradicts."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from daemon.judge.findings import Examined, electrode_name
from daemon.judge.health import too_many
from daemon.judge.reasons import Reason
from drivers.base import COUNT_MAX, ELECTRODES
from models.contract import Finger, SeenCounts
from models.electrodes import Electrodes
from models.novelty import NoveltyCheck

if TYPE_CHECKING:
    from daemon.judge.calibration import Calibration

CONTRADICTING_MAX = 2
"""Electrodes that may contradict the others without anything else being known against them. Of
held-out grasps 99 % are judged with it; of readings with each electrode from another grasp none is,
and with a limit of four a tenth would be."""
FLAT_SPREAD_COUNTS = 70.0
"""Standard deviation of a finger's electrodes below which it is not touching, or not working: half
of the smallest of 4682 real grasps, 148."""
ONES = np.ones(ELECTRODES)


class Plausibility:
    """Compares counts with the training's."""

    def __init__(self, fingers: Sequence[Finger], seen: SeenCounts, electrodes: Electrodes) -> None:
        """`seen` is what the model was trained on, `electrodes` what follows from it."""
        self._fingers = tuple(fingers)
        self._novelty = NoveltyCheck(seen)
        self._electrodes = electrodes

    def examine(
        self,
        counts: NDArray[np.uint16],
        broken: NDArray[np.bool_],
        session: Calibration | None = None,
    ) -> Examined:
        """Reasons against judging these counts, or those to judge by; shapes (fingers, 24).

        `session` is how today's sensors differ from the training's, as far as it is known.
        """
        if _is_flat(counts, broken):
            return Examined((Reason.FLAT,), counts)
        values = counts.astype(np.float64) if session is None else session.to_training(counts)
        grasp, values = self._repair(counts, values, broken, session)
        at_most = int(np.count_nonzero(broken)) + CONTRADICTING_MAX + 1
        found = self._electrodes.implausible(values, broken, at_most)
        number = int(np.count_nonzero(found))
        # With so many, the reading as a whole is like nothing in the training.
        never_seen = number == at_most or too_many(found)
        if not never_seen:
            repaired, values = self._repair(counts, values, found, session)
            never_seen = (
                session is not None and self._is_odd(session, repaired)
            ) or not self._novelty.is_seen(values, number)
        if never_seen:
            # A session learns from it only while it is young, for that is how drift begins; later
            # on a sensor that fails would slowly become its own standard.
            young = session is None or not session.calibrated
            return Examined((Reason.NEVER_SEEN,), counts, (), grasp if young else None)
        return Examined((), repaired, self._names(found) if number else (), grasp)

    def _is_odd(self, session: Calibration, counts: NDArray[np.generic]) -> bool:
        """Whether session or reading cannot be of grasps, whatever the session's spreads make it.

        The reading is compared once more with only the session's mean taken off: how much the
        electrodes of a finger vary, and with one another, hardly differs from day to day.
        """
        return session.odd or self._novelty.is_far(
            self._electrodes.centre + (counts.astype(np.float64) - session.counts_mean)
        )

    def _repair(
        self,
        counts: NDArray[np.uint16],
        values: NDArray[np.float64],
        broken: NDArray[np.bool_],
        session: Calibration | None,
    ) -> tuple[NDArray[np.generic], NDArray[np.float64]]:
        """Counts, and their values with the training's sensors, with the broken ones repaired."""
        if not np.count_nonzero(broken):
            return counts, values
        values = self._electrodes.repaired(values, broken)
        expected = values if session is None else session.from_training(values)
        expected = np.minimum(np.maximum(expected, 0.0), COUNT_MAX)
        return np.where(broken, expected, counts), values

    def _names(self, which: NDArray[np.bool_]) -> tuple[str, ...]:
        places = np.argwhere(which).tolist()
        return tuple(electrode_name(self._fingers[finger], place) for finger, place in places)


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
