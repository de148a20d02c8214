"""What the training's counts say of a reading: which electrodes contradict the others, what they
should read, and whether the reading as a whole looks like anything that was seen.

The counts of all electrodes are taken for a Gaussian, with the mean and covariance of the training.
What one electrode should read, given the others, and how far that may be off, then follows in
closed form from the inverse covariance P: the residual is `(P d)_i / P_ii`, its standard deviation
`1 / sqrt(P_ii)`, with d the deviations from the mean.
"""

from __future__ import annotations

import math
from operator import gt

import numpy as np
from numpy.typing import NDArray

from graspd.models.contract import SeenCounts

ROUNDING = 1e-9
"""Share of a limit within which `Electrodes.plain_square` leaves it open whether it is kept: some
thousand times what rounding makes of a residual."""
IMPLAUSIBLE = 8.0
"""Residual from here on, in its standard deviations. Real grasps are heavier in the tails than a
Gaussian: 7 to 8 % of the held-out ones have an electrode beyond it. To repair it changes F1 by 0.3
points at most; to leave four wrong ones within the range costs 3 to 40."""
CONTRADICTING_MAX = 2
"""Electrodes that may contradict the others without anything else being known against them. Of
held-out grasps 99 % are judged with it; of readings with each electrode from another grasp none is,
and with a limit of four a tenth would be."""
LEARNED_DISTANCES = 2.0
"""A session learns from readings up to this many times `distance_max` away. Learning only from
those it would judge would move its mean towards them, and make the others look ever stranger."""

CONTRADICTED_DISTANCES = 0.75
"""Where some electrodes of a session's reading contradict the others, the others must be within
this many times `distance_max`. Of readings with each electrode from another grasp a tenth have two
or fewer that contradict, and 19 of 20 of these are farther; of real ones a tenth is."""


class Electrodes:
    """Finds and repairs broken electrodes of readings that look like the training's."""

    def __init__(self, seen: SeenCounts) -> None:
        self._centre = np.array(seen.centre).ravel()
        whitening = seen.whitening_matrix()
        self._precision = whitening @ whitening.T
        self._limits = IMPLAUSIBLE * np.sqrt(np.diag(self._precision))
        self._shape = np.shape(seen.centre)
        of_fingers = self._precision.reshape(self._shape * 2).sum(axis=(1, 3))
        self._finger_limits = IMPLAUSIBLE * np.sqrt(np.diag(of_fingers))
        self._plain_limits = (1.0 - ROUNDING) * self._limits
        self._plain_finger_limits: list[float] = ((1.0 - ROUNDING) * self._finger_limits).tolist()
        self.centre = self._centre.reshape(self._shape)
        """Mean of each electrode in the training, counts, shape (fingers, 24)."""
        self.spread = np.sqrt(np.diag(np.linalg.inv(self._precision))).reshape(self.centre.shape)
        """Standard deviation of each electrode in the training, counts, shape (fingers, 24)."""

    def implausible(
        self, values: NDArray[np.float64], broken: NDArray[np.bool_], at_most: int
    ) -> NDArray[np.bool_]:
        """`broken` and the electrodes whose values do not fit the others', shape (fingers, 24).

        `values` are counts (fingers, 24); those of `broken` are not looked at. The worst one goes
        first, then the rest is looked at without it, until all fit or `at_most` are broken.
        """
        deviations = values.ravel() - self._centre
        if np.count_nonzero(broken):
            deviations[broken.ravel()] = 0.0
        residuals = self._precision @ deviations
        fit = np.abs(residuals) <= self._limits
        if np.count_nonzero(fit) == fit.size and not np.count_nonzero(broken):
            return broken
        found = broken.ravel().copy()
        others = _Others(self._precision, residuals)
        for electrode in np.flatnonzero(found).tolist():
            others.forget(electrode)
        for _ in range(at_most - len(others.forgotten)):
            worst = others.worst()
            if worst is None:
                break
            found[worst] = True
            others.forget(worst)
        return found.reshape(broken.shape)

    def plain_square(self, deviations: NDArray[np.float64]) -> float | None:
        """Return `NoveltyCheck.square` of a reading, by `deviations` from `centre`, (fingers, 24).
        None where `implausible` finds an electrode of them or `moved_finger` says yes, or might."""
        flat = deviations.reshape(-1)
        residuals = self._precision.dot(flat)
        if 0 in (np.abs(residuals) < self._plain_limits).tobytes():
            return None
        of_fingers = np.add.reduce(residuals.reshape(self._shape), axis=1).tolist()
        if any(map(gt, map(abs, of_fingers), self._plain_finger_limits)):
            return None
        return float(flat.dot(residuals)) / len(flat)

    def moved_finger(self, values: NDArray[np.float64]) -> bool:
        """Whether one number, added to all electrodes of a finger, made `values` what they are.

        Of counts (fingers, 24): that number, as the electrodes let expect it, is further from zero
        than `IMPLAUSIBLE` of its standard deviations. No single electrode need contradict.
        """
        residuals = (self._precision @ (values.ravel() - self._centre)).reshape(self._shape)
        return not bool((np.abs(residuals.sum(axis=1)) <= self._finger_limits).all())

    def repaired(
        self, values: NDArray[np.float64], broken: NDArray[np.bool_]
    ) -> NDArray[np.float64]:
        """`values` with what the sound electrodes let expect in place of the broken ones."""
        out = broken.ravel()
        deviations = values.ravel() - self._centre
        deviations[out] = 0.0
        precision = self._precision[out]
        flat = values.ravel().copy()
        flat[out] = self._centre[out] - np.linalg.solve(precision[:, out], precision @ deviations)
        return flat.reshape(values.shape)


class _Others:
    """Precision and residuals of the electrodes that are left when some are forgotten.

    The inverse covariance of the others is the Schur complement. Of it only the diagonal and the
    columns of those that go are needed: a Cholesky decomposition, one column for each.
    """

    def __init__(self, precision: NDArray[np.float64], residuals: NDArray[np.float64]) -> None:
        """Of all electrodes, shapes (electrodes, electrodes) and (electrodes,)."""
        self._precision = precision
        self._residuals = residuals.copy()
        self._diagonal = np.diag(precision).copy()
        self._columns = np.zeros((len(precision), len(precision)))
        self.forgotten: list[int] = []

    def worst(self) -> int | None:
        """The electrode that fits the others least; None if all of them fit."""
        squares = self._residuals**2 / self._diagonal
        worst = int(squares.argmax())
        return worst if squares[worst] > IMPLAUSIBLE**2 else None

    def forget(self, electrode: int) -> None:
        """Leave an electrode out; whatever its value added to the others' residuals goes too."""
        number = len(self.forgotten)
        columns = self._columns[:number]
        pivot = math.sqrt(self._diagonal[electrode])
        column = (self._precision[electrode] - columns[:, electrode] @ columns) / pivot
        self._residuals -= column * (self._residuals[electrode] / pivot)
        self._diagonal -= column**2
        self._diagonal[electrode] = np.inf  # never the worst again
        self._columns[number] = column
        self.forgotten.append(electrode)


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
        """Return shape (N,): True for each of the counts (N, fingers, 24) that was never seen.
        Each has `repaired` electrodes that add nothing to the distance, a mean over the others."""
        values = counts.astype(np.float64)
        outside = ((values < self._low) | (values > self._high)).any(axis=(1, 2))
        squares = self._squares(values, repaired)
        # Not (square > limit), so that a value that is not finite counts as never seen.
        within = (squares <= self._square_max) & (squares >= self._square_min)
        never: NDArray[np.bool_] = outside | ~within
        return never

    def is_near(self, square: float, contradicted: int = 0) -> bool:
        """Return True if a reading of this `square` fits the covariance; ranges do not matter.
        `contradicted`: how many of its repaired electrodes contradicted the others."""
        share = CONTRADICTED_DISTANCES if contradicted else 1.0
        return self._square_min <= square <= share**2 * self._square_max

    def is_learned(self, square: float) -> bool:
        """Whether a session may take in a reading of this `square`, which was mapped by it."""
        return square <= LEARNED_DISTANCES**2 * self._square_max

    def square(self, values: NDArray[np.float64], repaired: int = 0) -> float:
        """Mean square whitened deviation of counts (fingers, 24); `repaired` of them count as 0."""
        deviations = (values.ravel() - self._centre) @ self._whitening
        return float(deviations @ deviations) / (self._electrodes - repaired)

    def _squares(self, values: NDArray[np.float64], repaired: int) -> NDArray[np.float64]:
        deviations = (values.reshape(len(values), -1) - self._centre) @ self._whitening
        squares: NDArray[np.float64] = np.einsum("ne,ne->n", deviations, deviations)
        return squares / (self._electrodes - repaired)
