"""Session calibration: what this session's grasps look like, and how much is known of it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from drivers.base import COUNT_MAX
from models.contract import SessionInput
from models.inputs import SessionBuilder, raw_features
from models.session_statistics import SessionState, SessionStatistics

SPREAD_RATIOS = (0.2, 3.0)
"""Electrodes of a finger vary, in the median, by so many times the training's, or no grasps came:
by 0.7 to 1.3 times from twenty grasps of the published tables on; those of a dead finger by 0.06
times."""


class SessionCalibration:
    """Keeps the statistics of the session's unlabelled grasps, and a model's input up to them."""

    def __init__(
        self,
        wanted: SessionInput,
        inputs: SessionBuilder,
        counts_mean: NDArray[np.float64],
        counts_spread: NDArray[np.float64],
    ) -> None:
        """Start with the training's statistics: `wanted`, and of the counts (fingers, 24)."""
        self._wanted = wanted
        self._inputs = inputs
        self._training_mean = counts_mean
        self._training_spread = counts_spread
        self._statistics = SessionStatistics(
            np.concatenate((wanted.mean, counts_mean.ravel())),
            np.concatenate((wanted.spread, counts_spread.ravel())),
            wanted.prior_grasps,
        )
        self._settle()

    @property
    def grasps(self) -> int:
        """Grasps of this session that were taken in."""
        return self._statistics.grasps

    @property
    def calibrated(self) -> bool:
        """Whether they are enough for what the model's card says, and can have been grasps."""
        return self.grasps >= self._wanted.calibrated_from and not self.odd

    @property
    def temperature(self) -> float:
        """What the margin of a verdict must be divided by, with so few grasps."""
        steps, grasps = self._wanted.sharpness, 0 if self.odd else self.grasps
        return next(step.temperature for step in reversed(steps) if step.grasps <= grasps)

    def observe(self, counts: NDArray[np.generic]) -> None:
        """Take in the counts (fingers, 24) of a grasp that was judged, or could have been."""
        values = np.concatenate((raw_features(counts), counts.ravel()))
        if self._statistics.observe(values):
            self._settle()

    def to_training(self, counts: NDArray[np.generic]) -> NDArray[np.float64]:
        """What counts (fingers, 24) would have been with the training's sensors."""
        deviation = counts.astype(np.float64) - self.counts_mean
        values: NDArray[np.float64] = self._training_mean + deviation * self._scale
        return values

    def from_training(self, values: NDArray[np.float64]) -> NDArray[np.float64]:
        """The inverse of `to_training`."""
        counts: NDArray[np.float64] = (
            self.counts_mean + (values - self._training_mean) / self._scale
        )
        return counts

    def reset(self) -> None:
        """A sensor was exchanged: start again."""
        self._statistics.reset()
        self._settle()

    def state(self) -> SessionState:
        """To be kept for `restore`."""
        return self._statistics.state()

    def restore(self, state: SessionState) -> None:
        """Go on from what was kept. Raises `ValueError` if it cannot be of these counts."""
        counts = np.array(state.mean[len(self._wanted.mean) :])
        if ((counts < 0.0) | (counts > COUNT_MAX)).any():
            raise ValueError("holds means that no counts have")
        self._statistics.restore(state)
        self._settle()

    def _settle(self) -> None:
        features = len(self._wanted.mean)
        mean, spread = self._statistics.mean, self._statistics.spread
        self._inputs.use(mean[:features], spread[:features])
        self.counts_mean = mean[features:].reshape(self._training_mean.shape)
        """Of each electrode in this session, shape (fingers, 24)."""
        self.counts_spread = spread[features:].reshape(self._training_mean.shape)
        """Standard deviation of each electrode in this session, shape (fingers, 24)."""
        least, most = SPREAD_RATIOS
        self._scale = self._training_spread / self.counts_spread
        ratio = np.median(self.counts_spread / self._training_spread, axis=1)
        enough = self.grasps >= self._wanted.calibrated_from
        self.odd = enough and not bool(((ratio >= least) & (ratio <= most)).all())
        """Whether what came cannot have been grasps: a finger that is dead or sees only noise."""
