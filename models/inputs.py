"""Convert counts to the input of a model: an image, a vector, or features of a session."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from graspd.biotac import ELECTRODES
from graspd.models.contract import (
    FEATURES_PER_FINGER,
    CountsInput,
    ImageInput,
    Input,
    ModelError,
    SessionInput,
    VectorInput,
)
from graspd.models.layout import LAYOUTS

Floats = NDArray[np.float64]
SPREAD_FLOOR_COUNTS = 1.0
"""Smallest standard deviation, counts, of a finger's electrodes that a z-score can use.

Below it, a z-score would magnify the converter's steps. Electrodes of a real finger differ by 145
counts or more.
"""


class InputBuilder:
    """Builder of one kind of model's input: the same arithmetic for one reading and for many."""

    name: str
    """Name of the model's input."""

    def __init__(self, fingers: int, values: int = ELECTRODES) -> None:
        """`values`: number of inputs of each finger."""
        self.shape: tuple[int, ...] = (fingers * values,)
        """Shape of one reading's input."""

    def build(self, counts: NDArray[np.generic], out: NDArray[np.float32]) -> Floats:
        """Write the input of `counts` (fingers, 24) into `out`; return each finger's spread.

        A finger with a spread below `SPREAD_FLOOR_COUNTS` must not be judged.
        """
        out[...], spread = self._values(counts.astype(np.float64))
        return spread

    def build_batch(self, counts: NDArray[np.generic]) -> tuple[NDArray[np.float32], Floats]:
        """Return inputs (N, *shape) and spreads (N, fingers) of counts (N, fingers, 24)."""
        values, spread = self._values(counts.astype(np.float64))
        return values.astype(np.float32), spread

    def _values(self, counts: Floats) -> tuple[Floats, Floats]:
        """Return inputs (..., width) and spreads (..., fingers) of counts (..., fingers, 24)."""
        raise NotImplementedError


def builder(kind: Input, fingers: int) -> InputBuilder:
    """Return the builder for an input of a contract. Raises `ModelError` for an unknown image."""
    match kind:
        case ImageInput():
            from graspd.models import tactile_image  # only where it is needed

            try:
                return tactile_image.TactileImager(
                    fingers,
                    LAYOUTS[kind.layout],
                    tactile_image.Fill(kind.fill),
                    tactile_image.Normalisation(kind.normalisation),
                    tactile_image.Composition(kind.composition),
                )
            except (KeyError, ValueError) as error:
                raise ModelError(f"asks for an image that is not known: {error}") from error
        case VectorInput():
            return VectorBuilder(fingers)
        case CountsInput():
            return CountsBuilder(fingers)
        case SessionInput():
            features = SessionBuilder(fingers, kind.clip)
            features.use(np.array(kind.mean), np.array(kind.spread))
            return features


class VectorBuilder(InputBuilder):
    """Counts as one vector, z-scored over the 24 electrodes of each finger (paper, III-D)."""

    name = "tactile_vector"

    def _values(self, counts: Floats) -> tuple[Floats, Floats]:
        features, spread = _features(counts)
        return features[..., : -2 * spread.shape[-1]], spread


class CountsBuilder(InputBuilder):
    """Raw counts as one vector."""

    name = "tactile_counts"

    def _values(self, counts: Floats) -> tuple[Floats, Floats]:
        return counts.reshape(*counts.shape[:-2], -1), _features(counts)[1]


class SessionBuilder(InputBuilder):
    """Features of a reading, standardised by the values of `use`, then clipped."""

    name = "session_features"

    def __init__(self, fingers: int, clip: float) -> None:
        super().__init__(fingers, FEATURES_PER_FINGER)
        self._low, self._high = -clip, clip
        self._mean, self._spread = np.zeros(self.shape), np.ones(self.shape)
        self._scale = np.ones(self.shape)

    def use(self, mean: Floats, spread: Floats) -> None:
        """Set mean and spread, shape (fingers * 26,) each; spreads are above zero.

        The caller must not change the arrays afterwards.
        """
        if spread is not self._spread:
            self._scale = 1.0 / spread
        self._mean, self._spread = mean, spread

    def _values(self, counts: Floats) -> tuple[Floats, Floats]:
        features, spread = _features(counts)
        standard: Floats = features - self._mean
        standard *= self._scale
        return np.minimum(np.maximum(standard, self._low), self._high), spread


def raw_features(counts: NDArray[np.generic]) -> Floats:
    """Return the raw features (..., fingers * 26) of counts (..., fingers, 24)."""
    return _features(counts.astype(np.float64))[0]


def scale_of(spread: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the factors of deviations: 1 / spread; 0 where the finger must not be judged.

    An infinite `spread` is an overflow, and becomes NaN in place.
    """
    if 0 not in ((spread >= SPREAD_FLOOR_COUNTS) & (spread < np.inf)).tobytes():
        return 1.0 / spread
    spread[np.isinf(spread)] = np.nan
    judgeable = spread >= SPREAD_FLOOR_COUNTS
    return np.divide(1.0, spread, where=judgeable, out=np.zeros_like(spread))


def _features(counts: Floats) -> tuple[Floats, Floats]:
    """Return the features of each finger (z-values, means, population spreads), and the spreads.

    Z-values of a flat finger are zero. The mean is subtracted before squaring. For counts of 12
    bits the error is below 1e-9 of the largest magnitude, or 6e-8 as float32.
    """
    fingers = counts.shape[-2]
    features = np.empty((*counts.shape[:-2], fingers * FEATURES_PER_FINGER))
    z = features[..., : -2 * fingers].reshape(counts.shape)
    mean, spread = features[..., -2 * fingers : -fingers], features[..., -fingers:]
    np.add.reduce(counts, axis=-1, out=mean)
    mean /= ELECTRODES
    np.subtract(counts, mean[..., np.newaxis], out=z)
    np.add.reduce(np.square(z), axis=-1, out=spread)
    spread /= ELECTRODES
    np.sqrt(spread, out=spread)
    z *= scale_of(spread)[..., np.newaxis]
    return features, spread
