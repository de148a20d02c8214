"""Learns from how lifts ended what a model's probability of slip is worth with today's sensors.

Logistic regression, recursive and Bayesian: the weights have a Gaussian posterior, which each
outcome updates once (one step of an extended Kalman filter, a Laplace approximation) and which
slowly widens again, so that old lifts are forgotten. It starts at the model's own opinion.
"""

from __future__ import annotations

import math
from typing import Annotated, Final

import msgspec
import numpy as np
from numpy.typing import NDArray

TEMPERATURE: Final = 1.5
"""Divisor of the model's margin; networks are too sure of another day's grasps."""
SCALE: Final = 1.6
"""Factor of moderated log-odds, which are too timid on days, objects and poses that are new.

With it, a tenth of the grasps with a `p_slip` of 0.1 slips. Fitted on the sessions of three
quarters of the objects it is 1.61 to 1.69. The slope of outcomes on scaled log-odds is 1.00 on the
others (`graspd report worth`, `worth` on the card of `small-session`).
"""
MARGIN_MAX: Final = 30.0
"""Larger margins, log-odds, say no more: the logarithm of the smallest probability that a network's
float32 output is taken for."""
INPUT_MAX: Final = 1e3
"""Larger inputs are refused: standardised features have a few units."""
MARGIN_SPREAD, BIAS_SPREAD, FEATURE_SPREAD = 0.3, 0.5, 0.3
"""Standard deviations of the prior: of the margin's weight, the bias, and each feature's weight."""
DRIFT: Final = 2e-3
"""Share of the prior's variances by which an outcome widens the posterior: what was learned fades
within some hundred lifts."""
MEAN_SPREADS_MAX: Final = 50.0
"""A weight stays within this many standard deviations of its prior, whatever is told."""

Vector = NDArray[np.float64]


class LearnerState(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """State of a learner; arrays are float64, little-endian, row by row."""

    outcomes: Annotated[int, msgspec.Meta(ge=0)]
    mean: bytes
    covariance: bytes


class Learner:
    """Turns a model's margin and input into log-odds of slip, and learns from outcomes.

    Bounded for ever: no variance exceeds its prior's, no weight leaves `MEAN_SPREADS_MAX`. The
    covariance stays exactly symmetric, because every step multiplies symmetric pairs by the same
    number. It stays positive definite: subtracting what an outcome tells leaves it so, adding the
    drift lifts its smallest eigenvalue to `DRIFT` of the smallest prior variance, 10^11 times what
    rounding can take, and the cap scales rows and columns alike, by no less than
    1 / sqrt(1 + DRIFT).
    """

    def __init__(self, inputs: int) -> None:
        """Start at the prior of a model with `inputs` features."""
        self._width = inputs + 2
        self.scale = SCALE
        """Factor on the moderated log-odds."""
        self._prior_mean = np.zeros(self._width)
        self._prior_mean[0] = 1.0
        spread = np.full(self._width, FEATURE_SPREAD)
        spread[:2] = MARGIN_SPREAD, BIAS_SPREAD
        self._prior_variance = spread**2
        self._drift = DRIFT * self._prior_variance
        self._low = self._prior_mean - MEAN_SPREADS_MAX * spread
        self._high = self._prior_mean + MEAN_SPREADS_MAX * spread
        self.reset()

    def reset(self) -> None:
        """Forget all outcomes: a sensor was exchanged."""
        self.outcomes = 0
        """Number of outcomes learned since the start or the last reset."""
        self._mean = self._prior_mean.copy()
        self._covariance = np.diag(self._prior_variance)
        self._is_prior = True

    @property
    def uncertainty(self) -> float:
        """Mean ratio of the weights' variances to the prior's, from 1 at first towards 0."""
        ratio = self._covariance.diagonal() / self._prior_variance
        return min(float(ratio.mean()), 1.0)

    def judge(self, margin: float, inputs: NDArray[np.floating]) -> tuple[float, Vector]:
        """Return log-odds of slip, nearer to 0 the less is known of such grasps, and features.

        `margin` is the model's log-odds of slip, before a young session softens them; `inputs`
        (inputs,) what the model was given, as standardised features of a session. `learn` takes the
        features once the outcome is known. Raises `ValueError` for another shape, and for what is
        not finite or too large.
        """
        if inputs.shape != (self._width - 2,):
            raise ValueError(f"inputs are of shape {inputs.shape}, not ({self._width - 2},)")
        is_within = (np.abs(inputs) <= INPUT_MAX).all()  # false for NaN
        if not (is_within and math.isfinite(margin)):
            raise ValueError("margin or inputs are not finite, or too large")
        limited = min(max(margin, -MARGIN_MAX), MARGIN_MAX)
        features = np.concatenate(([limited / TEMPERATURE, 1.0], inputs))
        # The prior's covariance is diagonal: the same in a third of the time.
        prior = self._prior_variance if self._is_prior else None
        seen = self._covariance @ features if prior is None else prior * features
        variance = float(features @ seen)
        moderation = math.sqrt(1.0 + math.pi / 8.0 * variance)  # MacKay's moderated output
        return self.scale * float(features @ self._mean) / moderation, features

    def learn(self, features: Vector, *, slipped: bool) -> None:
        """Take in how the lift of a grasp with these features ended."""
        seen = self._covariance @ features
        variance = float(features @ seen)
        p_slip = sigmoid(float(features @ self._mean))
        weight = p_slip * (1.0 - p_slip)
        gain = 1.0 / (1.0 + weight * variance)
        self._mean += gain * (slipped - p_slip) * seen
        np.minimum(np.maximum(self._mean, self._low, out=self._mean), self._high, out=self._mean)
        self._covariance -= weight * gain * np.outer(seen, seen)
        diagonal = np.einsum("ii->i", self._covariance)  # a view
        diagonal += self._drift
        scale = np.sqrt(np.minimum(self._prior_variance / diagonal, 1.0))
        self._covariance *= np.outer(scale, scale)
        self._is_prior = False
        self.outcomes += 1

    def state(self) -> LearnerState:
        """Return the state for `restore`."""
        mean, covariance = self._mean.astype("<f8"), self._covariance.astype("<f8")
        return LearnerState(self.outcomes, mean.tobytes(), covariance.tobytes())

    def restore(self, state: LearnerState) -> None:
        """Go on from an earlier state. Raises `ValueError`, and changes nothing, if it is none."""
        mean = vector(state.mean, self._width)
        covariance = vector(state.covariance, self._width**2).reshape(self._width, self._width)
        if not ((mean >= self._low) & (mean <= self._high)).all():
            raise ValueError("holds weights that no outcomes lead to")
        if not (covariance.diagonal() <= self._prior_variance * (1.0 + 1e-9)).all():
            raise ValueError("knows less than before the first outcome")
        if (covariance != covariance.T).any() or not _is_positive_definite(covariance):
            raise ValueError("holds a matrix that is no covariance")
        self.outcomes, self._mean, self._covariance = state.outcomes, mean, covariance
        self._is_prior = False


def sigmoid(log_odds: float) -> float:
    """Return the probability of these log-odds."""
    small = math.exp(-abs(log_odds))  # of a negative number only: never overflows
    return (1.0 if log_odds >= 0.0 else small) / (1.0 + small)


def vector(data: bytes, width: int) -> Vector:
    """Return float64 values (width,). Raises `ValueError` if not finite or of another length."""
    if len(data) != 8 * width:
        raise ValueError(f"is of {len(data) // 8} values, not of {width}")
    values = np.frombuffer(data, "<f8").astype(np.float64)
    if not np.isfinite(values).all():
        raise ValueError("holds numbers that are not finite")
    return values


def _is_positive_definite(matrix: NDArray[np.float64]) -> bool:
    try:
        np.linalg.cholesky(matrix)
    except np.linalg.LinAlgError:
        return False
    return True
