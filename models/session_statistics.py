"""Running statistics of a session's own, unlabelled grasps: what a drifted sensor's zero is now.

A session lasts from one exchange of a sensor to the next. Its statistics standardise the input of
session models, so that a network trained on other days sees what it knows.
"""

from __future__ import annotations

import math
from typing import Annotated

import msgspec
import numpy as np
from numpy.typing import NDArray

HORIZON_GRASPS = 300.0
"""Older grasps fade once so many have been seen. Without it, 400 grasps of one object would bias
the next thousand; with it the session forgets them, and a fresh sensor's slow drift is followed."""
REPEAT_DISTANCE = 0.05
"""A reading that is nearer to the last one than this (root mean square, in spreads) is the same
grasp still held: the sensor's noise alone moves it by 0.02."""

SPREAD_RATIOS = (0.2, 3.0)
"""Electrodes of a finger vary, in the median, by so many times the training's, or no grasps came:
by 0.7 to 1.3 times from twenty grasps of the published tables on; those of a dead finger by 0.06
times."""


class SessionState(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Statistics as they are kept between two starts of the daemon."""

    weight: Annotated[float, msgspec.Meta(ge=0.0, le=HORIZON_GRASPS)]
    """Grasps that the sums stand for, at most `HORIZON_GRASPS`."""
    grasps: Annotated[int, msgspec.Meta(ge=0)]
    """Grasps seen in all."""
    mean: tuple[float, ...]
    squares: tuple[Annotated[float, msgspec.Meta(ge=0.0)], ...]
    """Sum of the squared deviations from the mean."""
    last: tuple[float, ...] | None = None
    """The grasp that was taken in last: still held, it is not taken in again."""


class SessionStatistics:
    """Mean and spread of vectors that come one by one, by Welford's method, with a weak prior.

    Every vector has the shape of the prior, (width,). Constant memory; numbers stay bounded however
    many grasps come. Rounding errors fade with the grasps that made them, so mean and spread keep a
    relative error below 1e-10 (4e-15 after a billion grasps, `graspd report stability`). The prior
    keeps a spread above zero, even of an electrode that never moves.
    """

    def __init__(
        self,
        prior_mean: NDArray[np.float64],
        prior_spread: NDArray[np.float64],
        prior_grasps: float = 1.0,
    ) -> None:
        """Start from the training's statistics, which weigh `prior_grasps` grasps.

        Raises `ValueError` unless the spreads and the weight are above zero.
        """
        if not (np.all(prior_spread > 0.0) and prior_grasps > 0.0):
            raise ValueError("prior spreads and weight must be above zero")
        self._prior_mean = prior_mean
        self._prior_spread = prior_spread
        self._prior_grasps = prior_grasps
        self.reset()

    def reset(self) -> None:
        """Forget the session: a sensor was exchanged."""
        self.grasps = 0
        self._weight = 0.0
        self._mean = np.zeros_like(self._prior_mean)
        self._squares = np.zeros_like(self._prior_mean)
        self._last: NDArray[np.float64] | None = None
        self._settle()

    def observe(self, values: NDArray[np.float64]) -> bool:
        """Take in one grasp; False if it is the one before, still held, or is not finite."""
        if not np.isfinite(values).all() or self._is_held(values):
            return False
        self._last = values.copy()
        self.grasps += 1
        self._weight += 1.0
        deviation = values - self._mean
        self._mean += deviation / self._weight
        self._squares += deviation * (values - self._mean)
        if self._weight > HORIZON_GRASPS:
            self._squares *= HORIZON_GRASPS / self._weight
            self._weight = HORIZON_GRASPS
        self._settle()
        return True

    def state(self) -> SessionState:
        """What `restore` needs."""
        return SessionState(
            self._weight,
            self.grasps,
            tuple(self._mean.tolist()),
            tuple(self._squares.tolist()),
            None if self._last is None else tuple(self._last.tolist()),
        )

    def restore(self, state: SessionState) -> None:
        """Go on from an earlier state. Raises `ValueError` if it is of another kind of vector."""
        mean, squares = np.array(state.mean), np.array(state.squares)
        last = mean if state.last is None else np.array(state.last)
        if not mean.shape == squares.shape == last.shape == self._prior_mean.shape:
            raise ValueError(f"is of {len(mean)} values, not of {len(self._prior_mean)}")
        if not np.isfinite((mean, squares, last)).all():
            raise ValueError("holds numbers that are not finite")
        if state.weight != min(state.grasps, HORIZON_GRASPS):
            raise ValueError(f"says that {state.grasps} grasps weigh {state.weight:g}")
        self.reset()
        self.grasps, self._weight = state.grasps, state.weight
        self._mean, self._squares = mean, squares
        self._last = None if state.last is None else last
        self._settle()

    def _is_held(self, values: NDArray[np.float64]) -> bool:
        if self._last is None:
            return False
        steps = (values - self._last) / self.spread
        return math.sqrt(float(steps @ steps) / len(steps)) < REPEAT_DISTANCE

    def _settle(self) -> None:
        """Blend session and prior, as if the prior were `prior_grasps` grasps around its mean."""
        total = self._weight + self._prior_grasps
        share = self._prior_grasps / total
        self.mean: NDArray[np.float64] = share * self._prior_mean + (1.0 - share) * self._mean
        self.spread: NDArray[np.float64] = np.sqrt(
            share * self._prior_spread**2 + self._squares / total
        )


def is_odd(spread: NDArray[np.float64], training_spread: NDArray[np.float64]) -> bool:
    """Whether what a session took in cannot have been grasps: a finger is dead or sees noise alone.

    Of the spreads of each electrode in the session and in the training, counts, (fingers, 24).
    """
    ratio = np.median(spread / training_spread, axis=1)
    least, most = SPREAD_RATIOS
    return not bool(((ratio >= least) & (ratio <= most)).all())
