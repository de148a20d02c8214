"""Running statistics of a session's own, unlabelled grasps, which follow drifting sensors.

A session lasts from one exchange of a sensor to the next. Its statistics standardise the input of
session models, so that the network sees values like those of its training days.
"""

from __future__ import annotations

import itertools
from operator import getitem
from typing import Annotated

import msgspec
import numpy as np
from numpy.typing import NDArray

HORIZON_GRASPS = 300.0
"""Largest weight of the statistics, grasps; older grasps fade.

Without it, 400 grasps of one object would bias the next thousand. It also lets the statistics
follow the slow drift of a new sensor.
"""
REPEAT_DISTANCE, REPEAT_IN_PRIOR = 0.05, 0.15
"""Distances from the last grasp below which a reading is the same grasp again.

A distance is the root mean square of the differences, each in units of its value's spread. The
first limit is in spreads of the session, the second in those of the training: the session's own
shrink with each repetition. Noise of 5 counts gives at most 0.11 of the training's spreads; 98 of
100 grasps of one object differ by more than the limit.
"""
BALANCED_FROM = 20
"""Grasps after which verdicts are good enough to balance stable grasps and slips."""
SHARE_GRASPS = 50.0
"""Number of latest grasps over which the share of slips is averaged."""
LEAST_WEIGHT = 0.02
"""Smallest weight of a grasp that was not judged stable; above zero, so that a session that began
wrongly recovers."""

SPREAD_RATIOS = (0.2, 3.0)
"""Smallest and largest median spread of a finger's electrodes, in units of the training's.

After twenty grasps of the published tables it is 0.4 to 1.5; for a dead finger it is 0.06.
"""
AWAY_MAX = 8.0
"""Largest distance of a session's mean from the training's, in the training's spreads.

The distance is the root mean square over all electrodes. On the published days it is 1.3 to 4.1.
"""
AWAY_MIN, ORDER_RATIO = 1.0, 1.2
"""Fingers count as swapped above this distance, if another order is this factor nearer.

The distance is that of `AWAY_MAX`. On the published days the right order is nearer by a factor of
1.5 to 2.6.
"""


class SessionState(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Statistics as kept between two starts of the daemon."""

    weight: Annotated[float, msgspec.Meta(ge=0.0, le=HORIZON_GRASPS)]
    """Weight of the sums, grasps, at most `HORIZON_GRASPS`."""
    grasps: Annotated[int, msgspec.Meta(ge=0)]
    """Number of all grasps."""
    mean: tuple[float, ...]
    squares: tuple[Annotated[float, msgspec.Meta(ge=0.0)], ...]
    """Sum over the grasps of weight times squared deviation from `mean`, of each value."""
    slip_share: Annotated[float, msgspec.Meta(ge=0.0, le=1.0)] = 0.5
    """Share of slips among the latest grasps, by their verdicts."""
    last: tuple[float, ...] | None = None
    """Values of the last grasp, so that a held grasp is not taken in twice; None: no grasp yet."""


class SessionStatistics:
    """Running mean and spread of vectors, by Welford's method, with a weak prior.

    Each vector has the shape of the prior, (width,). Memory is constant and all numbers stay
    bounded. Rounding errors fade with old grasps, so the relative error of mean and spread stays
    below 1e-10 (4e-15 after a billion grasps, `graspd report stability`). The prior keeps each
    spread above zero, even of an electrode that never moves.
    """

    def __init__(
        self,
        prior_mean: NDArray[np.float64],
        prior_spread: NDArray[np.float64],
        prior_grasps: float = 1.0,
    ) -> None:
        """Start from the training's statistics, with the weight of `prior_grasps` grasps.

        Raises `ValueError` unless the spreads and the weight are above zero.
        """
        if not (np.all(prior_spread > 0.0) and prior_grasps > 0.0):
            raise ValueError("prior spreads and weight must be above zero")
        self._prior_mean = prior_mean
        self._prior_spread = prior_spread
        self._prior_variance = prior_spread**2
        self._prior_grasps = prior_grasps
        self.reset()

    def reset(self) -> None:
        """Forget the session. Call when a sensor was exchanged."""
        self.grasps = 0
        self._weight = 0.0
        self._mean = np.zeros_like(self._prior_mean)
        self._squares = np.zeros_like(self._prior_mean)
        self._slip_share = 0.5
        self._last: NDArray[np.float64] | None = None
        self._settle()

    def observe(self, values: NDArray[np.float64], *, slip: bool | None = None) -> bool:
        """Take in one grasp; ignore it, and return False, if it repeats the last or is not finite.

        `slip`: its verdict; None: not judged. Among many slips each weighs less, because a
        mean that moves to the slips would make the next slip look stable.
        """
        if 0 in np.isfinite(values).tobytes() or self._is_held(values):
            return False
        self._last = values.copy()
        weight = self._balance(slip)
        self.grasps += 1
        self._weight += weight
        deviation = values - self._mean
        self._mean += deviation * (weight / self._weight)
        self._squares += weight * deviation * (values - self._mean)
        if self._weight > HORIZON_GRASPS:
            self._squares *= HORIZON_GRASPS / self._weight
            self._weight = HORIZON_GRASPS
        self._settle()
        return True

    def state(self) -> SessionState:
        """Return the state for `restore`."""
        return SessionState(
            self._weight,
            self.grasps,
            tuple(self._mean.tolist()),
            tuple(self._squares.tolist()),
            self._slip_share,
            None if self._last is None else tuple(self._last.tolist()),
        )

    def restore(self, state: SessionState) -> None:
        """Continue from an earlier state. Raises `ValueError` if it does not fit."""
        mean, squares = np.array(state.mean), np.array(state.squares)
        last = mean if state.last is None else np.array(state.last)
        if not mean.shape == squares.shape == last.shape == self._prior_mean.shape:
            raise ValueError(f"is of {len(mean)} values, not of {len(self._prior_mean)}")
        if not np.isfinite((mean, squares, last)).all():
            raise ValueError("holds numbers that are not finite")
        least = min(state.grasps, BALANCED_FROM + LEAST_WEIGHT * (state.grasps - BALANCED_FROM))
        if not min(least, HORIZON_GRASPS) <= state.weight <= state.grasps:
            raise ValueError(f"says that {state.grasps} grasps weigh {state.weight:g}")
        self.reset()
        self.grasps, self._weight = state.grasps, state.weight
        self._mean, self._squares, self._slip_share = mean, squares, state.slip_share
        self._last = None if state.last is None else last
        self._settle()

    def _balance(self, slip: bool | None) -> float:
        """Return the weight of the next grasp, and count its verdict from the 21st grasp on.

        The weight is below 1 if most are slips and this grasp was not judged stable.
        """
        if self.grasps < BALANCED_FROM:
            return 1.0
        if slip is not None:
            self._slip_share += (slip - self._slip_share) / SHARE_GRASPS
        if slip is False or self._slip_share <= 0.5:
            return 1.0
        return max(((1.0 - self._slip_share) / self._slip_share) ** 2, LEAST_WEIGHT)

    def _is_held(self, values: NDArray[np.float64]) -> bool:
        if self._last is None:
            return False
        step = values - self._last
        kinds = (self.spread, REPEAT_DISTANCE), (self._prior_spread, REPEAT_IN_PRIOR)
        return any(_mean_square(step / spread) < distance**2 for spread, distance in kinds)

    def _settle(self) -> None:
        """Update mean and spread, with the prior as `prior_grasps` grasps around its mean."""
        total = self._weight + self._prior_grasps
        share = self._prior_grasps / total
        self.mean: NDArray[np.float64] = share * self._prior_mean + (1.0 - share) * self._mean
        self.spread: NDArray[np.float64] = np.sqrt(
            share * self._prior_variance + self._squares / total
        )


def is_odd(
    mean: NDArray[np.float64],
    spread: NDArray[np.float64],
    training_mean: NDArray[np.float64],
    training_spread: NDArray[np.float64],
    *,
    enough: bool,
) -> bool:
    """Return True if a session cannot have come from grasps of these fingers.

    There are three cases: the sensors are far off; fingers are swapped; a finger's spread is too
    small or too large, which is tested if `enough` is True (enough grasps). Mean and spread of each
    electrode, in session and training: counts, shape (fingers, 24).
    """
    ratio = np.sort(spread / training_spread, axis=1)
    middle = ratio.shape[1] // 2
    ratios = ((ratio[:, (ratio.shape[1] - 1) // 2] + ratio[:, middle]) / 2.0).tolist()  # the median
    least, most = SPREAD_RATIOS
    # Distance of each finger of the session from each of the training.
    deviations = (mean[:, np.newaxis] - training_mean) / training_spread
    away = np.add.reduce(np.square(deviations), axis=2) / mean.shape[1]
    rows: list[list[float]] = away.tolist()
    own, *others = (
        sum(map(getitem, rows, order)) for order in itertools.permutations(range(len(rows)))
    )
    if enough and not all(least <= each <= most for each in ratios):
        return True
    exchanged = own > ORDER_RATIO**2 * min(others, default=own) and own > len(away) * AWAY_MIN**2
    return exchanged or not own <= len(away) * AWAY_MAX**2


def _mean_square(values: NDArray[np.float64]) -> float:
    return float(values.dot(values)) / len(values)
