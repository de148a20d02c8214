"""Running statistics of a session's own, unlabelled grasps: what a drifted sensor's zero is now.

A session lasts from one exchange of a sensor to the next. Its statistics standardise the input of
session models, so that a network trained on other days sees what it knows.
"""

from __future__ import annotations

import itertools
from operator import getitem
from typing import Annotated

import msgspec
import numpy as np
from numpy.typing import NDArray

HORIZON_GRASPS = 300.0
"""Grasps after which older ones fade. Without it, 400 grasps of one object would bias
the next thousand; with it the session forgets them, and a fresh sensor's slow drift is followed."""
REPEAT_DISTANCE, REPEAT_IN_PRIOR = 0.05, 0.15
"""A reading that is nearer to the last one than this (root mean square, in the session's spreads or
in the training's) is the same grasp again: the session's own fall with every repetition. Noise of 5
counts moves it by 0.11 of the training's at most; of 100 grasps of one object 98 differ by more."""
BALANCED_FROM = 20
"""Grasps from which on verdicts are sound enough to tell what a session is made of."""
SHARE_GRASPS = 50.0
"""Grasps over which the share of slips is counted."""
LEAST_WEIGHT = 0.02
"""Of a slip where nearly all are slips: so a session that began wrongly finds back."""

SPREAD_RATIOS = (0.2, 3.0)
"""Least and largest spread of a finger's electrodes (median) over the training's in a session of
grasps. From twenty grasps of the published tables on it is 0.4 to 1.5, of a dead finger 0.06."""
AWAY_MAX = 8.0
"""Electrodes of a session read, in the mean, at most so many of the training's spreads away from
the training's mean (root mean square): 1.3 to 4.1 on the published days."""
AWAY_MIN, ORDER_RATIO = 1.0, 1.2
"""Fingers are exchanged if they are further away than the first, and in another order nearer by
more than the second: in their own they are the nearer by 1.5 to 2.6 on the published days."""


class SessionState(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Statistics as they are kept between two starts of the daemon."""

    weight: Annotated[float, msgspec.Meta(ge=0.0, le=HORIZON_GRASPS)]
    """Grasps that the sums stand for, at most `HORIZON_GRASPS`."""
    grasps: Annotated[int, msgspec.Meta(ge=0)]
    """Grasps seen in all."""
    mean: tuple[float, ...]
    squares: tuple[Annotated[float, msgspec.Meta(ge=0.0)], ...]
    """Sum of the squared deviations from the mean."""
    slip_share: Annotated[float, msgspec.Meta(ge=0.0, le=1.0)] = 0.5
    """Of the latest grasps, as they were judged."""
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
        Raises `ValueError` unless the spreads and the weight are above zero."""
        if not (np.all(prior_spread > 0.0) and prior_grasps > 0.0):
            raise ValueError("prior spreads and weight must be above zero")
        self._prior_mean = prior_mean
        self._prior_spread = prior_spread
        self._prior_variance = prior_spread**2
        self._prior_grasps = prior_grasps
        self.reset()

    def reset(self) -> None:
        """Forget the session: a sensor was exchanged."""
        self.grasps = 0
        self._weight = 0.0
        self._mean = np.zeros_like(self._prior_mean)
        self._squares = np.zeros_like(self._prior_mean)
        self._slip_share = 0.5
        self._last: NDArray[np.float64] | None = None
        self._settle()

    def observe(self, values: NDArray[np.float64], *, slip: bool | None = None) -> bool:
        """Take in one grasp; False if it is the one before, still held, or is not finite.

        `slip` is how it was judged, None if it was not. Among many slips each weighs the less: a
        session's mean that moved to what slips would make the next slip look stable.
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
        """What `restore` needs."""
        return SessionState(
            self._weight,
            self.grasps,
            tuple(self._mean.tolist()),
            tuple(self._squares.tolist()),
            self._slip_share,
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
        least = min(state.grasps, BALANCED_FROM + LEAST_WEIGHT * (state.grasps - BALANCED_FROM))
        if not min(least, HORIZON_GRASPS) <= state.weight <= state.grasps:
            raise ValueError(f"says that {state.grasps} grasps weigh {state.weight:g}")
        self.reset()
        self.grasps, self._weight = state.grasps, state.weight
        self._mean, self._squares, self._slip_share = mean, squares, state.slip_share
        self._last = None if state.last is None else last
        self._settle()

    def _balance(self, slip: bool | None) -> float:
        """The weight of the next grasp, after its verdict was counted."""
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
        """Blend session and prior, as if the prior were `prior_grasps` grasps around its mean."""
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
    """Whether what a session took in cannot have been grasps of these fingers.

    The sensors are far off; the fingers are exchanged; or, of `enough` grasps, a finger is dead or
    sees noise alone. Of mean and spread of each electrode in the session, and in the training,
    counts, shape (fingers, 24).
    """
    ratio = np.sort(spread / training_spread, axis=1)
    middle = ratio.shape[1] // 2
    ratios = ((ratio[:, (ratio.shape[1] - 1) // 2] + ratio[:, middle]) / 2.0).tolist()  # the median
    least, most = SPREAD_RATIOS
    # Of each finger of the session from each of the training.
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
