"""Augment tactile images by flips and small rotations, as published (paper, section III-E)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from graspd.models.training.arrays import Bools, Floats32

COPIES = 4
"""Copies of each grasp: itself, flipped both ways, rotated."""


@dataclass(frozen=True, slots=True)
class Augmentation:
    """Flip left-right, flip up-down, rotate: four times the images."""

    rotation_deg: float = 10.0
    """Each image is rotated by this angle, to the left or to the right at random."""


def augment(
    images: Floats32, slipped: Bools, augmentation: Augmentation, seed: int
) -> tuple[Floats32, Bools]:
    """Return four times the images (N, height, width, fingers) and labels (N,).

    The order is: unchanged, flipped left-right, flipped up-down, rotated. A rotated image keeps its
    size, and pixels from outside repeat the nearest edge. Raises `ValueError` if `images` are none.
    """
    if images.ndim != 4:
        raise ValueError(f"only images can be flipped and rotated, not inputs {images.shape[1:]}")
    rotated = _rotated(images, augmentation.rotation_deg, seed)
    return (
        np.concatenate((images, images[:, :, ::-1], images[:, ::-1], rotated)),
        np.tile(slipped, COPIES),
    )


def _rotated(images: Floats32, angle_deg: float, seed: int) -> Floats32:
    from scipy.ndimage import rotate  # help and completion know `Augmentation` without it

    left = np.random.default_rng(seed).integers(2, size=len(images)).astype(np.bool_)
    rotated = np.empty_like(images)
    for chosen, angle in ((left, angle_deg), (~left, -angle_deg)):
        rotated[chosen] = rotate(images[chosen], angle, axes=(2, 1), reshape=False, mode="nearest")
    return rotated
