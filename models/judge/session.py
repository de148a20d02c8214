"""Session calibration: map counts of today's sensors to those of the model's training."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from graspd.biotac import COUNT_MAX
from graspd.models.contract import SessionInput
from graspd.models.inputs import raw_features
from graspd.models.session_statistics import SessionState, SessionStatistics, is_odd


class SessionCalibration:
    """Learns from the grasps of a session, without labels, what its sensors read.

    Arrays are never changed in place: after each grasp there are new ones.
    """

    features_mean: NDArray[np.float64]
    """Mean of the raw features of a session model, shape (fingers * 26,)."""
    features_spread: NDArray[np.float64]
    """Standard deviation of the raw features, shape (fingers * 26,)."""
    counts_mean: NDArray[np.float64]
    """Mean of each electrode in this session, counts, shape (fingers, 24)."""
    scale: NDArray[np.float64]
    """Spread of each electrode in the training over that of the session, shape (fingers, 24)."""
    calibrated: bool
    """True if the session has as many grasps as the model requires, and is not `odd`."""
    odd: bool
    """True if, by `is_odd`, the session cannot have come from grasps of these fingers."""
    temperature: float
    """Divisor of the network's log-odds of slip, above 1 while the session has few grasps, or is
    `odd`."""

    def __init__(
        self,
        takes: SessionInput,
        counts_mean: NDArray[np.float64],
        counts_spread: NDArray[np.float64],
    ) -> None:
        """Start with the statistics of the training.

        `takes`: the model's input, with the statistics of its features. `counts_mean`,
        `counts_spread`: mean and standard deviation of each electrode, counts, shape (fingers, 24).
        """
        self._takes = takes
        self._training = counts_mean, counts_spread
        self._statistics = SessionStatistics(
            np.concatenate((takes.mean, counts_mean.ravel())),
            np.concatenate((takes.spread, counts_spread.ravel())),
            takes.prior_grasps,
        )
        self._settle()

    @property
    def grasps(self) -> int:
        """Grasps of this session that were taken in."""
        return self._statistics.grasps

    def to_training(self, counts: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return counts (fingers, 24) as the training's sensors would read them."""
        values: NDArray[np.float64] = self._training[0] + (counts - self.counts_mean) * self.scale
        return values

    def from_training(self, values: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return counts as today's sensors would read `values`; the inverse of `to_training`."""
        counts: NDArray[np.float64] = self.counts_mean + (values - self._training[0]) / self.scale
        return counts

    def observe(self, counts: NDArray[np.generic], *, slip: bool | None = None) -> None:
        """Take in the counts of a grasp, shape (fingers, 24), unless they repeat the last one's.

        `slip`: True if it was judged to slip; None: it was not judged.
        """
        values = np.concatenate((raw_features(counts), counts.ravel()))
        if self._statistics.observe(values, slip=slip):
            self._settle()

    def reset(self) -> None:
        """Forget the session. Call when a sensor was exchanged."""
        self._statistics.reset()
        self._settle()

    def state(self) -> SessionState:
        """Return what `restore` needs."""
        return self._statistics.state()

    def restore(self, state: SessionState) -> None:
        """Continue a saved session. Raises `ValueError` if it does not fit model and counts."""
        counts = np.array(state.mean[len(self._takes.mean) :])
        if ((counts < 0.0) | (counts > COUNT_MAX)).any():
            raise ValueError("holds means that no counts have")
        self._statistics.restore(state)
        self._settle()

    def _settle(self) -> None:
        mean, spread = self._statistics.mean, self._statistics.spread
        features, shape = len(self._takes.mean), self._training[0].shape
        self.features_mean, self.features_spread = mean[:features], spread[:features]
        self.counts_mean = mean[features:].reshape(shape)
        counts_spread = spread[features:].reshape(shape)
        self.scale = self._training[1] / counts_spread
        enough = self.grasps >= self._takes.calibrated_from
        self.odd = is_odd(self.counts_mean, counts_spread, *self._training, enough=enough)
        self.calibrated = enough and not self.odd
        steps, grasps = self._takes.sharpness, 0 if self.odd else self.grasps
        self.temperature = next(s.temperature for s in reversed(steps) if s.grasps <= grasps)
