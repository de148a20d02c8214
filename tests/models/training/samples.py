"""Made-up grasps that can be separated, of many objects in three sessions, as grasp tables."""

from __future__ import annotations

import hashlib
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from graspd.models.contract import Dataset
from graspd.models.training.data.datasets import Grasps, concatenate
from tests.kit.tables import write_table

UNKNOWN = ("juice", "aquarius", "green_gel", "tennis", "football", "milk", "metal_pen_case",
           "train")  # fmt: skip
OBJECTS = (*UNKNOWN, *(f"object_{letter}" for letter in "abcdefghijkl"))
TABLES = ("palm_down", "palm_side", "palm_45")


def separable_counts(grasps: int, seed: int = 7) -> tuple[NDArray[np.uint16], NDArray[np.bool_]]:
    """Return counts (N, 3, 24) and labels (N,), True for a slip: every other grasp.

    Counts fall along the electrodes of a stable grasp, and rise in a slip."""
    random = np.random.default_rng(seed)
    slipped = np.arange(grasps) % 2 == 1
    ramp = np.linspace(-600.0, 600.0, 24) * np.where(slipped, 1.0, -1.0)[:, None, None]
    counts = 2000.0 + ramp + random.normal(0.0, 120.0, (grasps, 3, 24))
    return counts.astype(np.uint16), slipped


def table(name: str, grasps: int, seed: int, drift: int = 0) -> Grasps:
    """Return grasps of 20 objects, one object after the other; a tenth of the labels is wrong.

    `drift`: counts by which electrodes 17 to 20 of the first finger are lower."""
    counts, slipped = separable_counts(grasps, seed)
    counts[:, 0, 16:20] -= np.uint16(drift)
    wrong = np.random.default_rng(seed).random(grasps) < 0.1
    objects = tuple(OBJECTS[index * len(OBJECTS) // grasps] for index in range(grasps))
    file = Dataset(name, hashlib.sha256(counts.tobytes()).hexdigest(), grasps)
    return Grasps(counts, slipped ^ wrong, objects, (file,))


def sessions(grasps: int) -> Grasps:
    """Return three tables of `grasps` grasps each, of which `palm_45` has drifted."""
    return concatenate(_tables(grasps))


def write_sessions(folder: Path, grasps: int) -> None:
    """Write the tables of `sessions` into a folder, in the published form."""
    folder.mkdir(parents=True, exist_ok=True)
    for made in _tables(grasps):
        write(folder / f"{made.files[0].name}.csv", made)


def _tables(grasps: int) -> list[Grasps]:
    return [
        table(name, grasps, seed, drift=800 if name == "palm_45" else 0)
        for seed, name in enumerate(TABLES)
    ]


def write(path: Path, made: Grasps) -> None:
    """Write grasps as a table in the published form."""
    write_table(path, made.counts, made.slipped, made.objects)
