"""Whether counts look like grasps that the model has seen, and repair of what contradicts."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from daemon.judge.findings import Examined, any_of, electrode_name
from daemon.judge.health import too_many
from daemon.judge.reasons import Reason
from drivers.base import COUNT_MAX, ELECTRODES
from models.contract import Finger, SeenCounts
from models.electrodes import ROUNDING, Electrodes
from models.novelty import CONTRADICTING_MAX, NoveltyCheck

if TYPE_CHECKING:
    from daemon.judge.calibration import Calibration

FLAT_SPREAD_COUNTS = 70.0
"""Standard deviation of a finger's electrodes below which it is not touching, or not working: half
of the smallest of 4682 real grasps, 148."""
ONES = np.ones(ELECTRODES)
LESS, MORE = 1.0 - ROUNDING, 1.0 + ROUNDING
"""What keeps a limit by both of these shares of itself keeps it however it was rounded."""


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
        values = counts.astype(np.float64)
        if _is_flat(values, broken):
            return Examined((Reason.FLAT,), counts)
        if session is not None:
            if not any_of(broken) and self._is_plain(values, session):
                return Examined((), counts, (), counts)
            values = session.to_training(values)
        grasp, values = self._repair(counts, values, broken, session)
        known = int(np.count_nonzero(broken))
        at_most = known + CONTRADICTING_MAX + 1
        found = self._electrodes.implausible(values, broken, at_most)
        number = int(np.count_nonzero(found))
        # With so many, the reading as a whole is like nothing in the training.
        seen = learned = number < at_most and not too_many(found)
        if seen:
            repaired, values = self._repair(counts, values, found, session)
            if session is None:
                seen = self._novelty.is_seen(values, number)
            elif self._electrodes.moved_finger(values):
                seen = learned = False
            else:
                square = self._novelty.square(values, number)
                learned = self._novelty.is_learned(square)
                seen = self._novelty.is_near(square, number - known) and not session.odd
        if not seen:
            # A young session learns from all, for that is how drift begins; later on a sensor that
            # fails would slowly become its own standard.
            learned |= session is None or not session.calibrated
            return Examined((Reason.NEVER_SEEN,), counts, (), grasp if learned else None)
        return Examined((), repaired, self._names(found) if number else (), grasp)

    def _is_plain(self, counts: NDArray[np.float64], session: Calibration) -> bool:
        """Whether nothing at all is found: each limit is kept by more than rounding can be.

        In a fifth of the time of the examination, which would say the same.
        """
        deviations = counts - session.counts_mean
        deviations *= session.scale
        square = None if session.odd else self._electrodes.plain_square(deviations)
        near = self._novelty.is_near
        return square is not None and near(square * LESS) and near(square * MORE)

    def _repair(
        self,
        counts: NDArray[np.uint16],
        values: NDArray[np.float64],
        broken: NDArray[np.bool_],
        session: Calibration | None,
    ) -> tuple[NDArray[np.generic], NDArray[np.float64]]:
        """Counts, and their values with the training's sensors, with the broken ones repaired."""
        if not any_of(broken):
            return counts, values
        values = self._electrodes.repaired(values, broken)
        expected = values if session is None else session.from_training(values)
        expected = np.minimum(np.maximum(expected, 0.0), COUNT_MAX)
        return np.where(broken, expected, counts), values

    def _names(self, which: NDArray[np.bool_]) -> tuple[str, ...]:
        places = np.argwhere(which).tolist()
        return tuple(electrode_name(self._fingers[finger], place) for finger, place in places)


def _is_flat(values: NDArray[np.float64], broken: NDArray[np.bool_]) -> bool:
    """Whether the sound electrodes of a finger read about the same; `values` are counts."""
    numbers = [ELECTRODES] * len(values)
    if any_of(broken):
        values = np.where(broken, 0.0, values)
        numbers = (~broken).sum(axis=1).tolist()
    sums = values.dot(ONES).tolist()
    squares = np.square(values).dot(ONES).tolist()
    # Sums of whole numbers are exact, so nothing is lost when they cancel.
    return any(
        number * square - total * total < (number * FLAT_SPREAD_COUNTS) ** 2
        for number, total, square in zip(numbers, sums, squares, strict=True)
    )
