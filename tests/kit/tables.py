"""Grasp tables in the published form."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray


def write_table(
    path: Path,
    counts: NDArray[np.uint16],
    slipped: NDArray[np.bool_],
    objects: Sequence[str] | None = None,
    fingers: Sequence[str] = ("ff", "mf", "th"),
) -> None:
    """Write a grasp table in the published form; without `objects`, each is called `ball`.

    `counts`: shape (N, fingers, 24), of these `fingers`. `slipped`: shape (N,).
    """
    header = ["object", "slipped"]
    header += [f"{finger}_biotac_{n}" for finger in fingers for n in range(1, 25)]
    names = ["ball"] * len(counts) if objects is None else objects
    with path.open("w", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(header)
        for name, slip, reading in zip(names, slipped, counts, strict=True):
            writer.writerow([name, int(slip), *reading.ravel()])
