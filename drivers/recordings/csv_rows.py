"""Read CSV recordings row by row, so that memory does not grow.

A grasp table has one row per grasp, as in the BioTac SP Stability Set. A stream has one row per
sweep, with a column `t` in seconds and optional joint angles.
"""

from __future__ import annotations

import csv
import math
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import Self

import numpy as np
from numpy.typing import NDArray

from graspd.biotac import COUNT_MAX, ELECTRODES, FINGERS, electrode_columns
from graspd.drivers.base import Annotation, ElectrodeFault, RecordingError, joint_name
from graspd.drivers.recordings.kinds import LINE_BYTES_MAX, open_recording, read_lines

TIME = "t"
"""Column of seconds, with any zero. Files with it are streams, files without it grasp tables."""
OBJECT = "object"
SLIPPED = "slipped"
TIME_MAX_S = 1e11
"""Largest time, s (the year 5138). Unix time in ms, us or ns lies above it."""
SHOWN_LENGTH_MAX = 40
"""Most characters of a cell in an error message."""

_LABELS = {"0": False, "1": True}
# ASCII digits only: float() also takes `1_000`, `nan` and digits of other scripts.
_NUMBER = re.compile(r"[+-]?([0-9]+\.?[0-9]*|\.[0-9]+)([eE][+-]?[0-9]{1,3})?")
# Counts by their usual text: a look-up is ten times as fast as parsing.
_COUNT_OF_TEXT = {str(count): count for count in range(COUNT_MAX + 1)}


@dataclass(frozen=True, slots=True)
class Columns:
    """Names of the columns that are read from a file."""

    electrodes: tuple[str, ...]
    """Electrode columns, finger by finger, E1 to E24 each."""
    joints: Mapping[str, str]
    """Joint name, without hand prefix, by column; empty for a table."""
    is_stream: bool
    has_labels: bool
    ignored: tuple[str, ...]
    """Columns of unknown names; electrodes of other fingers do not count."""
    fingers: tuple[str, ...]
    """Fingers that the file has, asked for or not."""

    @classmethod
    def of(cls, names: Sequence[str], fingers: Sequence[str]) -> Self:
        """Return the columns to read for `fingers`. `names`: the header."""
        own_columns = {name for finger in FINGERS for name in electrode_columns(finger)}
        own_columns |= {TIME, OBJECT, SLIPPED}
        is_stream = TIME in names
        joints: dict[str, str] = {}
        if is_stream:
            joints = {name: joint for name in names if (joint := joint_name(name))}
        return cls(
            electrodes=tuple(name for finger in fingers for name in electrode_columns(finger)),
            joints=joints,
            is_stream=is_stream,
            has_labels=SLIPPED in names,
            ignored=tuple(name for name in names if name not in own_columns and name not in joints),
            fingers=tuple(each for each in FINGERS if electrode_columns(each)[0] in names),
        )


@dataclass(frozen=True, slots=True, eq=False)
class Row:
    """One row of a file."""

    counts: NDArray[np.uint16]
    """Shape (fingers, 24)."""
    faults: NDArray[np.uint8]
    """Shape (fingers, 24), `ElectrodeFault` bits."""
    annotation: Annotation
    t_s: float | None
    """Time of the row, s, never lower than before; None for a table."""
    joint_names: tuple[str, ...]
    position_rad: NDArray[np.float64]
    """Shape (joints,), radians; NaN where the file has no angle."""


class Recording:
    """The rows of one file. Iterate once.

    `lines`: the result of `read_lines`. The constructor raises `RecordingError` for a wrong header
    or a file without rows, and iterating raises it for a wrong row. A value that is no count makes
    its electrode faulty; with `strict` it raises.

    A count is an integer in 0..4095 in ASCII digits: `2602`, `2602.0` or `2.602e3`. A last row
    without a line end may be cut off within a value, so all its electrodes are faulty and its
    angles NaN.
    """

    def __init__(
        self, path: Path, lines: Iterable[bytes], fingers: Sequence[str], *, strict: bool = False
    ) -> None:
        self._path = path
        self._strict = strict
        self._has_end = True
        self._shape = (len(fingers), ELECTRODES)
        self._t_s = -math.inf
        rows = self._cells(lines)
        header = next(rows, None)
        if header is None:
            raise RecordingError(path, "the file is empty")
        self._names = [name.strip() for name in header]
        self.columns = Columns.of(self._names, fingers)
        self._refuse_header()
        first = next(rows, None)
        if first is None:
            raise RecordingError(path, "the file has a header and no rows")
        self._rows = chain([first], rows)

    def __iter__(self) -> Iterator[Row]:
        for cells in self._rows:
            yield self._row(cells)

    def _cells(self, lines: Iterable[bytes]) -> Iterator[list[str]]:
        """Yield the cells of each line that is not blank; `_line` is its number."""
        for self._line, line in enumerate(lines, 1):
            if len(line) > LINE_BYTES_MAX:
                raise self._error(f"the line is longer than {LINE_BYTES_MAX} bytes")
            self._has_end = line.endswith(b"\n")
            try:
                text = line.decode("utf-8-sig" if self._line == 1 else "utf-8").rstrip("\r\n")
                rows = list(csv.reader([text], strict=True)) if text.strip() else []
            except UnicodeDecodeError as error:
                problem = "not UTF-8: this is a binary file or has another encoding"
                raise self._error(problem) from error
            except csv.Error as error:
                raise self._error(f"this is not CSV: {error}") from error
            yield from rows

    def _refuse_header(self) -> None:
        """Raise if a column is missing or there twice, or a joint under two names."""
        missing = [name for name in self.columns.electrodes if name not in self._names]
        if missing:
            others = f", the first of {len(missing)} that are" if len(missing) > 1 else ""
            raise self._error(f"this column is missing{others}", missing[0])
        joints = self.columns.joints
        read = {*self.columns.electrodes, TIME, OBJECT, SLIPPED, *joints}
        column_of: dict[str, str] = {}
        for name in self._names:
            if name not in read:
                continue
            meaning = joints.get(name, name)
            if meaning in column_of:
                raise self._error(f"this column is there twice, as {column_of[meaning]} too", name)
            column_of[meaning] = name

    def _row(self, cells: Sequence[str]) -> Row:
        if len(cells) != len(self._names):
            raise self._error(f"the row has {len(cells)} cells, the header {len(self._names)}")
        cell_of = dict(zip(self._names, cells, strict=True))
        counts, faults = self._counts(cell_of)
        if not self._has_end:
            if self._strict:
                raise self._error("the last row has no line end")
            faults |= np.uint8(ElectrodeFault.CUT_OFF)
        return Row(
            counts=counts,
            faults=faults,
            annotation=Annotation(
                source=self._path,
                line=self._line,
                object_name=cell_of.get(OBJECT, "").strip() or None,
                slipped=self._slipped(cell_of),
            ),
            t_s=self._time_s(cell_of),
            joint_names=tuple(self.columns.joints.values()),
            position_rad=self._position_rad(cell_of),
        )

    def _counts(self, cell_of: Mapping[str, str]) -> tuple[NDArray[np.uint16], NDArray[np.uint8]]:
        """Return counts and faults of a row, shape (fingers, 24) each."""
        names = self.columns.electrodes
        counts = [count_of(cell_of[name]) for name in names]
        faults = np.zeros(self._shape, dtype=np.uint8)
        for place, count in enumerate(counts):
            if count is not None:
                continue
            if self._strict:
                problem = f"is not a count, an integer in 0..{COUNT_MAX}"
                raise self._error(f"{_shown(cell_of[names[place]])} {problem}", names[place])
            faults.flat[place] = ElectrodeFault.NOT_A_COUNT
            counts[place] = 0
        return np.array(counts, dtype=np.uint16).reshape(self._shape), faults

    def _slipped(self, cell_of: Mapping[str, str]) -> bool | None:
        if not self.columns.has_labels:
            return None
        label = _LABELS.get(cell_of[SLIPPED].strip())
        if label is None:
            problem = f"{_shown(cell_of[SLIPPED])} is not a label: 0 (stable) or 1 (slip)"
            raise self._error(problem, SLIPPED)
        return label

    def _time_s(self, cell_of: Mapping[str, str]) -> float | None:
        if not self.columns.is_stream:
            return None
        t_s = number_of(cell_of[TIME])
        if t_s is None:
            raise self._error(f"{_shown(cell_of[TIME])} is not a finite number of seconds", TIME)
        if abs(t_s) > TIME_MAX_S:
            problem = f"{_shown(cell_of[TIME])} is no time in seconds: another unit?"
            raise self._error(problem, TIME)
        if t_s < self._t_s:
            raise self._error(f"time goes backwards, from {self._t_s} s to {t_s} s", TIME)
        self._t_s = t_s
        return t_s

    def _position_rad(self, cell_of: Mapping[str, str]) -> NDArray[np.float64]:
        position_rad = np.full(len(self.columns.joints), math.nan)
        for place, name in enumerate(self.columns.joints):
            angle = number_of(cell_of[name])
            if angle is None and self._strict:
                raise self._error(f"{_shown(cell_of[name])} is not an angle in radians", name)
            if angle is not None and self._has_end:
                position_rad[place] = angle
        return position_rad

    def _error(self, problem: str, column: str | None = None) -> RecordingError:
        if not self._has_end:
            problem += "; the file ends here without a line end, so it may be cut off"
        return RecordingError(self._path, problem, line=self._line, column=column)


def columns_of(path: Path, fingers: Sequence[str]) -> Columns:
    """Return the columns of a file. Raises `RecordingError` if it lacks `fingers`."""
    with open_recording(path) as file:
        return Recording(path, read_lines(path, file), fingers).columns


def read_rows(path: Path, fingers: Sequence[str], *, strict: bool = False) -> Iterator[Row]:
    """Yield the rows of a file: see `Recording`. Raises `RecordingError`."""
    with open_recording(path) as file:
        yield from Recording(path, read_lines(path, file), fingers, strict=strict)


def count_of(cell: str) -> int | None:
    """Return the 12-bit count in a cell; None if it holds no count."""
    count = _COUNT_OF_TEXT.get(cell)
    if count is not None:
        return count
    number = number_of(cell)
    if number is None or not number.is_integer() or not 0 <= number <= COUNT_MAX:
        return None
    return int(number)


def number_of(cell: str) -> float | None:
    """Return the finite number in a cell; None if it holds none."""
    cell = cell.strip()
    if _NUMBER.fullmatch(cell) is None:
        return None
    number = float(cell)
    return number if math.isfinite(number) else None


def _shown(cell: str) -> str:
    return repr(cell if len(cell) <= SHOWN_LENGTH_MAX else cell[:SHOWN_LENGTH_MAX] + "...")
