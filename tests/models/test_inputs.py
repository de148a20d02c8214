"""Inputs of models: one reading as in a batch, flat fingers, and the order of fingers."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from graspd.models.contract import (
    CountsInput,
    ImageInput,
    Input,
    SessionInput,
    Sharpness,
    VectorInput,
)
from graspd.models.inputs import builder
from graspd.models.layout import D1
from graspd.models.tactile_image import Composition, TactileImager


def counts(number: int, seed: int = 0) -> NDArray[np.uint16]:
    return np.random.default_rng(seed).integers(5, 3975, (number, 3, 24), dtype=np.uint16)


def session_input() -> SessionInput:
    return SessionInput((0.0,) * 78, (1.0,) * 78, 3.0, 1.0, 20.0, (Sharpness(0.0, 1.0),))


def image_input(composition: Composition) -> ImageInput:
    return ImageInput("D1", "neighbour-mean", "filled-image", composition.value)


@pytest.mark.parametrize(
    ("wanted", "name", "shape"),
    [
        (image_input(Composition.CHANNELS), "image", (12, 11, 3)),
        (ImageInput("D3", "least-contact", "electrodes", "channels"), "image", (4, 7, 3)),
        (ImageInput("D2a", "neighbour-mean", "filled-image", "vertical"), "image", (18, 5, 1)),
        (VectorInput(), "vector", (72,)),
        (CountsInput(), "counts", (72,)),
        (session_input(), "features", (78,)),
    ],
)
def test_one_reading_gives_the_same_input_as_in_a_batch(
    wanted: Input, name: str, shape: tuple[int, ...]
) -> None:
    inputs = builder(wanted, 3)
    assert inputs.name.endswith(name)
    assert inputs.shape == shape
    readings = counts(10)
    batch, spreads = inputs.build_batch(readings)
    assert batch.shape == (10, *shape)
    out = np.empty(shape, dtype=np.float32)
    for reading, expected, spread in zip(readings, batch, spreads, strict=True):
        np.testing.assert_array_equal(inputs.build(reading, out), spread)
        np.testing.assert_array_equal(out, expected)


@pytest.mark.parametrize("wanted", [VectorInput(), session_input(), *map(image_input, Composition)])
def test_a_flat_finger_has_zero_spread_and_a_finite_input(wanted: Input) -> None:
    inputs = builder(wanted, 3)
    reading = counts(1)[0]
    reading[1] = 2000
    out = np.empty(inputs.shape, dtype=np.float32)
    assert inputs.build(reading, out)[1] == pytest.approx(0.0, abs=1e-9)
    assert np.isfinite(out).all()
    if isinstance(wanted, ImageInput):
        assert (out == 0.0).sum() == 12 * 11


@pytest.mark.parametrize(
    ("composition", "axis"), [(Composition.HORIZONTAL, 1), (Composition.VERTICAL, 0)]
)
def test_a_composed_image_joins_the_fingers_images_in_order(
    composition: Composition, axis: int
) -> None:
    readings = counts(5)
    channels, _ = TactileImager(3, D1).build_batch(readings)
    composed, _ = TactileImager(3, D1, composition=composition).build_batch(readings)
    for image, expected in zip(composed, channels, strict=True):
        fingers = [expected[:, :, finger] for finger in range(3)]
        np.testing.assert_array_equal(image[:, :, 0], np.concatenate(fingers, axis=axis))
