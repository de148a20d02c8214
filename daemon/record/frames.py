"""Recordings as tables of pandas."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from graspd.biotac import electrode_columns
from graspd.drivers.base import JointReading, RecordingError, TactileReading
from graspd.drivers.recordings.csv_player import ReplayDriver
from graspd.drivers.recordings.csv_rows import OBJECT, SLIPPED, TIME, Row, columns_of, read_rows
from graspd.drivers.recordings.kinds import BAGS, Kind, kind_of
from graspd.extras import require

if TYPE_CHECKING:
    from graspd.daemon.record.export import Export
    from graspd.daemon.record.player import McapReplayDriver
    from graspd.drivers.recordings.bag import BagDriver


def read_grasps(path: str | os.PathLike[str]) -> pd.DataFrame:
    """Return grasps with known outcome: columns `object`, `slipped` and, finger by finger, counts.

    `path`: a grasp table (CSV, or Parquet from `graspd export-grasps`), or a recording (MCAP).
    Raises `RecordingError`.
    """
    path = Path(path)
    kind = kind_of(path)
    if kind is Kind.PARQUET:
        return pd.read_parquet(path)
    if kind is Kind.MCAP:
        require("mcap", "read_grasps of MCAP", "record")
        from graspd.daemon.record.export import collect

        return grasps_of(collect([path]), "unknown")
    if kind is not Kind.TEXT:
        raise RecordingError(path, f"is {kind.value}, which does not say how lifts ended")
    fingers, columns = _fingers(path), columns_of(path, ())
    if columns.is_stream:
        raise RecordingError(path, "is a stream and no grasp table: read_recording reads it")
    if not columns.has_labels:
        raise RecordingError(path, f"has no column `{SLIPPED}`: the outcomes are not known")
    rows = list(read_rows(path, fingers))
    notes = [row.annotation for row in rows]
    labels = {
        OBJECT: [note.object_name for note in notes],
        SLIPPED: [bool(note.slipped) for note in notes],
    }
    return pd.concat([pd.DataFrame(labels), _counts(rows, fingers)], axis=1)


def read_recording(path: str | os.PathLike[str]) -> pd.DataFrame:
    """Return a stream, one row a reading: `t` in seconds, counts, then joint angles in radians.

    `path`: CSV, MCAP or a ROS bag. A count that is missing or damaged is NaN; an angle is the
    newest one.
    Raises `RecordingError`.
    """
    path = Path(path)
    driver: ReplayDriver | McapReplayDriver | BagDriver
    fingers: tuple[str, ...]
    kind = kind_of(path)
    if kind in BAGS:
        require("rosbags", "reading a ROS bag", "bag")
        from graspd.drivers.recordings.bag import BagDriver, fingers_of

        fingers = fingers_of(path)
        driver = BagDriver([path], fingers)
    elif kind is Kind.MCAP:
        require("mcap", "read_recording of MCAP", "record")
        from graspd.daemon.record.mcap_reader import header_of
        from graspd.daemon.record.player import McapReplayDriver

        fingers = header_of(path).fingers
        driver = McapReplayDriver([path], fingers)
    else:
        fingers = _fingers(path)
        driver = ReplayDriver([path], fingers, speed=None)
    rows: list[TactileReading] = []
    joints: list[dict[str, float]] = []
    angles: dict[str, float] = {}
    with driver:
        while not driver.exhausted:
            for reading in driver.read_ready():
                if isinstance(reading, JointReading):
                    angles |= zip(reading.names, reading.position_rad.tolist(), strict=True)
                else:
                    rows.append(reading)
                    joints.append(dict(angles))
    if not rows:
        raise RecordingError(path, "has no readings")
    times = pd.DataFrame({TIME: [reading.made_ns / 1e9 for reading in rows]})
    return pd.concat([times, _counts(rows, fingers), pd.DataFrame(joints)], axis=1)


def grasps_of(export: Export, object_name: str) -> pd.DataFrame:
    """Return the grasps of an export; `object_name` is for grasps without one."""
    grasps = list(export.grasps.values())
    labels = {
        OBJECT: [object_name if each.object_name is None else each.object_name for each in grasps],
        SLIPPED: [each.slipped for each in grasps],
    }
    counts = np.array([each.counts for each in grasps], dtype=np.uint16)
    return pd.concat([pd.DataFrame(labels), _table(counts, export.fingers)], axis=1)


def _fingers(path: Path) -> tuple[str, ...]:
    """Return the fingers that a CSV file has."""
    fingers = columns_of(path, ()).fingers
    if not fingers:
        raise RecordingError(path, "has no columns of electrodes, such as ff_biotac_1")
    return fingers


def _counts(rows: Sequence[TactileReading | Row], fingers: Sequence[str]) -> pd.DataFrame:
    """Return the counts of readings; NaN where an electrode is faulty."""
    counts: NDArray[np.generic] = np.array([row.counts for row in rows])
    faulty = np.array([row.faults for row in rows]) != 0
    return _table(np.where(faulty, np.nan, counts) if faulty.any() else counts, fingers)


def _table(counts: NDArray[np.generic], fingers: Sequence[str]) -> pd.DataFrame:
    columns = [name for finger in fingers for name in electrode_columns(finger)]
    return pd.DataFrame(counts.reshape(-1, len(columns)), columns=columns)
