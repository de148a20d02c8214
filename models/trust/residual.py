"""Residual: log-odds of slip that linear weights cannot express, learned from similar grasps.

It is a Gaussian process. A told grasp is one with a known outcome. The residual's values at the
latest told grasps are part of the learner's state.
Rasmussen and Williams, Gaussian Processes for Machine Learning, 2006, chapter 2.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

GRASPS_MAX: Final = 128
"""Most told grasps with a residual in the state. Twice the number gains 0.5 points of F1, but an
outcome takes four times as long."""
SHARED_VARIANCE: Final = 9.0
"""Prior variance of the residual, log-odds squared, that grasps with equal inputs share."""
OWN_VARIANCE: Final = 0.009
"""Prior variance of the residual that is a grasp's own. No eigenvalue of the prior is smaller."""
REACH: Final = 0.5
"""Length scale: root mean square difference of inputs at which residuals correlate by 0.61."""

Vector = NDArray[np.float64]
Matrix = NDArray[np.float64]


class Residual:
    """Prior of the residual at N told grasps, oldest first, and predictions for other grasps.

    A state has W weights, then the residual at the told grasps, in the basis that predicts other
    grasps: a mean m (W + N,) and a spread S (W + N, W + N). With g, the features of the weights and
    then `shared`, the mean log-odds of a grasp are g @ m. Their variance is g @ S @ g plus
    `variance`, their covariance with those of another grasp g @ S @ g' plus the kernel. No inverse
    is needed: an outcome adds to S a product of one vector.
    """

    def __init__(self, grasps: Matrix) -> None:
        """`grasps`: inputs of the grasps with a known outcome, shape (N, inputs)."""
        inputs = grasps.shape[1]
        self.variance = SHARED_VARIANCE + OWN_VARIANCE if inputs else 0.0
        """Prior variance of the residual at any grasp; 0 without inputs, where none exists."""
        self._scale = -0.5 / (max(inputs, 1) * REACH**2)
        self.grasps, self._squares = np.empty((0, inputs)), np.empty(0)
        self.prior = np.empty((0, 0))
        """Prior covariance of the residual at the told grasps, shape (N, N)."""
        for each in grasps:
            self.add(each)

    def add(self, inputs: Vector) -> None:
        """Append a grasp with a known outcome; its place in a state is up to the caller.

        With zeros there in mean and spread, the others alone predict its residual.
        """
        # Not a matrix product, whose rounding depends on the other rows.
        squares = np.square(self.grasps - inputs).sum(axis=1, keepdims=True)
        shared = self._shared(squares)
        self.prior = np.block([[self.prior, shared], [shared.T, self.variance]])
        self.grasps = np.vstack((self.grasps, inputs))
        self._squares = np.append(self._squares, inputs @ inputs)

    def drop(self, mean: Vector, spread: Matrix) -> tuple[Vector, Matrix]:
        """Forget the oldest grasp; return the state without it. The others keep what it taught."""
        links = solve(self.prior[1:, 1:], self.prior[1:, 0])
        self.grasps, self._squares = self.grasps[1:], self._squares[1:]
        self.prior = self.prior[1:, 1:]
        oldest = len(mean) - len(links) - 1
        along = np.concatenate((np.zeros(oldest), links))
        row = np.delete(spread[oldest], oldest)
        crossed = np.outer(along, row + spread[oldest, oldest] / 2.0 * along)
        spread = np.delete(np.delete(spread, oldest, axis=0), oldest, axis=1)
        spread += crossed + crossed.T
        return np.delete(mean, oldest) + mean[oldest] * along, spread

    def limited(self, mean: Vector, limit: float) -> Vector:
        """Return a state's mean, changed in place: all weights, and the residuals of told grasps,
        are within +-`limit`."""
        weights = len(mean) - len(self.grasps)
        values = self.prior @ mean[weights:]
        if (np.abs(values) > limit).any():
            mean[weights:] = solve(self.prior, values.clip(-limit, limit))
        mean[:weights] = mean[:weights].clip(-limit, limit)
        return mean

    def at_told(self, mean: Vector, spread: Matrix) -> tuple[Vector, Matrix]:
        """Return mean and covariance of a state's weights, and of its residual at the grasps with a
        known outcome. `mean`, `spread`: the state."""
        links = self._links(len(mean))
        covariance = links @ spread @ links
        weights = len(mean) - len(self.grasps)
        covariance[weights:, weights:] += self.prior
        return links @ mean, (covariance + covariance.T) / 2.0

    def from_others(self, mean: Vector, covariance: Matrix) -> tuple[Vector, Matrix]:
        """Return mean and spread of the state whose `at_told` is `mean` and `covariance`."""
        back, covariance = np.linalg.inv(self._links(len(mean))), covariance.copy()
        weights = len(mean) - len(self.grasps)
        covariance[weights:, weights:] -= self.prior
        spread = back @ covariance @ back
        return back @ mean, (spread + spread.T) / 2.0

    def _links(self, size: int) -> Matrix:
        """Return the matrix that maps the mean of a state to weights and residual at told grasps.

        `size`: W + N.
        """
        links, weights = np.eye(size), size - len(self.grasps)
        links[weights:, weights:] = self.prior
        return links

    def shared(self, inputs: Vector) -> Vector:
        """Return the covariances (N,) of the residual at another grasp, of these `inputs`, with
        that at each grasp with a known outcome."""
        return self._shared(self._squares + inputs @ inputs - 2.0 * (self.grasps @ inputs))

    def _shared(self, squares: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return covariances of the residuals of grasps at these squared distances."""
        # Rounding leaves distances of equal grasps a little below 0.
        covariances: NDArray[np.float64] = np.exp(self._scale * np.maximum(squares, 0.0))
        return SHARED_VARIANCE * covariances


def solve(matrix: Matrix, values: Vector) -> Vector:
    """Return x (N,) of `matrix` @ x = `values`, positive definite, N up to 128.

    It is solved in halves, for which BLAS starts no threads: these may wait 100 ms for a processor.
    """
    half = len(matrix) // 2
    links, rest = matrix[:half, half:], matrix[half:, half:]
    first = np.linalg.solve(matrix[:half, :half], np.column_stack((links, values[:half])))
    products = links.T @ first
    second = np.linalg.solve(rest - products[:, :-1], values[half:] - products[:, -1])
    return np.concatenate((first[:, -1] - first[:, :-1] @ second, second))
