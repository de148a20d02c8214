"""The tactile image against a plain, loop-by-loop implementation of the authors' procedure."""

from __future__ import annotations

import csv
import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from graspd.models.inputs import SPREAD_FLOOR_COUNTS
from graspd.models.layout import D1, LAYOUTS, Layout
from graspd.models.tactile_image import Fill, Normalisation, TactileImager, fill_matrix

Image = list[list[float]]

# Pixels of E1..E24 on D1, from the table of the data set's authors.
D1_PIXELS = list(
    zip(
        [0, 1, 4, 5, 6, 7, 8, 9, 10, 11, 0, 1, 4, 5, 6, 7, 8, 9, 10, 11, 2, 3, 3, 5],
        [1, 2, 0, 1, 3, 0, 1, 4, 2, 1, 9, 8, 10, 9, 7, 10, 9, 6, 8, 9, 5, 4, 6, 5],
        strict=True,
    )
)


def plain_filled(counts: list[int], least_contact: bool) -> Image:
    image: list[list[float | None]] = [[None] * 11 for _ in range(12)]
    for (row, column), count in zip(D1_PIXELS, counts, strict=True):
        image[row][column] = float(count)
    while any(pixel is None for line in image for pixel in line):
        before = [line[:] for line in image]
        for row in range(12):
            for column in range(11):
                if before[row][column] is not None:
                    continue
                if least_contact:
                    image[row][column] = float(max(counts))
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


def real_counts(bts3_dir: Path) -> list[list[int]]:
    grasps = []
    for name in ("palm_down.csv", "palm_side.csv"):
        with (bts3_dir / name).open(newline="") as file:
            grasps += [[int(cell) for cell in row[2:]] for row in list(csv.reader(file))[1:]]
    return grasps


@pytest.mark.parametrize("fill", Fill)
@pytest.mark.parametrize("normalisation", Normalisation)
def test_every_fifth_real_grasp_equals_the_plain_implementation(
    bts3_dir: Path, fill: Fill, normalisation: Normalisation
) -> None:
    grasps = real_counts(bts3_dir)
    assert len(grasps) == 2549
    counts = np.array(grasps[::5], dtype=np.uint16).reshape(-1, 3, 24)
    images, _ = TactileImager(3, D1, fill, normalisation).build_batch(counts)
    assert images.shape == (510, 12, 11, 3)
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


def test_d1_has_108_empty_pixels_and_two_passes_fill_them() -> None:
    # 12 x 11 pixels, 24 electrodes; the notebooks make two passes.
    assert D1.shape == (12, 11)
    assert len(set(D1_PIXELS)) == 24
    assert list(zip(D1.rows, D1.columns, strict=True)) == D1_PIXELS
    matrix = fill_matrix(D1, Fill.NEIGHBOUR_MEAN)
    assert matrix.shape == (132, 25)
    assert (matrix.sum(axis=1) > 0).all()


@pytest.mark.parametrize("layout", LAYOUTS.values(), ids=lambda layout: layout.name)
@pytest.mark.parametrize("fill", Fill)
def test_rows_of_every_fill_matrix_sum_to_one(layout: Layout, fill: Fill) -> None:
    np.testing.assert_allclose(fill_matrix(layout, fill).sum(axis=1), 1.0, atol=1e-15)


@pytest.mark.parametrize(
    ("name", "shape"), [("D1", (12, 11)), ("D2a", (6, 5)), ("D2b", (6, 5)), ("D3", (4, 7))]
)
def test_layouts_have_the_published_sizes_and_no_pixel_twice(
    name: str, shape: tuple[int, int]
) -> None:
    layout = LAYOUTS[name]
    assert layout.shape == shape
    assert len(set(zip(layout.rows, layout.columns, strict=True))) == 24


counts_of_three_fingers = hnp.arrays(np.uint16, (3, 24), elements=st.integers(0, 4095))


@given(counts=counts_of_three_fingers)
@settings(max_examples=200)
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


def test_not_a_number_has_no_image() -> None:
    counts = np.tile(np.arange(24.0) * 100, (3, 1))
    counts[1, 5] = np.nan
    image = np.ones((12, 11, 3), dtype=np.float32)
    with np.errstate(invalid="ignore"):
        spread = TactileImager(3).build(counts, image)
    assert np.isnan(spread[1])
    assert not image[..., 1].any()
    assert np.isfinite(image).all()


@pytest.mark.parametrize(
    ("shape", "step"), [((12, 11, 2), 1), ((11, 12, 3), 1), ((396,), 1), ((12, 11, 6), 2)]
)
def test_a_buffer_of_another_shape_or_with_gaps_is_refused(
    shape: tuple[int, ...], step: int
) -> None:
    with pytest.raises(ValueError, match="C-contiguous"):
        TactileImager(3).build(np.ones((3, 24)), np.empty(shape, np.float32)[..., ::step])
