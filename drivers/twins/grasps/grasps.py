"""Read the counts of a recording, for a twin to play."""

from __future__ import annotations

import ast
import csv
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from graspd.drivers.base import COUNT_MAX, ELECTRODES, FINGERS, RecordingError
from graspd.drivers.recordings.csv_rows import read_rows

Counts = NDArray[np.uint16]
"""Shape (fingers, 24), raw counts 0..4095."""

TACTILES_COLUMN = "tactiles"
"""Column of a Shadow hand's recording as exported from a ROS bag.

Its header has 43 columns, its rows 38. Finger i, in the order FF MF RF LF TH, starts at column
8 + 6 i.
"""
_FIRST_FINGER_CELL, _CELLS_PER_FINGER, _ELECTRODES_CELL = 8, 6, 5


def recorded_counts(path: Path, fingers: Sequence[str] = ("ff", "mf", "th")) -> Iterator[Counts]:
    """Yield the counts of a grasp table, stream or ROS export. Raises `RecordingError`."""
    try:
        with path.open(newline="") as file:
            header = file.readline(64 * 1024)
    except (OSError, UnicodeDecodeError) as error:
        raise RecordingError(path, f"cannot be read: {error}") from error
    if TACTILES_COLUMN in header.split(","):
        yield from _exported_counts(path, fingers)
        return
    for row in read_rows(path, fingers):
        if row.faults.any():
            raise RecordingError(path, "holds a value that is no count", line=row.annotation.line)
        yield row.counts


def _exported_counts(path: Path, fingers: Sequence[str]) -> Iterator[Counts]:
    with path.open(newline="") as file:
        rows = csv.reader(file)
        next(rows)
        for cells in rows:
            try:
                yield np.array([_electrodes(cells, finger) for finger in fingers], dtype=np.uint16)
            except (IndexError, SyntaxError, TypeError, ValueError) as error:
                raise RecordingError(path, f"bad row: {error}", line=rows.line_num) from error


def _electrodes(cells: Sequence[str], finger: str) -> list[int]:
    start = _FIRST_FINGER_CELL + _CELLS_PER_FINGER * FINGERS.index(finger)
    counts = ast.literal_eval(cells[start + _ELECTRODES_CELL])
    if len(counts) != ELECTRODES or not all(0 <= count <= COUNT_MAX for count in counts):
        raise ValueError(f"{finger} has no {ELECTRODES} counts")
    return list(counts)
