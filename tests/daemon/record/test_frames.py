"""Tables of pandas hold what the files hold."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from graspd.daemon.record.frames import read_grasps, read_recording
from graspd.drivers.base import RecordingError
from graspd.drivers.recordings.csv_player import DEMO_RECORDING, DEMO_TABLE


def test_a_grasp_table_is_what_pandas_itself_reads(tmp_path: Path) -> None:
    expected = pd.read_csv(DEMO_TABLE)
    got = read_grasps(DEMO_TABLE)
    assert set(got.columns) == set(expected.columns)
    assert got["slipped"].dtype == bool
    pd.testing.assert_frame_equal(got, expected[got.columns], check_dtype=False)
    got.to_parquet(tmp_path / "grasps.parquet")
    pd.testing.assert_frame_equal(read_grasps(tmp_path / "grasps.parquet"), got)


def test_a_stream_is_what_pandas_itself_reads() -> None:
    expected = pd.read_csv(DEMO_RECORDING)
    got = read_recording(DEMO_RECORDING)
    counts = [name for name in expected.columns if "_biotac_" in name]
    angles = [name for name in got.columns if name.endswith(("J1", "J2", "J3", "J4", "J5"))]
    assert len(angles) > 1
    np.testing.assert_array_equal(got[counts], expected[counts])
    np.testing.assert_array_equal(got[angles], expected[angles])
    np.testing.assert_allclose(got["t"] - got["t"][0], expected["t"] - expected["t"][0], atol=1e-9)


def test_a_damaged_count_is_nan(tmp_path: Path) -> None:
    header, row, *_ = DEMO_TABLE.read_text().splitlines()
    cells = dict(zip(header.split(","), row.split(","), strict=True)) | {"mf_biotac_3": "9999"}
    (tmp_path / "grasps.csv").write_text(f"{header}\n{','.join(cells.values())}\n")
    got = read_grasps(tmp_path / "grasps.csv")
    assert np.argwhere(got.isna().to_numpy()).tolist() == [[0, got.columns.get_loc("mf_biotac_3")]]


def test_a_stream_or_a_table_without_outcomes_is_refused(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match="is a stream"):
        read_grasps(DEMO_RECORDING)
    table = tmp_path / "grasps.csv"
    pd.read_csv(DEMO_TABLE).drop(columns="slipped").to_csv(table, index=False)
    with pytest.raises(RecordingError, match="no column `slipped`"):
        read_grasps(table)


def test_a_file_without_electrodes_is_refused(tmp_path: Path) -> None:
    (tmp_path / "other.csv").write_text("a,b\n1,2\n")
    with pytest.raises(RecordingError, match="no columns of electrodes"):
        read_recording(tmp_path / "other.csv")
