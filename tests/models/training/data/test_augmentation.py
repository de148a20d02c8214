"""Flips and rotations of tactile images."""

from __future__ import annotations

import numpy as np
from scipy.ndimage import rotate

from graspd.models.training.data.augmentation import Augmentation, augment

RANDOM = np.random.default_rng(3)
IMAGES = RANDOM.normal(size=(20, 12, 11, 3)).astype(np.float32)
SLIPPED = RANDOM.random(20) < 0.5


def test_each_grasp_comes_back_four_times_with_its_label() -> None:
    images, slipped = augment(IMAGES, SLIPPED, Augmentation(), seed=0)
    assert images.shape == (80, 12, 11, 3)
    assert images.dtype == np.float32
    assert np.array_equal(images[:20], IMAGES)
    assert slipped.tolist() == SLIPPED.tolist() * 4


def test_flips_turn_columns_and_rows_around_and_leave_the_fingers() -> None:
    images, _ = augment(IMAGES, SLIPPED, Augmentation(), seed=0)
    for row in range(12):
        for column in range(11):
            pixel = IMAGES[:, row, column]
            assert np.array_equal(images[20:40, row, 10 - column], pixel)
            assert np.array_equal(images[40:60, 11 - row, column], pixel)


def test_rotations_go_ten_degrees_to_either_side() -> None:
    """Each finger's plane is rotated by itself here, by scipy."""
    images, _ = augment(IMAGES, SLIPPED, Augmentation(), seed=0)
    turned = []
    for image, actual in zip(IMAGES, images[60:], strict=True):
        matches = [
            all(
                np.allclose(
                    rotate(image[:, :, finger], angle, reshape=False, mode="nearest"),
                    actual[:, :, finger],
                    atol=1e-5,
                )
                for finger in range(3)
            )
            for angle in (10.0, -10.0)
        ]
        assert sum(matches) == 1
        turned.append(matches[0])
    assert 4 <= sum(turned) <= 16
