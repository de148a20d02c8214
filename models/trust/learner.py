"""Learns from outcomes of lifts how to correct a model's probability of slip for today's sensors.

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

from graspd.models.trust.residual import GRASPS_MAX, Matrix, Residual, Vector

TEMPERATURE: Final = 2.0
"""Divisor of the model's margin; networks are too sure of another day's grasps."""
SCALE: Final = 2.8
"""Factor on moderated log-odds, which are too near to 0 for new days, objects and poses.

With it, a tenth of the grasps with a `p_slip` of 0.1 slips. Fitted on the sessions of three
quarters of the objects it is 2.75 to 2.79. The slope of outcomes on scaled log-odds is 1.00 on the
others (`graspd report worth`, `worth` on the card of `small-session`).
"""
MARGIN_MAX: Final = 30.0
"""Largest magnitude of a margin, log-odds; larger ones are clipped. It corresponds to the smallest
probability of a network's float32 output that is not counted as 0."""
INPUT_MAX: Final = 1e3
"""Largest magnitude of an accepted input. Standardised features have a few units."""
MARGIN_SPREAD, BIAS_SPREAD, FEATURE_SPREAD = 0.5, 0.5, 0.2
"""Standard deviations of the prior: of the margin's weight, the bias, and each feature's weight."""
DRIFT: Final = 2e-3
"""Share of the prior's variances by which each outcome widens the posterior, so that learning fades
within some hundred lifts."""
MEAN_MAX: Final = 25.0
"""Largest mean of a weight, and of the residual (log-odds), whatever outcomes come: 50 times the
margin's standard deviation, 8 times the residual's."""
ROUNDING: Final = 1.0 + 1e-9
"""Factor by which a saved mean or variance may be above its limit."""

MOVE_MAX, WEIGHTS_MOVE_MAX = 1.25, 0.5
"""Most standard deviations by which one outcome moves its own grasp's mean log-odds: in total, and
by the weights alone. The weights also judge unlike grasps, on which one outcome says little.
Without these limits one false outcome turns slips of unlike grasps `stable`."""


class LearnerState(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """State of a learner: m of `Residual` as `mean` and its S as `covariance`; arrays are float64,
    little-endian, row by row."""

    outcomes: Annotated[int, msgspec.Meta(ge=0)]
    mean: bytes
    covariance: bytes
    grasps: bytes = b""
    """Inputs of the grasps with a known outcome whose residual is in the state."""


class Learner:
    """Turns a model's margin and input into log-odds of slip, and learns from outcomes.

    The state has the weights, then the residual at the latest grasps with an outcome. It stays
    bounded: an outcome lowers the covariance, then mixes `DRIFT` of the prior's into it. Hence no
    variance exceeds its prior's, and no eigenvalue is below `DRIFT` times the prior's smallest,
    10^8 times what rounding can take. The covariance stays exactly symmetric, because every step
    changes symmetric pairs alike. No mean exceeds `MEAN_MAX`.
    """

    def __init__(self, inputs: int) -> None:
        """Start at the prior of a model with `inputs` features; without any, no residual."""
        self.inputs = inputs
        """Number of features of the model."""
        self.scale = SCALE if inputs else TEMPERATURE
        """Factor on the moderated log-odds. Without inputs the start is the model's own."""
        prior = np.full(inputs + 2, FEATURE_SPREAD)
        prior[:2] = MARGIN_SPREAD, BIAS_SPREAD
        self._prior: Vector = prior**2
        """Variances of the weights before any outcome."""
        self.reset()

    def reset(self) -> None:
        """Forget all outcomes. Call when a sensor was exchanged."""
        self.outcomes = 0
        """Number of outcomes learned since the start or the last reset."""
        self._residual = Residual(np.empty((0, self.inputs)))
        self._mean, self._spread = np.zeros(self.inputs + 2), np.diag(self._prior)
        self._mean[0] = 1.0

    @property
    def uncertainty(self) -> float:
        """Mean ratio of the weights' variances to the prior's, from 1 at first towards 0."""
        variances = self._spread.diagonal()[: len(self._prior)]
        return min(float((variances / self._prior).mean()), 1.0)

    def judge(self, margin: float, inputs: NDArray[np.floating]) -> tuple[float, Vector]:
        """Return log-odds of slip and the features for `learn`.

        The less is known of such grasps, the nearer the log-odds are to 0. `margin`: the model's
        log-odds of slip, before a young session softens them. `inputs`: its input, shape (inputs,),
        such as standardised features. Raises `ValueError` for another shape, and for values that
        are not finite or too large.
        """
        if inputs.shape != (self.inputs,):
            raise ValueError(f"inputs are of shape {inputs.shape}, not ({self.inputs},)")
        is_within = 0 not in (np.abs(inputs) <= INPUT_MAX).tobytes()  # false for NaN
        if not (is_within and math.isfinite(margin)):
            raise ValueError("margin or inputs are not finite, or too large")
        limited = min(max(margin, -MARGIN_MAX), MARGIN_MAX)
        features = np.concatenate(([limited / TEMPERATURE, 1.0], inputs))
        known = self._known(features)
        variance = known.dot(self._spread.dot(known)).item() + self._residual.variance
        moderation = math.sqrt(1.0 + math.pi / 8.0 * variance)  # MacKay's moderated output
        return self.scale * known.dot(self._mean).item() / moderation, features

    def _known(self, features: Vector) -> Vector:
        if not len(self._residual.grasps):
            return features
        return np.concatenate((features, self._residual.shared(features[2:])))

    def learn(self, features: Vector, *, slipped: bool) -> None:
        """Learn the outcome of a grasp for which `judge` returned `features`; takes 0.5 to 1 ms."""
        residual, weights = self._residual, slice(len(features))
        mean, known = self._mean, self._known(features)
        seen = self._spread @ known
        log_odds, variance = float(known @ mean), float(known @ seen) + residual.variance
        if self.inputs:
            residual.add(features[2:])
            mean, seen = np.append(mean, 0.0), np.append(seen, 1.0)
        spread = np.zeros((len(mean), len(mean)))
        spread[: len(self._mean), : len(self._mean)] = self._spread
        p_slip = sigmoid(log_odds)
        weight = p_slip * (1.0 - p_slip)
        gain = 1.0 / (1.0 + weight * variance)
        step = gain * (slipped - p_slip)
        limit = MOVE_MAX / math.sqrt(variance)
        step = min(max(step, -limit), limit)
        move = step * seen
        by_weights = math.sqrt(float(features @ (spread[weights, weights] @ features)))
        move[weights] /= max(abs(step) * by_weights / WEIGHTS_MOVE_MAX, 1.0)
        known_now = math.sqrt(weight * gain) * seen
        spread -= np.outer(known_now, known_now)
        spread *= 1.0 - DRIFT
        np.einsum("ii->i", spread)[weights] += DRIFT * self._prior
        mean = mean + move
        if len(residual.grasps) > GRASPS_MAX:
            mean, spread = residual.drop(mean, spread)
        self._mean, self._spread = residual.limited(mean, MEAN_MAX), spread
        self.outcomes += 1

    def at_told(self) -> tuple[Vector, Matrix]:
        """Return mean and covariance of the weights, then of the residual at learned grasps."""
        return self._residual.at_told(self._mean, self._spread)

    def state(self) -> LearnerState:
        """Return the state for `restore`."""
        arrays = self._mean, self._spread, self._residual.grasps
        return LearnerState(self.outcomes, *(each.astype("<f8").tobytes() for each in arrays))

    def restore(self, state: LearnerState) -> None:
        """Continue from a state. Raises `ValueError`, and changes nothing, if it does not fit."""
        count = min(state.outcomes, GRASPS_MAX) if self.inputs else 0
        size = self.inputs + 2 + count
        grasps = vector(state.grasps, count * self.inputs, INPUT_MAX).reshape(count, self.inputs)
        mean = vector(state.mean, size)
        spread = vector(state.covariance, size**2, INPUT_MAX).reshape(size, size)
        residual = Residual(grasps)
        means, covariance = residual.at_told(mean, spread)
        if (np.abs(means) > MEAN_MAX * ROUNDING).any():
            raise ValueError("holds means that are too large")
        highest = np.append(self._prior, np.full(count, residual.variance)) * ROUNDING
        if (spread != spread.T).any() or (covariance.diagonal() > highest).any():
            raise ValueError("holds no covariance matrix, or knows less than the prior")
        try:
            np.linalg.cholesky(covariance)
        except np.linalg.LinAlgError as error:
            raise ValueError("holds no covariance matrix") from error
        self.outcomes = state.outcomes
        self._residual, self._mean, self._spread = residual, mean, spread


def of_format_2(state: LearnerState) -> LearnerState:
    """Convert a state of format 2, whose mean and covariance are those that `Learner.at_told`
    returns. Raises `ValueError`."""
    mean, grasps = (np.frombuffer(each, "<f8") for each in (state.mean, state.grasps))
    size, count = len(mean), min(state.outcomes, GRASPS_MAX)
    residual = Residual(grasps.reshape(count, -1) if state.grasps else np.empty((0, size - 2)))
    covariance = np.frombuffer(state.covariance, "<f8").reshape(size, size)
    mean, spread = residual.from_others(mean, covariance)
    return LearnerState(state.outcomes, mean.tobytes(), spread.tobytes(), state.grasps)


def sigmoid(log_odds: float) -> float:
    """Return the probability of these log-odds."""
    small = math.exp(-abs(log_odds))  # the exponent is never positive, so nothing overflows
    return (1.0 if log_odds >= 0.0 else small) / (1.0 + small)


def vector(data: bytes, width: int, limit: float = math.inf) -> Vector:
    """Return the little-endian float64 values of `data`, shape (width,).

    Raises `ValueError` for another length, and for values not finite or beyond +-`limit`.
    """
    if len(data) != 8 * width:
        raise ValueError(f"is of {len(data) // 8} values, not of {width}")
    values = np.frombuffer(data, "<f8").astype(np.float64)
    if not (np.isfinite(values) & (np.abs(values) <= limit)).all():
        raise ValueError("holds numbers that are not finite, or too large")
    return values
