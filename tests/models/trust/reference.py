"""An independent learner for comparison: weights and the residual at all grasps of a stream.

It knows all grasps from the start, is dense, and in long double.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Number = np.longdouble
Exact = NDArray[np.longdouble]
MARGIN_SPREAD, BIAS_SPREAD, FEATURE_SPREAD = Number("0.5"), Number("0.5"), Number("0.2")
TEMPERATURE, SCALE, DRIFT = Number("2"), Number("2.8"), Number("0.002")
MOVE_MAX, WEIGHTS_MOVE_MAX = Number("1.25"), Number("0.5")
"""Most standard deviations by which an outcome moves its grasp's log-odds: in all, by weights."""
SHARED, OWN, REACH = Number("9"), Number("0.009"), Number("0.5")
"""Variances of the residual, shared and a grasp's own, and the length scale of its kernel."""
PI = Number("3.14159265358979323846264338327950288")


class Reference:
    """Reference learner: `mean`, `covariance` of its weights, then of each grasp's residual."""

    def __init__(
        self, margins: list[float], inputs: NDArray[np.float32], drift: Number = DRIFT
    ) -> None:
        exact = inputs.astype(Number)
        count, width = exact.shape
        linear = np.hstack((np.array(margins, Number)[:, None] / TEMPERATURE, np.ones((count, 1))))
        self.features = np.hstack((linear, exact, np.eye(count, dtype=Number)))
        spreads = [MARGIN_SPREAD, BIAS_SPREAD, *[FEATURE_SPREAD] * width]
        self.prior = np.diag(np.array([*spreads, *[Number(0)] * count]) ** 2)
        for i in range(count if width else 0):
            for j in range(count):
                mean_square = ((exact[i] - exact[j]) ** 2).mean()
                alike = SHARED * np.exp(-mean_square / (2 * REACH**2))
                self.prior[width + 2 + i, width + 2 + j] = alike + OWN * (i == j)
        self.mean = np.zeros(len(self.prior), Number)
        self.mean[0] = 1
        self.covariance = self.prior.copy()
        self.scale = SCALE if width else TEMPERATURE
        self.weights, self.drift = list(range(width + 2)), drift

    def log_odds(self, grasp: int) -> float:
        h = self.features[grasp]
        variance = h @ (self.covariance @ h)
        return float(self.scale * (h @ self.mean) / np.sqrt(1 + PI / 8 * variance))

    def learn(self, grasp: int, slipped: bool) -> None:
        h = self.features[grasp]
        p = 1 / (1 + np.exp(-(h @ self.mean)))
        before, seen = self.covariance.copy(), self.covariance @ h
        # Kalman's gain, with the information p (1 - p) of an outcome as its inverse noise.
        gain = seen / (h @ seen + 1 / (p * (1 - p)))
        self.covariance -= np.outer(gain, seen)
        move = gain * (slipped - p) / (p * (1 - p))
        in_spreads = np.abs(h @ move) / np.sqrt(h @ seen)
        move *= min(MOVE_MAX / in_spreads, 1)
        here = np.ix_(self.weights, self.weights)
        by_weights = h[self.weights] @ before[here] @ h[self.weights]
        share = np.sqrt(by_weights / (h @ seen)) * min(in_spreads, MOVE_MAX)
        move[self.weights] *= min(WEIGHTS_MOVE_MAX / share, 1)
        self.mean += move
        self.covariance += self.drift * (self.prior - self.covariance)

    def keep(self, told: list[int]) -> None:
        """Keep the weights and the residual at the grasps `told`; derive all others from these."""
        self.go_on(told, *self.state(told))

    def go_on(self, told: list[int], mean: Exact, covariance: Exact) -> None:
        """Continue from what `state(told)` of another `Reference` returned."""
        kept = [*self.weights, *(len(self.weights) + grasp for grasp in told)]
        links = self.prior[:, kept] @ inverse(self.prior[np.ix_(kept, kept)])
        left = self.prior - links @ self.prior[kept]
        self.mean = links @ mean
        self.covariance = links @ covariance @ links.T + left

    def state(self, told: list[int]) -> tuple[Exact, Exact]:
        """Mean and covariance of the weights, and of the residual at the grasps `told`, which are
        numbers in the stream."""
        kept = [*self.weights, *(len(self.weights) + grasp for grasp in told)]
        return self.mean[kept], self.covariance[np.ix_(kept, kept)]


def inverse(matrix: Exact) -> Exact:
    """Return the inverse of a positive definite matrix by Gauss and Jordan, without pivoting."""
    size = len(matrix)
    rows = np.hstack((matrix, np.eye(size, dtype=Number)))
    for k in range(size):
        rows[k] /= rows[k, k]
        others = np.arange(size) != k
        rows[others] -= np.outer(rows[others, k], rows[k])
    return rows[:, size:]
