"""The learner once more, independently: in information form, in long double, by plain loops."""

from __future__ import annotations

import numpy as np

Number = np.longdouble
SPREADS = (0.3, 0.5)
FEATURE_SPREAD, TEMPERATURE, DRIFT = 0.3, 1.5, 2e-3
SCALE = Number("1.6")
MODERATION = np.longdouble("0.392699081698724154807830422909937860524646174921888")
"""Pi / 8."""


class Reference:
    """Weights with mean `mean` and covariance `covariance`, lists of long doubles."""

    def __init__(self, inputs: int, drift: float = DRIFT) -> None:
        spreads = [*SPREADS, *([FEATURE_SPREAD] * inputs)]
        self.prior = [Number(spread) ** 2 for spread in spreads]
        self.drift = Number(drift)
        self.mean = [Number(1), *([Number(0)] * (inputs + 1))]
        size = range(inputs + 2)
        self.covariance = [[self.prior[i] if i == j else Number(0) for j in size] for i in size]

    def features(self, margin: float, inputs: list[float]) -> list[Number]:
        return [Number(margin) / Number(TEMPERATURE), Number(1), *map(Number, inputs)]

    def log_odds(self, features: list[Number]) -> Number:
        size = range(len(features))
        variance = sum(
            (features[i] * self.covariance[i][j] * features[j] for i in size for j in size),
            Number(0),
        )
        moderated: Number = SCALE * self._middle(features) / np.sqrt(1 + MODERATION * variance)
        return moderated

    def learn(self, features: list[Number], slipped: bool) -> None:
        size = range(len(features))
        p = 1 / (1 + np.exp(-self._middle(features)))
        information = inverse(self.covariance)
        for i in size:
            for j in size:
                information[i][j] += p * (1 - p) * features[i] * features[j]
        covariance = inverse(information)
        error = Number(slipped) - p
        for i in size:
            step = sum((covariance[i][j] * features[j] for j in size), Number(0))
            self.mean[i] += step * error
        for i in size:
            covariance[i][i] += self.drift * self.prior[i]
        scale = [
            np.sqrt(min(self.prior[i] / covariance[i][i], Number(1))) if self.drift else Number(1)
            for i in size
        ]
        self.covariance = [[scale[i] * covariance[i][j] * scale[j] for j in size] for i in size]

    def _middle(self, features: list[Number]) -> Number:
        pairs = zip(self.mean, features, strict=True)
        return sum((weight * value for weight, value in pairs), Number(0))


def inverse(matrix: list[list[Number]]) -> list[list[Number]]:
    """By Gauss and Jordan, of a positive definite matrix: no pivoting is needed."""
    size = len(matrix)
    rows = [[*row, *(Number(i == j) for j in range(size))] for i, row in enumerate(matrix)]
    for k in range(size):
        pivot = rows[k][k]
        rows[k] = [value / pivot for value in rows[k]]
        for i in range(size):
            if i != k:
                factor = rows[i][k]
                rows[i] = [a - factor * b for a, b in zip(rows[i], rows[k], strict=True)]
    return [row[size:] for row in rows]
