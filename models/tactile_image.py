"""Convert counts to tactile images, in the same way for training and for the daemon.

For a fixed layout both ways of filling gaps are linear in the counts; least contact is linear in
the counts and their maximum. Each row of the fill matrix sums to one, so subtracting the mean
commutes with filling. A normalised image is one small matrix product and one division.
"""

from __future__ import annotations

from collections.abc import Iterable
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from graspd.biotac import ELECTRODES
from graspd.models.inputs import InputBuilder, scale_of
from graspd.models.layout import D1, Layout


class Fill(StrEnum):
    """Value of a pixel without an electrode (paper, section II-A)."""

    LEAST_CONTACT = "least-contact"
    """The finger's largest count: contact lowers a count."""
    NEIGHBOUR_MEAN = "neighbour-mean"
    """The mean of the filled 8-neighbours, in passes until no pixel is empty."""


class Normalisation(StrEnum):
    """Values over which a finger's mean and population standard deviation are taken."""

    FILLED_IMAGE = "filled-image"
    """All pixels of the filled image, as in the authors' notebooks."""
    ELECTRODES = "electrodes"
    """The 24 electrodes, as in the paper (section II-B)."""


class Composition(StrEnum):
    """Arrangement of the images of the fingers (paper, section II-C)."""

    CHANNELS = "channels"
    """Each finger a channel: height x width x fingers."""
    HORIZONTAL = "horizontal"
    """Side by side: height x (fingers * width) x 1."""
    VERTICAL = "vertical"
    """Below one another: (fingers * height) x width x 1."""


def fill_matrix(
    layout: Layout, fill: Fill, electrodes: Iterable[int] = range(ELECTRODES)
) -> NDArray[np.float64]:
    """Return the matrix (pixels, 25) from [24 counts, their maximum] to a filled image.

    Pixels are in row-major order. Each row sums to one. `electrodes`: numbers, 0..23, of those that
    work, at least one; the pixels of others are filled as if they had no electrode.
    """
    height, width = layout.shape
    matrix = np.zeros((height, width, ELECTRODES + 1))
    filled = np.zeros((height, width), dtype=bool)
    for electrode in electrodes:
        pixel = layout.rows[electrode], layout.columns[electrode]
        matrix[*pixel, electrode] = 1.0
        filled[pixel] = True
    if fill is Fill.LEAST_CONTACT:
        matrix[~filled, ELECTRODES] = 1.0
    while not filled.all() and fill is Fill.NEIGHBOUR_MEAN:
        before, was_filled = matrix.copy(), filled.copy()
        for row, column in np.argwhere(~was_filled):
            window = (slice(max(row - 1, 0), row + 2), slice(max(column - 1, 0), column + 2))
            if was_filled[window].any():
                matrix[row, column] = before[window][was_filled[window]].mean(axis=0)
                filled[row, column] = True
    return matrix.reshape(height * width, ELECTRODES + 1)


class TactileImager(InputBuilder):
    """Build normalised tactile images without allocating an image per reading.

    The arithmetic is float64 on integers below 2**12, and the mean is subtracted from each pixel
    before squaring. The error of an image is below 1e-9 of its largest magnitude, and after
    rounding to float32 6e-8 of it.
    """

    name = "tactile_image"

    def __init__(
        self,
        fingers: int,
        layout: Layout = D1,
        fill: Fill = Fill.NEIGHBOUR_MEAN,
        normalisation: Normalisation = Normalisation.FILLED_IMAGE,
        composition: Composition = Composition.CHANNELS,
    ) -> None:
        height, width = layout.shape
        # View of the fingers' images as (height, width, fingers): split, then transposed.
        match composition:
            case Composition.CHANNELS:
                self.shape: tuple[int, int, int] = (height, width, fingers)
                self._split, self._axes = self.shape, (0, 1, 2)
            case Composition.HORIZONTAL:
                self.shape = (height, fingers * width, 1)
                self._split, self._axes = (height, fingers, width), (0, 2, 1)
            case Composition.VERTICAL:
                self.shape = (fingers * height, width, 1)
                self._split, self._axes = (fingers, height, width), (1, 2, 0)
        self._planes = (height, width, fingers)
        matrix = fill_matrix(layout, fill)
        self._needs_maximum = fill is Fill.LEAST_CONTACT
        terms = ELECTRODES + 1 if self._needs_maximum else ELECTRODES
        matrix = matrix[:, :terms]
        if normalisation is Normalisation.FILLED_IMAGE:
            weights = matrix.mean(axis=0)
        else:
            weights = np.zeros(terms)
            weights[:ELECTRODES] = 1.0 / ELECTRODES
        # Row sums are one, so subtracting the weighted mean from each row centres the image.
        self._centre = matrix - weights
        self._spread_over_image = normalisation is Normalisation.FILLED_IMAGE
        self._counts = np.zeros((terms, fingers))
        self._pixels = np.zeros((matrix.shape[0], fingers))

    def build(self, counts: NDArray[np.generic], out: NDArray[np.float32]) -> NDArray[np.float64]:
        """Write the image of one reading into `out`; return each finger's spread.

        `counts`: shape (fingers, 24). `out`: shape `self.shape`, C-contiguous, else `ValueError`.
        The result, shape (fingers,), is the standard deviation in counts. If it is below
        `SPREAD_FLOOR_COUNTS` or not finite, the finger's image is all zeros and must not be judged.
        For counts of 12 bits its relative error is below 1e-9.
        """
        if out.shape != self.shape or not out.flags.c_contiguous:
            raise ValueError(f"out must be C-contiguous {self.shape}, is {out.shape}")
        electrodes = self._counts[:ELECTRODES]
        electrodes[...] = counts.T
        if self._needs_maximum:
            electrodes.max(axis=0, out=self._counts[ELECTRODES])
        pixels = np.matmul(self._centre, self._counts, out=self._pixels)
        if self._spread_over_image:
            squares: NDArray[np.float64] = np.einsum("pf,pf->f", pixels, pixels)
            spread = np.sqrt(squares / len(pixels))
        else:
            spread = electrodes.std(axis=0)
        scale = scale_of(spread)
        planes = out.reshape(self._split).transpose(self._axes)
        np.multiply(pixels.reshape(self._planes), scale, out=planes, casting="same_kind")
        if np.count_nonzero(scale) < scale.size:
            planes[..., scale == 0.0] = 0.0  # instead of NaN
        return spread

    def build_batch(
        self, counts: NDArray[np.generic]
    ) -> tuple[NDArray[np.float32], NDArray[np.float64]]:
        """Return images (N, *shape) and spreads (N, fingers), each made by `build`, so that
        training and daemon agree exactly."""
        images = np.empty((len(counts), *self.shape), dtype=np.float32)
        spreads = np.empty((len(counts), self._planes[2]))
        for index, reading in enumerate(counts):
            spreads[index] = self.build(reading, images[index])
        return images, spreads
