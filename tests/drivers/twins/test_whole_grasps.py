"""Whole grasps: the demos, generated again byte for byte, and no real grasp among them."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from graspd.drivers.recordings.csv_player import (
    DEMO_DAY,
    DEMO_RECORDING,
    DEMO_TABLE,
    SHOW_RECORDING,
)
from tests.kit import demos


def load(path: Path) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Counts (grasps, 72) and labels, read without the code under test."""
    with path.open(newline="") as file:
        rows = list(csv.reader(file))[1:]
    return np.array([row[2:] for row in rows], dtype=float), np.array([int(row[1]) for row in rows])


def test_the_demos_are_made_again_byte_for_byte(tmp_path: Path) -> None:
    demos.main(tmp_path)
    for demo in (DEMO_TABLE, DEMO_DAY, DEMO_RECORDING, SHOW_RECORDING):
        assert (tmp_path / demo.name).read_bytes() == demo.read_bytes()


def test_no_synthetic_grasp_is_a_real_one(bts3_dir: Path) -> None:
    counts, _ = load(DEMO_TABLE)
    real = np.vstack([load(bts3_dir / f"palm_{pose}.csv")[0] for pose in ("down", "side")])
    nearest = [np.abs(real - grasp).max(axis=1).min() for grasp in counts]
    assert min(nearest) > 100, "counts, at the electrode that differs most"
