"""Made-up grasps of many objects in three sessions, the last with drifted sensors."""

from __future__ import annotations

import hashlib
from pathlib import Path

import numpy as np

from graspd.models.contract import Dataset
from graspd.models.training.data.datasets import Grasps, concatenate
from tests.models.training.training_samples import separable_counts, write_table

UNKNOWN = ("juice", "aquarius", "green_gel", "tennis", "football", "milk", "metal_pen_case",
           "train")  # fmt: skip
OBJECTS = (*UNKNOWN, *(f"object_{letter}" for letter in "abcdefghijkl"))
TABLES = ("palm_down", "palm_side", "palm_45")


def table(name: str, grasps: int, seed: int, drift: int = 0) -> Grasps:
    """Grasps of 20 objects, one object after the other; a tenth of the labels is wrong."""
    counts, slipped = separable_counts(grasps, seed)
    counts[:, 0, 16:20] -= np.uint16(drift)
    wrong = np.random.default_rng(seed).random(grasps) < 0.1
    objects = tuple(OBJECTS[index * len(OBJECTS) // grasps] for index in range(grasps))
    file = Dataset(name, hashlib.sha256(counts.tobytes()).hexdigest(), grasps)
    return Grasps(counts, slipped ^ wrong, objects, (file,))


def sessions(grasps: int) -> Grasps:
    """Three tables of so many grasps each."""
    return concatenate(_tables(grasps))


def write_sessions(folder: Path, grasps: int) -> None:
    """The same as tables in the published form."""
    folder.mkdir(parents=True, exist_ok=True)
    for made in _tables(grasps):
        write(folder / f"{made.files[0].name}.csv", made)


def _tables(grasps: int) -> list[Grasps]:
    return [
        table(name, grasps, seed, drift=800 if name == "palm_45" else 0)
        for seed, name in enumerate(TABLES)
    ]


def write(path: Path, made: Grasps) -> None:
    """Grasps as a table in the published form."""
    write_table(path, made.counts, made.slipped, made.objects)
