"""From counts to what a model takes: an image, a vector, or features of a session."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from graspd.models.contract import (
    FEATURES_PER_FINGER,
    CountsInput,
    ImageInput,
    Input,
    ModelError,
    SessionInput,
    VectorInput,
)
from graspd.models.layout import ELECTRODES, LAYOUTS

Floats = NDArray[np.float64]
SPREAD_FLOOR_COUNTS = 1.0
"""A finger whose standard deviation is below one count has no image: a z-score would magnify the
quantisation of the converter. On real fingers the electrodes differ by 145 counts or more."""


class InputBuilder(Protocol):
    """Makes the input of one kind of model, one reading at a time or many."""

    @property
    def name(self) -> str:
        """Of the model's input."""

    @property
    def shape(self) -> tuple[int, ...]:
        """Of one reading's input."""

    def build(self, counts: NDArray[np.generic], out: NDArray[np.float32]) -> NDArray[np.float64]:
        """Write the input of counts (fingers, 24) into `out`; return each finger's spread, counts.
        A finger whose spread is below `SPREAD_FLOOR_COUNTS` must not be judged."""

    def build_batch(
        self, counts: NDArray[np.generic]
    ) -> tuple[NDArray[np.float32], NDArray[np.float64]]:
        """Inputs (N, *shape) and spreads (N, fingers) of counts (N, fingers, 24)."""


def builder(wanted: Input, fingers: int) -> InputBuilder:
    """The builder of what a contract asks for. Raises `ModelError` for what is not known."""
    match wanted:
        case ImageInput():
            from graspd.models.tactile_image import (  # only where it is needed
                Composition,
                Fill,
                Normalisation,
                TactileImager,
            )

            try:
                return TactileImager(
                    fingers,
                    LAYOUTS[wanted.layout],
                    Fill(wanted.fill),
                    Normalisation(wanted.normalisation),
                    Composition(wanted.composition),
                )
            except (KeyError, ValueError) as error:
                raise ModelError(f"asks for an image that is not known: {error}") from error
        case VectorInput():
            return VectorBuilder(fingers)
        case CountsInput():
            return CountsBuilder(fingers)
        case SessionInput():
            features = SessionBuilder(fingers, wanted.clip)
            features.use(np.array(wanted.mean), np.array(wanted.spread))
            return features


class _FlatBuilder:
    """One reading or many, by the same arithmetic; see `InputBuilder`."""

    def build(self, counts: NDArray[np.generic], out: NDArray[np.float32]) -> Floats:
        out[...], spread = self._values(counts.astype(np.float64))
        return spread

    def build_batch(self, counts: NDArray[np.generic]) -> tuple[NDArray[np.float32], Floats]:
        values, spread = self._values(counts.astype(np.float64))
        return values.astype(np.float32), spread

    def _values(self, counts: Floats) -> tuple[Floats, Floats]:
        """Inputs (..., width) and spreads (..., fingers) of counts (..., fingers, 24)."""
        raise NotImplementedError


class VectorBuilder(_FlatBuilder):
    """The counts as one vector, z-scored per finger over its 24 electrodes (paper, III-D)."""

    name = "tactile_vector"

    def __init__(self, fingers: int) -> None:
        self.shape = (fingers * ELECTRODES,)

    def _values(self, counts: Floats) -> tuple[Floats, Floats]:
        features, spread = _features(counts)
        return features[..., : -2 * spread.shape[-1]], spread


class CountsBuilder(_FlatBuilder):
    """The counts as one vector, untouched."""

    name = "tactile_counts"

    def __init__(self, fingers: int) -> None:
        self.shape = (fingers * ELECTRODES,)

    def _values(self, counts: Floats) -> tuple[Floats, Floats]:
        return counts.reshape(*counts.shape[:-2], -1), _features(counts)[1]


class SessionBuilder(_FlatBuilder):
    """Features of a reading, standardised by what `use` was told, then clipped.

    The error is 6e-8 of the largest magnitude, the rounding to float32, as long as no mean is more
    than a million times its spread.
    """

    name = "session_features"

    def __init__(self, fingers: int, clip: float) -> None:
        self.shape = (fingers * FEATURES_PER_FINGER,)
        self._low, self._high = -clip, clip
        self._mean, self._spread = np.zeros(self.shape), np.ones(self.shape)
        self._scale = np.ones(self.shape)

    def use(self, mean: Floats, spread: Floats) -> None:
        """Standardise by these from now on, each of shape (fingers * 26,), spreads above zero.
        The arrays must not change any more."""
        if spread is not self._spread:
            self._scale = 1.0 / spread
        self._mean, self._spread = mean, spread

    def _values(self, counts: Floats) -> tuple[Floats, Floats]:
        features, spread = _features(counts)
        standard: Floats = features - self._mean
        standard *= self._scale
        return np.clip(standard, self._low, self._high), spread


def raw_features(counts: NDArray[np.generic]) -> Floats:
    """Features before standardising, shape (..., fingers * 26), of counts (..., fingers, 24)."""
    return _features(counts.astype(np.float64))[0]


def scale_of(spread: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return what deviations are multiplied by: 1 / spread, or 0 where that must not be judged.
    An infinite `spread` has overflowed: it becomes NaN, in place."""
    if 0 not in ((spread >= SPREAD_FLOOR_COUNTS) & (spread < np.inf)).tobytes():
        return 1.0 / spread
    spread[np.isinf(spread)] = np.nan
    judgeable = spread >= SPREAD_FLOOR_COUNTS
    return np.divide(1.0, spread, where=judgeable, out=np.zeros_like(spread))


def _features(counts: Floats) -> tuple[Floats, Floats]:
    """Return z-values, means and (population) spreads of each finger; and the spreads alone.

    Z-values are zero where a finger is flat. In two passes, so that large counts that hardly differ
    cancel before they are squared: for counts of 12 bits the error is below 1e-9 of the largest
    magnitude, 6e-8 once it is float32.
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
