"""Whole grasps: the demos, which hold their course and noise byte for byte, and held values."""

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
from graspd.drivers.twins.grasps.whole_grasps import (
    synthetic_grasps,
)
from tests.drivers.recordings.tables import rows_of
from tests.kit import demos
from tests.kit.demos import STREAM_DURATIONS


def test_the_demo_has_twelve_synthetic_grasps_and_six_slips() -> None:
    assert DEMO_RECORDING.stat().st_size < 1_200_000
    rows = rows_of(DEMO_RECORDING.read_bytes(), strict=True)
    times = [row.t_s for row in rows if row.t_s is not None]
    np.testing.assert_allclose(times, 0.01 * np.arange(len(rows)), atol=1e-9)
    names = {row.annotation.object_name for row in rows}
    assert all(name is None or name.startswith("synthetic") for name in names)
    assert all(np.isfinite(row.position_rad).all() for row in rows)
    timetables = list(synthetic_grasps(12, durations=STREAM_DURATIONS).timetables())
    assert len(timetables) == 12
    assert sum(timetable.slipped for timetable in timetables) == 6
    for timetable in timetables:
        row = rows[round(timetable.lift_s * 100.0)]
        assert row.annotation.slipped is timetable.slipped
        assert row.annotation.object_name == timetable.object_name


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
