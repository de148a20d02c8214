"""Made-up grasps for the tests of the training half: separable, and written as a table."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

HEADER = [
    "object",
    "slipped",
    *(f"{finger}_biotac_{n}" for finger in ("ff", "mf", "th") for n in range(1, 25)),
]


def separable_counts(grasps: int, seed: int = 7) -> tuple[NDArray[np.uint16], NDArray[np.bool_]]:
    """Counts (N, 3, 24) that fall along the electrodes of a stable grasp and rise in a slip."""
    random = np.random.default_rng(seed)
    slipped = np.arange(grasps) % 2 == 1
    ramp = np.linspace(-600.0, 600.0, 24) * np.where(slipped, 1.0, -1.0)[:, None, None]
    counts = 2000.0 + ramp + random.normal(0.0, 120.0, (grasps, 3, 24))
    return counts.astype(np.uint16), slipped


def write_table(
    path: Path,
    counts: NDArray[np.uint16],
    slipped: NDArray[np.bool_],
    objects: Sequence[str] | None = None,
) -> None:
    """Write a grasp table in the published form; without `objects`, of balls."""
    names = ["ball"] * len(counts) if objects is None else objects
    with path.open("w", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(HEADER)
        for name, slip, reading in zip(names, slipped, counts, strict=True):
            writer.writerow([name, int(slip), *reading.ravel()])
