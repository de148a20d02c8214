"""What a broken electrode would read: found and filled in by what its neighbours read.

The counts of all electrodes are taken for a Gaussian, with the mean and covariance of the training.
What one electrode should read, given the others, and how far that may be off, then follows in
closed form from the inverse covariance P: the residual is `(P d)_i / P_ii`, its standard deviation
`1 / sqrt(P_ii)`, with d the deviations from the mean.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from models.contract import SeenCounts

IMPLAUSIBLE = 8.0
"""Residual from here on, in its standard deviations. Real grasps are heavier in the tails than a
Gaussian: 7 to 8 % of the held-out ones have an electrode beyond it. To repair it changes F1 by 0.3
points at most; to leave four wrong ones within the range costs 3 to 40."""


class Electrodes:
    """Finds and repairs broken electrodes of readings that look like the training's."""

    def __init__(self, seen: SeenCounts) -> None:
        self._centre = np.array(seen.centre).ravel()
        whitening = seen.whitening_matrix()
        self._precision = whitening @ whitening.T
        self._limit_square = IMPLAUSIBLE**2 * np.diag(self._precision)
        self.centre = self._centre.reshape(np.shape(seen.centre))
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
        found = broken.ravel().copy()
        deviations = np.where(found, 0.0, values.ravel() - self._centre)
        residuals = self._precision @ deviations
        if not found.any() and (residuals**2 <= self._limit_square).all():
            return broken
        precision = self._precision.copy()
        for electrode in np.flatnonzero(found):
            _forget(int(electrode), precision, residuals)
        while np.count_nonzero(found) < at_most:
            weight = np.where(found, np.inf, np.diag(precision))
            squares = residuals**2 / weight
            worst = int(squares.argmax())
            if not squares[worst] > IMPLAUSIBLE**2:
                break
            found[worst] = True
            _forget(worst, precision, residuals)
        return found.reshape(broken.shape)

    def repaired(
        self, values: NDArray[np.float64], broken: NDArray[np.bool_]
    ) -> NDArray[np.float64]:
        """`values` with what the sound electrodes let expect in place of the broken ones."""
        out = broken.ravel()
        flat = values.ravel().copy()
        sound = ~out
        pull = self._precision[np.ix_(out, sound)] @ (flat[sound] - self._centre[sound])
        flat[out] = self._centre[out] - np.linalg.solve(self._precision[np.ix_(out, out)], pull)
        return flat.reshape(values.shape)


def _forget(electrode: int, precision: NDArray[np.float64], residuals: NDArray[np.float64]) -> None:
    """Take an electrode out of precision and residuals, in place: what is left is of the others.

    The inverse covariance of the others is the Schur complement; whatever the electrode's own
    value added to their residuals goes out with it.
    """
    column = precision[:, electrode] / precision[electrode, electrode]
    residuals -= column * residuals[electrode]
    precision -= np.outer(column, precision[electrode])
