"""Recordings as tables of pandas."""

from __future__ import annotations

import os
import warnings
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from graspd.biotac import electrode_columns
from graspd.drivers.base import JointReading, RecordingError, TactileReading
from graspd.drivers.recordings.columns import OBJECT, SLIPPED, TIME
from graspd.drivers.recordings.csv_player import ReplayDriver
from graspd.drivers.recordings.csv_rows import Row, read_rows
from graspd.drivers.recordings.kinds import BAGS, TABLES, Kind, files_of, kind_of, refuse_options
from graspd.drivers.recordings.layout import ReadAs, layout_of
from graspd.extras import require

with suppress(ModuleNotFoundError):  # without pandas each call says what to install
    import pandas as pd

if TYPE_CHECKING:
    from graspd.daemon.record.export import Export
    from graspd.daemon.record.player import McapReplayDriver
    from graspd.drivers.recordings.bag import BagDriver


def read_grasps(path: str | os.PathLike[str], *, read_as: ReadAs | None = None) -> pd.DataFrame:
    """Return grasps with known outcome: `object`, `slipped`, and counts, `ff_biotac_1` and so on.

    `path`: a grasp table, or a recording (MCAP); `-` is standard input. Pass `read_as="table"`
    for a table in which many rows repeat each other. A missing or damaged count is NaN. Grasps
    without an outcome are left out with a warning; of a recording also those after damage, judged
    with repaired electrodes, or with the counts of another grasp. Raises `RecordingError`,
    and `ModuleNotFoundError` without pandas.
    """
    require("pandas", "graspd.read_grasps", "pandas")
    with files_of([Path(path)]) as (file,):
        return _grasps(file, read_as)


def _grasps(path: Path, read_as: ReadAs | None) -> pd.DataFrame:
    kind = kind_of(path)
    refuse_options(path, kind, {"read_as": read_as})
    if kind is Kind.MCAP:
        require("mcap", "read_grasps of MCAP", "record")
        from graspd.daemon.record.export import collect

        export = collect([path])
        if lacks := "; ".join(export.lacks()):
            warnings.warn(f"{path}: {lacks}", stacklevel=3)
        return grasps_of(export, "unknown")
    if kind not in TABLES:
        raise RecordingError(path, f"is {kind.value}, which does not say how lifts ended")
    layout = layout_of(path, (), read_as)
    if layout.is_stream:
        raise RecordingError(path, "is a stream and no grasp table: read_recording reads it")
    if layout.columns.slipped is None:
        raise RecordingError(path, f"has no column `{SLIPPED}`: the outcomes are not known")
    every = list(read_rows(path, (), outcomes=True, layout=layout))
    rows = [row for row in every if row.annotation.slipped is not None]
    if len(rows) < len(every):
        left_out = f"{len(every) - len(rows)} of {len(every)} grasps have no outcome"
        warnings.warn(f"{path}: {left_out}, and are left out", stacklevel=3)
    labels = {
        OBJECT: [row.annotation.object_name for row in rows],
        SLIPPED: [bool(row.annotation.slipped) for row in rows],
    }
    return pd.concat([pd.DataFrame(labels), _counts(rows, layout.columns.fingers)], axis=1)


def read_recording(
    path: str | os.PathLike[str],
    *,
    read_as: ReadAs | None = None,
    rate_hz: float | None = None,
) -> pd.DataFrame:
    """Return a stream, one row a reading: `t` in seconds, counts, then joint angles in radians.

    `path`: a stream, a recording (MCAP) or a ROS bag; `-` is standard input. A missing or
    damaged count is NaN. Each row has the newest angles. A stream without times needs
    `read_as="stream"` and `rate_hz`. Raises `RecordingError`, and `ModuleNotFoundError` without
    pandas.
    """
    require("pandas", "graspd.read_recording", "pandas")
    with files_of([Path(path)]) as (file,):
        return _readings(file, read_as, rate_hz)


def _readings(path: Path, read_as: ReadAs | None, rate_hz: float | None) -> pd.DataFrame:
    driver: ReplayDriver | McapReplayDriver | BagDriver
    fingers: tuple[str, ...]
    kind = kind_of(path)
    refuse_options(path, kind, {"read_as": read_as, "rate_hz": rate_hz})
    if kind in BAGS:
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
        layout = layout_of(path, (), read_as, rate_hz)
        if not layout.is_stream:
            raise RecordingError(path, "is a grasp table and no stream: read_grasps reads it")
        fingers = layout.columns.fingers
        layouts = {path: layout}
        driver = ReplayDriver([path], fingers, layouts=layouts, speed=None, rate_hz=rate_hz)
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
    """Return an export as `read_grasps` does a table; `object_name`: for grasps without one."""
    grasps = list(export.grasps.values())
    labels = {
        OBJECT: [object_name if each.object_name is None else each.object_name for each in grasps],
        SLIPPED: [each.slipped for each in grasps],
    }
    counts = np.array([each.counts for each in grasps], dtype=np.uint16)
    return pd.concat([pd.DataFrame(labels), _table(counts, export.fingers)], axis=1)


def _counts(rows: Sequence[TactileReading | Row], fingers: Sequence[str]) -> pd.DataFrame:
    """Return the counts of readings; NaN where an electrode is faulty."""
    counts: NDArray[np.generic] = np.array([row.counts for row in rows])
    faulty = np.array([row.faults for row in rows]) != 0
    return _table(np.where(faulty, np.nan, counts) if faulty.any() else counts, fingers)


def _table(counts: NDArray[np.generic], fingers: Sequence[str]) -> pd.DataFrame:
    columns = [name for finger in fingers for name in electrode_columns(finger)]
    return pd.DataFrame(counts.reshape(-1, len(columns)), columns=columns)
