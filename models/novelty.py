"""Whether a reading looks like anything that a model was trained on."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from models.contract import SeenCounts

CONTRADICTING_MAX = 2
"""Electrodes that may contradict the others without anything else being known against them. Of
held-out grasps 99 % are judged with it; of readings with each electrode from another grasp none is,
and with a limit of four a tenth would be."""
LEARNED_DISTANCES = 2.0
"""A session takes in what is up to so many times farther than `distance_max`: if it took in only
what it would judge, its mean would move towards what is left, and the rest look ever stranger."""

CONTRADICTED_DISTANCES = 0.75
"""Of a session's reading, some of whose electrodes contradict the others, the rest must be as near
as so many times `distance_max`: of readings with each electrode from another grasp a tenth have two
or fewer that contradict, and all but a twentieth of these are farther; of real ones a tenth is."""


class NoveltyCheck:
    """Tells readings that are far from all training data: for them a network's answer is noise.

    Two tests, each of which catches what the other lets through: every electrode must lie in its
    range of training counts, with a margin (drifted or broken electrodes), and all together must
    fit the training covariance (values that are each possible, but not with one another). For a
    session model, whose counts were mapped to the training's sensors, only the second: ranges hold
    good grasps of another day for unlike, and few that are none.
    """

    def __init__(self, seen: SeenCounts) -> None:
        self._low = np.array(seen.low, dtype=np.float64) - seen.margin
        self._high = np.array(seen.high, dtype=np.float64) + seen.margin
        self._centre = np.array(seen.centre).ravel()
        self._whitening = seen.whitening_matrix()
        self._electrodes = len(self._centre)
        self._square_min, self._square_max = seen.distance_min**2, seen.distance_max**2

    def never_seen(self, counts: NDArray[np.generic], repaired: int = 0) -> NDArray[np.bool_]:
        """Shape (N,): True for each of the counts (N, fingers, 24) that was never seen.

        So many electrodes of each were `repaired` by what the others let expect: they add nothing
        to the distance, so it is taken over the others.
        """
        values = counts.astype(np.float64)
        outside = ((values < self._low) | (values > self._high)).any(axis=(1, 2))
        squares = self._squares(values, repaired)
        # Not (square > limit), so that a value that is not finite counts as never seen.
        within = (squares <= self._square_max) & (squares >= self._square_min)
        never: NDArray[np.bool_] = outside | ~within
        return never

    def is_near(self, square: float, contradicted: int = 0) -> bool:
        """Whether a reading of this `square` fits the training covariance; ranges do not matter.

        So many of the electrodes that were repaired in it `contradicted` the others.
        """
        share = CONTRADICTED_DISTANCES if contradicted else 1.0
        return self._square_min <= square <= share**2 * self._square_max

    def is_learned(self, square: float) -> bool:
        """Whether a session may take in a reading of this `square`, which was mapped by it."""
        return square <= LEARNED_DISTANCES**2 * self._square_max

    def square(self, values: NDArray[np.float64], repaired: int = 0) -> float:
        """Mean square whitened deviation of counts (fingers, 24) with so many `repaired`."""
        deviations = (values.ravel() - self._centre) @ self._whitening
        return float(deviations @ deviations) / (self._electrodes - repaired)

    def _squares(self, values: NDArray[np.float64], repaired: int) -> NDArray[np.float64]:
        deviations = (values.reshape(len(values), -1) - self._centre) @ self._whitening
        squares: NDArray[np.float64] = np.einsum("ne,ne->n", deviations, deviations)
        return squares / (self._electrodes - repaired)
