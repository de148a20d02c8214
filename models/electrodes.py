"""Compare a reading with the training: repair wrong electrodes, refuse readings unlike it.

All counts together are modelled as a Gaussian with the mean and covariance of the training. Let d
be the deviations from the mean, and P the inverse covariance. The other electrodes then predict
electrode i with the residual `(P d)_i / P_ii` and the standard deviation `1 / sqrt(P_ii)`.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from graspd.biotac import ELECTRODES
from graspd.models.contract import SeenCounts

IMPLAUSIBLE = 8.0
"""Residual, in its standard deviations, from which on an electrode counts as broken.

Real grasps have heavier tails than a Gaussian: 7 to 8 % of the held-out ones have an electrode
beyond this limit. Repairing it changes F1 by at most 0.3 points. Leaving four wrong electrodes
unrepaired costs 3 to 40 points.
"""
CONTRADICTING_MAX = 2
"""Most electrodes, besides those known to be broken, that may contradict the others.

With this limit 99 % of the held-out grasps are judged. A quarter of the readings whose electrodes
each come from another grasp of the day have so few for `small-session`, none for `cnn1`; with a
limit of four, two thirds or more would.
"""
BROKEN_MAX = 12
"""Most broken electrodes of a hand that are repaired.

Twelve at random cost `cnn1` 1.2 +- 0.3 points of F1 and `small-session` 0.6 +- 0.2; eighteen cost
2.1 and 1.3 (protocol `cv`).
"""
BROKEN_FINGER_MAX = 8
"""Most broken electrodes of one finger that are repaired.

Eight neighbours of the first finger, the worst place, cost 2.4 +- 0.8 and 1.4 +- 0.5 points; twelve
cost 4.3 and 2.8. Eight of another finger cost at most 0.6.
"""
LEARNED_DISTANCES = 2.0
"""Largest distance, in units of `distance_max`, of a reading from which a session learns.

A session that learned only from the readings it judges would move its mean towards them, and
refuse more and more other readings.
"""

CONTRADICTED_DISTANCES = 0.75
"""Largest distance, in units of `distance_max`, of a reading with contradicting electrodes.

Without it `small-session` would judge a quarter of the readings whose electrodes each come from
another grasp of the day; with it, 2 to 5 %. It refuses at most 0.4 % of the real readings.
"""
ONES = np.ones(ELECTRODES)


class Deviations(NamedTuple):
    """How a reading deviates from the training; arrays have shape (electrodes,)."""

    counts: NDArray[np.float64]
    """Deviation d of each electrode from its mean in the training, counts."""
    residuals: NDArray[np.float64]
    """P d: deviation from what the other electrodes predict, times P_ii, 1/counts."""

    def mean_square(self, repaired: int = 0) -> float:
        """Return d . P d over the number of electrodes: the mean square whitened deviation.

        `repaired`: number of repaired electrodes, which are left out of the mean.
        """
        return float(self.counts.dot(self.residuals)) / (len(self.counts) - repaired)


class Examination(NamedTuple):
    """Result of examining a reading; arrays have shape (fingers, 24)."""

    values: NDArray[np.float64]
    """Counts of the reading, with `implausible` electrodes repaired unless they are too many."""
    implausible: NDArray[np.bool_]
    """True for electrodes that were known to be broken, or do not fit the others."""
    seen: bool
    """True if the reading is like the training, so that a network may judge it."""
    learned: bool
    """True if a session may learn from the reading."""


class Electrodes:
    """Compare readings with the training: repair broken electrodes, refuse what is unlike it.

    For readings that are far from all training data a network's answer is noise. There are two
    tests, and each finds readings that the other misses. Each electrode must lie in its range of
    training counts, with a margin; this finds drifted or broken electrodes. All electrodes together
    must fit the training covariance; this finds values that are possible alone but not together.
    Session models, whose counts are mapped to the training's sensors, use only the second test:
    ranges would refuse good grasps of another day.
    """

    def __init__(self, seen: SeenCounts) -> None:
        self._centre = np.array(seen.centre).ravel()
        whitening = seen.whitening_matrix()
        self._precision = whitening @ whitening.T
        self._limits = IMPLAUSIBLE * np.sqrt(np.diag(self._precision))
        self._shape = np.shape(seen.centre)
        of_fingers = self._precision.reshape(self._shape * 2).sum(axis=(1, 3))
        self._finger_limits = IMPLAUSIBLE * np.sqrt(np.diag(of_fingers))
        self.centre = self._centre.reshape(self._shape)
        """Training mean of each electrode, counts, shape (fingers, 24)."""
        self.spread = np.sqrt(np.diag(np.linalg.inv(self._precision))).reshape(self.centre.shape)
        """Training standard deviation of each electrode, counts, shape (fingers, 24)."""
        self._low = np.array(seen.low, dtype=np.float64) - seen.margin
        self._high = np.array(seen.high, dtype=np.float64) + seen.margin
        self._whitening = whitening
        self._square_min, self._square_max = seen.distance_min**2, seen.distance_max**2

    def examine(
        self, values: NDArray[np.float64], broken: NDArray[np.bool_], *, in_session: bool
    ) -> Examination:
        """Examine counts, shape (fingers, 24); the caller has repaired the `broken` electrodes.

        `in_session`: True if a session has mapped the counts to the training's sensors.
        """
        known = int(np.count_nonzero(broken))
        if known == values.size:
            return Examination(values, broken, seen=False, learned=False)
        at_most = known + CONTRADICTING_MAX + 1
        deviations = self.compare(values)
        implausible = self.implausible(deviations, broken, at_most)
        number = int(np.count_nonzero(implausible))
        if number >= at_most:
            # The reading as a whole is unlike the training.
            return Examination(values, implausible, seen=False, learned=False)
        if number > known:
            values = self.repaired(values, implausible)
            deviations = self.compare(values)
        if not in_session:
            seen = not self.never_seen(values[np.newaxis], number)[0]
            return Examination(values, implausible, seen, learned=True)
        if self.moved_finger(deviations):
            return Examination(values, implausible, seen=False, learned=False)
        square = deviations.mean_square(number)
        seen = self.is_near(square, number - known)
        return Examination(values, implausible, seen, self.is_learned(square))

    def compare(self, values: NDArray[np.float64]) -> Deviations:
        """Return the deviations of counts, shape (fingers, 24), from the training."""
        deviations = values.ravel() - self._centre
        return Deviations(deviations, self._precision.dot(deviations))

    def implausible(
        self, deviations: Deviations, broken: NDArray[np.bool_], at_most: int
    ) -> NDArray[np.bool_]:
        """Return `broken` and the electrodes that do not fit the others, shape (fingers, 24).

        Deviations of `broken` are ignored. The worst electrode is removed first and the rest
        checked again, until all fit or `at_most` electrodes of the hand, with those of `broken`,
        are marked.
        """
        bad, residuals = broken.ravel(), deviations.residuals
        if 1 in broken.tobytes():
            residuals = self._precision.dot(np.where(bad, 0.0, deviations.counts))
        elif 0 not in (np.abs(residuals) <= self._limits).tobytes():
            return broken
        bad = bad.copy()
        others = _Others(self._precision, residuals)
        for electrode in np.flatnonzero(bad).tolist():
            others.forget(electrode)
        for _ in range(at_most - len(others.forgotten)):
            worst = others.worst()
            if worst is None:
                break
            bad[worst] = True
            others.forget(worst)
        return bad.reshape(broken.shape)

    def moved_finger(self, deviations: Deviations) -> bool:
        """Return True if all electrodes of a finger seem shifted by one offset.

        The offset is estimated from all electrodes, and must be over `IMPLAUSIBLE` standard
        deviations. No single electrode need contradict the others.
        """
        of_fingers = deviations.residuals.reshape(self._shape).dot(ONES)
        return 0 in (np.abs(of_fingers) <= self._finger_limits).tobytes()

    def repaired(
        self, values: NDArray[np.float64], broken: NDArray[np.bool_]
    ) -> NDArray[np.float64]:
        """Return `values` with each broken electrode replaced by the others' prediction."""
        out = broken.ravel()
        deviations = values.ravel() - self._centre
        deviations[out] = 0.0
        precision = self._precision[out]
        flat = values.ravel().copy()
        flat[out] = self._centre[out] - np.linalg.solve(precision[:, out], precision @ deviations)
        return flat.reshape(values.shape)

    def never_seen(self, counts: NDArray[np.generic], repaired: int = 0) -> NDArray[np.bool_]:
        """Return True for each reading of `counts` that is unlike the training, shape (N,).

        `counts`: shape (N, fingers, 24). `repaired`: number of repaired electrodes in each, which
        are left out of the mean distance.
        """
        values = counts.astype(np.float64)
        outside = ((values < self._low) | (values > self._high)).any(axis=(1, 2))
        deviations = (values.reshape(len(values), -1) - self._centre) @ self._whitening
        squares = np.einsum("ne,ne->n", deviations, deviations) / (len(self._centre) - repaired)
        # Not `square > limit`: a value that is not finite must count as never seen.
        within = (squares <= self._square_max) & (squares >= self._square_min)
        never: NDArray[np.bool_] = outside | ~within
        return never

    def is_near(self, square: float, contradicted: int = 0) -> bool:
        """Return True if a reading with this mean square deviation fits the covariance.

        `contradicted`: number of its repaired electrodes that contradicted the others.
        """
        share = CONTRADICTED_DISTANCES if contradicted else 1.0
        return self._square_min <= square <= share**2 * self._square_max

    def is_learned(self, square: float) -> bool:
        """Return True if a session may learn from a reading with this mean square deviation."""
        return square <= LEARNED_DISTANCES**2 * self._square_max


class _Others:
    """Precision and residuals of the remaining electrodes after some were left out.

    The inverse covariance of the remaining ones is the Schur complement. Only its diagonal and the
    columns of those left out are needed: a Cholesky decomposition, one column for each.
    """

    def __init__(self, precision: NDArray[np.float64], residuals: NDArray[np.float64]) -> None:
        """Start with all electrodes: shapes (electrodes, electrodes) and (electrodes,)."""
        self._precision = precision
        self._residuals = residuals.copy()
        self._diagonal = np.diag(precision).copy()
        self._columns = np.zeros((len(precision), len(precision)))
        self.forgotten: list[int] = []

    def worst(self) -> int | None:
        """Return the electrode that fits the others least; None if all fit."""
        squares = self._residuals**2 / self._diagonal
        worst = int(squares.argmax())
        return worst if squares[worst] > IMPLAUSIBLE**2 else None

    def forget(self, electrode: int) -> None:
        """Leave an electrode out, and remove its effect on the residuals of the others."""
        count = len(self.forgotten)
        columns = self._columns[:count]
        pivot = math.sqrt(self._diagonal[electrode])
        column = (self._precision[electrode] - columns[:, electrode] @ columns) / pivot
        self._residuals -= column * (self._residuals[electrode] / pivot)
        self._diagonal -= column**2
        self._diagonal[electrode] = np.inf  # so that it is never the worst again
        self._columns[count] = column
        self.forgotten.append(electrode)


def any_of(which: NDArray[np.bool_]) -> bool:
    """Return True if any is true, in a tenth of the time of `any()`."""
    return 1 in which.tobytes()


def too_many(broken: NDArray[np.bool_]) -> bool:
    """Return True if over 12 electrodes of the hand, or over 8 of one finger, are broken."""
    if np.count_nonzero(broken) <= BROKEN_FINGER_MAX:
        return False
    per_finger = broken.sum(axis=1)
    return bool(per_finger.sum() > BROKEN_MAX or per_finger.max() > BROKEN_FINGER_MAX)
