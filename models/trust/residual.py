"""Residual: log-odds of slip that linear weights cannot express, learned from grasps alike.

It is a Gaussian process. Its values at the latest told grasps are part of the learner's state.
Rasmussen and Williams, Gaussian Processes for Machine Learning, 2006, chapter 2.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

GRASPS_MAX: Final = 128
"""Told grasps whose residual is in the state. Twice as many gain 0.5 points of F1, and an outcome
takes four times as long."""
SHARED_VARIANCE: Final = 9.0
"""Prior variance of the residual, log-odds squared, that grasps with equal inputs share."""
OWN_VARIANCE: Final = 0.009
"""Prior variance of the residual that is a grasp's own. No eigenvalue of the prior is smaller."""
REACH: Final = 0.5
"""Root mean square difference of the inputs of two grasps whose residuals correlate by 0.61."""

Vector = NDArray[np.float64]
Matrix = NDArray[np.float64]


class Residual:
    """Prior of the residual at N told grasps, and what follows for other grasps.

    A state is a mean (W + N,) and a covariance (W + N, W + N) of W weights, then of the residual at
    the told grasps, oldest first.
    """

    def __init__(self, grasps: Matrix) -> None:
        """`grasps`: inputs of the told grasps, shape (N, inputs)."""
        self.grasps = grasps
        self.variance = SHARED_VARIANCE + OWN_VARIANCE if grasps.shape[1] else 0.0
        """Prior variance of the residual at any grasp; 0 without inputs: there is none."""
        self._scale = -0.5 / (max(grasps.shape[1], 1) * REACH**2)
        self._squares = np.einsum("ij,ij->i", grasps, grasps)
        products = grasps @ grasps.T
        self.prior = self._shared(self._squares[:, None] + self._squares - 2.0 * products)
        """Covariance (N, N)."""
        np.fill_diagonal(self.prior, self.variance)
        self._inverse = np.linalg.inv(self.prior)

    def shared(self, inputs: Vector) -> Vector:
        """Return the covariances (N,) of the residual at another grasp with those at the told."""
        return self._shared(self._squares + inputs @ inputs - 2.0 * (self.grasps @ inputs))

    def _shared(self, squares: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return covariances of grasps at these squared distances."""
        # Rounding leaves distances of equal grasps a little below 0.
        covariances: NDArray[np.float64] = np.exp(self._scale * np.maximum(squares, 0.0))
        return SHARED_VARIANCE * covariances

    def projected(self, mean: Vector, covariance: Matrix) -> tuple[Vector, Matrix]:
        """Return m and S, from which the log-odds of any grasp follow.

        With g, the features of the weights and then `shared`, their mean is g @ m. Their variance
        is g @ S @ g plus the residual's prior variance.
        """
        weights = len(mean) - len(self.grasps)
        mean, spread = mean.copy(), covariance.copy()
        mean[weights:] = self._inverse @ mean[weights:]
        spread[:, weights:] = spread[:, weights:] @ self._inverse
        spread[weights:] = self._inverse @ spread[weights:]
        spread[weights:, weights:] -= self._inverse
        return mean, spread

    def told(
        self, inputs: Vector, mean: Vector, covariance: Matrix
    ) -> tuple[Residual, Vector, Matrix]:
        """Return residual and state with the residual at one more grasp, as the last one.

        The oldest is dropped beyond `GRASPS_MAX`.
        """
        weights = len(mean) - len(self.grasps)
        shared = self.shared(inputs)
        links = self._inverse @ shared
        row = covariance[:, weights:] @ links
        own = self.variance - shared @ links + row[weights:] @ links
        mean = np.append(mean, mean[weights:] @ links)
        covariance = np.block([[covariance, row[:, None]], [row, own]])
        grasps = np.vstack((self.grasps, inputs))
        if len(grasps) > GRASPS_MAX:
            kept = np.delete(np.arange(len(mean)), weights)
            grasps, mean, covariance = grasps[1:], mean[kept], covariance[np.ix_(kept, kept)]
        return Residual(grasps), mean, covariance
