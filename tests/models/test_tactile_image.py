"""The tactile image against a plain, loop-by-loop implementation of the authors' procedure."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

import graspd
from graspd.models.inputs import SPREAD_FLOOR_COUNTS
from graspd.models.layout import D1, LAYOUTS
from graspd.models.tactile_image import Fill, Normalisation, TactileImager, fill_matrix
from graspd.models.training.data.datasets import read_table

Image = list[list[float]]

# Pixels of E1..E24 on D1, from the table of the data set's authors.
D1_PIXELS = list(
    zip(
        [0, 1, 4, 5, 6, 7, 8, 9, 10, 11, 0, 1, 4, 5, 6, 7, 8, 9, 10, 11, 2, 3, 3, 5],
        [1, 2, 0, 1, 3, 0, 1, 4, 2, 1, 9, 8, 10, 9, 7, 10, 9, 6, 8, 9, 5, 4, 6, 5],
        strict=True,
    )
)


def plain_filled(counts: Sequence[int | None], least_contact: bool) -> Image:
    """Return the filled D1 image of one finger; a count of None is a broken electrode."""
    image: list[list[float | None]] = [[None] * 11 for _ in range(12)]
    for (row, column), count in zip(D1_PIXELS, counts, strict=True):
        image[row][column] = None if count is None else float(count)
    while any(pixel is None for line in image for pixel in line):
        before = [line[:] for line in image]
        for row in range(12):
            for column in range(11):
                if before[row][column] is not None:
                    continue
                if least_contact:
                    image[row][column] = float(max(filter(None, counts)))
                    continue
                near = []
                for r in range(max(row - 1, 0), min(row + 2, 12)):
                    for c in range(max(column - 1, 0), min(column + 2, 11)):
                        pixel = before[r][c]
                        if pixel is not None:
                            near.append(pixel)
                if near:
                    image[row][column] = math.fsum(near) / len(near)
    return [[pixel for pixel in line if pixel is not None] for line in image]


def plain_image(counts: list[int], least_contact: bool, over_electrodes: bool) -> Image:
    filled = plain_filled(counts, least_contact)
    values = (
        [float(count) for count in counts]
        if over_electrodes
        else [pixel for line in filled for pixel in line]
    )
    mean = math.fsum(values) / len(values)
    deviation = math.sqrt(math.fsum((value - mean) ** 2 for value in values) / len(values))
    return [[(pixel - mean) / deviation for pixel in line] for line in filled]


@pytest.mark.parametrize("fill", Fill)
@pytest.mark.parametrize("normalisation", Normalisation)
def test_images_of_real_grasps_equal_the_plain_implementation(
    bts3_dir: Path, fill: Fill, normalisation: Normalisation
) -> None:
    counts = read_table(bts3_dir / "palm_side.csv").counts[::10]
    images, _ = TactileImager(3, D1, fill, normalisation).build_batch(counts)
    assert images.shape == (128, 12, 11, 3)
    worst = 0.0
    for image, reading in zip(images, counts, strict=True):
        plain = [
            plain_image(
                finger.tolist(),
                fill is Fill.LEAST_CONTACT,
                normalisation is Normalisation.ELECTRODES,
            )
            for finger in reading
        ]
        worst = max(worst, float(np.abs(image - np.moveaxis(np.array(plain), 0, 2)).max()))
    assert worst < 1e-5


def test_layouts_have_the_published_sizes_and_no_pixel_twice() -> None:
    assert list(zip(D1.rows, D1.columns, strict=True)) == D1_PIXELS
    shapes = {"D1": (12, 11), "D2a": (6, 5), "D2b": (6, 5), "D3": (4, 7)}
    assert {name: layout.shape for name, layout in LAYOUTS.items()} == shapes
    for layout in LAYOUTS.values():
        assert len(set(zip(layout.rows, layout.columns, strict=True))) == 24
        for fill in Fill:
            np.testing.assert_allclose(fill_matrix(layout, fill).sum(axis=1), 1.0, atol=1e-15)


counts_of_three_fingers = hnp.arrays(np.uint16, (3, 24), elements=st.integers(0, 4095))


@given(counts=counts_of_three_fingers)
def test_any_counts_give_a_finite_image_or_zeros(counts: np.ndarray) -> None:
    image = np.full((12, 11, 3), np.nan, dtype=np.float32)
    spread = TactileImager(3).build(counts, image)
    assert np.isfinite(image).all()
    for finger in range(3):
        if spread[finger] >= SPREAD_FLOOR_COUNTS:
            assert abs(image[..., finger].mean()) < 1e-5
            assert image[..., finger].std() == pytest.approx(1.0, abs=1e-5)
        else:
            assert not image[..., finger].any()


def test_a_finger_with_nan_gets_an_image_of_zeros() -> None:
    counts = np.tile(np.arange(24.0) * 100, (3, 1))
    counts[1, 5] = np.nan
    image = np.ones((12, 11, 3), dtype=np.float32)
    with np.errstate(invalid="ignore"):
        spread = TactileImager(3).build(counts, image)
    assert np.isnan(spread[1])
    assert not image[..., 1].any()
    assert np.isfinite(image).all()


@pytest.mark.parametrize("fill", ["neighbour-mean", "least-contact"])
def test_tactile_images_of_raw_counts_equal_the_plain_filling(fill: str) -> None:
    drawn = np.random.default_rng(7).integers(1, 4096, (2, 3, 24)).tolist()
    drawn[0][1][:4] = [None] * 4  # broken, in a corner
    drawn[1][2][23] = None
    images = graspd.tactile_images(drawn, fill=fill)
    assert images.shape == (2, 12, 11, 3)
    for image, grasp in zip(images, drawn, strict=True):
        plain = [plain_filled(finger, fill == "least-contact") for finger in grasp]
        np.testing.assert_allclose(image, np.moveaxis(np.array(plain), 0, 2), rtol=1e-12)


def test_the_image_of_a_finger_without_counts_is_nan() -> None:
    counts = np.full((1, 2, 24), 2000.0)
    counts[0, 1] = np.nan
    images = graspd.tactile_images(counts, "D3")
    assert images.shape == (1, 4, 7, 2)
    np.testing.assert_allclose(images[..., 0], 2000.0)
    assert np.isnan(images[..., 1]).all()


def test_an_unknown_layout_or_fill_is_refused_by_name() -> None:
    counts = np.zeros((1, 3, 24))
    with pytest.raises(ValueError, match="'D4': they are D1, D2a, D2b, D3"):
        graspd.tactile_images(counts, "D4")
    with pytest.raises(ValueError, match="'mean': they are least-contact, neighbour-mean"):
        graspd.tactile_images(counts, fill="mean")


def test_a_drawing_has_each_electrodes_number_on_its_pixel() -> None:
    pytest.importorskip("matplotlib", reason="needs the extra `report`")
    counts = np.arange(72.0).reshape(3, 24)
    counts[2, 4] = np.nan
    *panels, _scale = graspd.plot_grasp(counts).axes
    assert [panel.get_title() for panel in panels] == ["ff", "mf", "th"]
    for panel in panels:
        places = {int(text.get_text()): text.get_position() for text in panel.texts}
        expected = enumerate(D1_PIXELS, start=1)
        assert places == {number: (column, row) for number, (row, column) in expected}
    red = [text.get_text() for panel in panels for text in panel.texts if text.get_color() == "red"]
    assert red == ["5"]
    with pytest.raises(ValueError, match="draws one grasp, and 2 were given"):
        graspd.plot_grasp(np.stack([counts, counts]))
    with pytest.raises(ValueError, match="no electrode of this grasp works"):
        graspd.plot_grasp(counts * np.nan)
