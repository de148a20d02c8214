"""Recordings as CSV files, read as a stream: lines of bytes in, rows with counts out.

Two layouts, told apart by a column `t`: grasp tables (one row per grasp, as in the BioTac SP
Stability Set) and streams (one row per sweep, `t` in seconds, joint angles if recorded). Memory
does not grow with the file. Everything but `open_recording` and `read_lines` is pure.
"""

from __future__ import annotations

import csv
import math
import os
import re
import stat
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import chain
from operator import itemgetter
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from drivers.base import COUNT_MAX, ELECTRODES, Annotation, ElectrodeFault, RecordingError
from drivers.recordings.csv_columns import Columns

LINE_BYTES_MAX = 65_536
"""A row of five fingers and all joints has about 1,200 bytes. What is far longer is no recording,
and reading on for a line end could take in a whole disk image."""
TIME_MAX_S = 1e11
"""The year 5138. Unix time in ms, us or ns lies above it: the wrong unit, not a time in seconds."""
NUMBER_LENGTH_MAX = 32
"""Characters of a number; a double in full needs 24."""
SHOWN_LENGTH_MAX = 40
"""Characters of a cell that an error message shows."""

_BOM = b"\xef\xbb\xbf"
_SPACES = " \t"
_LABELS = {"0": False, "1": True}
# ASCII digits only: float() alone would take `1_000`, `nan` and digits of other scripts.
_UNSIGNED = re.compile(r"[0-9]+(\.[0-9]*)?([eE][+-]?[0-9]{1,2})?")
_SIGNED = re.compile(r"[+-]?([0-9]+\.?[0-9]*|\.[0-9]+)([eE][+-]?[0-9]{1,3})?")
# The usual way to write each count. Looking a cell up is as fast as int() and far stricter.
_COUNT_OF_TEXT = {str(count): count for count in range(COUNT_MAX + 1)}


@dataclass(frozen=True, slots=True, eq=False)
class Row:
    """One reading as the file has it."""

    counts: NDArray[np.uint16]
    """Shape (fingers, 24)."""
    faults: NDArray[np.uint8]
    """Shape (fingers, 24), `ElectrodeFault` bits."""
    annotation: Annotation
    t_s: float | None = None
    """Streams only; never falls from row to row."""
    position_rad: NDArray[np.float64] | None = None
    """Shape (joints,), NaN where there is no angle; None without joint columns."""


class Recording:
    """The rows of one file: iterate once.

    `lines` gives the file's lines with their ends, each at most `LINE_BYTES_MAX` + 1 bytes long
    (as `read_lines` does). The constructor takes the header and the first row's line, so it raises
    `RecordingError` for whatever is wrong with the header, and for a file without rows. Iterating
    raises it for a row that is not one. A value that is not a count only makes its electrode
    faulty, unless `strict`.

    A count is an integer in 0..4095, in ASCII digits, with spaces around it or not: `2602`,
    `2602.0` or `2.602e3`, but not `+2602` or `2_602`. A last row without a line end may be cut off
    in mid value: all its electrodes are faulty and its angles NaN.
    """

    def __init__(
        self, path: Path, lines: Iterable[bytes], fingers: Sequence[str], *, strict: bool = False
    ) -> None:
        self._path = path
        self._strict = strict
        self._ended = True
        texts = self._texts(lines)
        header = next(texts, None)
        if header is None:
            raise RecordingError(path, "the file is empty")
        self.columns = Columns.from_header(path, self._line, self._cells(header), fingers)
        first = next(texts, None)
        if first is None:
            raise RecordingError(path, "the file has a header and no rows")
        self._rest = chain([first], texts)
        self._pick = itemgetter(*self.columns.electrodes)
        self._shape = (len(fingers), ELECTRODES)
        self._t_s = -math.inf

    def __iter__(self) -> Iterator[Row]:
        for text in self._rest:
            yield self._row(text)

    def _texts(self, lines: Iterable[bytes]) -> Iterator[str]:
        """Lines as text without their ends, blank ones skipped; keeps the line number."""
        for self._line, raw in enumerate(lines, 1):
            if len(raw) > LINE_BYTES_MAX:
                raise self._error(f"the line is longer than {LINE_BYTES_MAX} bytes")
            if self._line == 1:
                raw = raw.removeprefix(_BOM)
            if b"\0" in raw:
                raise self._error("a NUL byte: this is a binary file, not CSV")
            try:
                text = raw.decode()
            except UnicodeDecodeError as error:
                problem = "not UTF-8: this is a binary file or has another encoding"
                raise self._error(problem) from error
            self._ended = text.endswith("\n")
            text = text.rstrip("\r\n")
            if "\r" in text:
                raise self._error("a carriage return inside the line: lines must end in LF or CRLF")
            if text and not text.isspace():
                yield text

    def _cells(self, text: str) -> list[str]:
        if '"' not in text:
            return text.split(",")
        try:
            if text.count('"') % 2 == 0:
                return next(csv.reader([text], strict=True))
        except csv.Error as error:
            raise self._error(f"wrong quotes: {error}") from error
        raise self._error("wrong quotes: they do not pair up")

    def _row(self, text: str) -> Row:
        columns = self.columns
        cells = self._cells(text)
        if len(cells) != len(columns.names):
            raise self._error(f"the row has {len(cells)} cells, the header {len(columns.names)}")
        picked = self._pick(cells)
        try:
            flat = np.fromiter(map(_COUNT_OF_TEXT.__getitem__, picked), np.uint16, len(picked))
            counts = flat.reshape(self._shape)
            faults = np.zeros(self._shape, dtype=np.uint8)
        except KeyError:
            counts, faults = self._careful_counts(picked)
        if not self._ended:
            if self._strict:
                raise self._error("the last row has no line end")
            faults |= np.uint8(ElectrodeFault.CUT_OFF)
        annotation = Annotation(
            source=self._path,
            line=self._line,
            object_name=self._object_name(cells),
            slipped=self._slipped(cells),
        )
        if columns.time is None:
            return Row(counts, faults, annotation)
        t_s = self._time_s(cells[columns.time])
        return Row(counts, faults, annotation, t_s, self._position_rad(cells))

    def _careful_counts(
        self, picked: Sequence[str]
    ) -> tuple[NDArray[np.uint16], NDArray[np.uint8]]:
        """Cell by cell, for rows with a count written in another way or with no count at all."""
        counts = np.zeros(len(picked), dtype=np.uint16)
        faults = np.zeros(len(picked), dtype=np.uint8)
        for index, cell in enumerate(picked):
            count = count_of(cell)
            if count is not None:
                counts[index] = count
            elif self._strict:
                raise self._error(
                    f"{shown(cell)} is not a count, an integer in 0..{COUNT_MAX}",
                    self.columns.electrodes[index],
                )
            else:
                faults[index] = ElectrodeFault.NOT_A_COUNT
        return counts.reshape(self._shape), faults.reshape(self._shape)

    def _object_name(self, cells: Sequence[str]) -> str | None:
        place = self.columns.object_name
        return None if place is None else cells[place].strip() or None

    def _slipped(self, cells: Sequence[str]) -> bool | None:
        place = self.columns.slipped
        if place is None:
            return None
        label = _LABELS.get(cells[place].strip(_SPACES))
        if label is None:
            raise self._error(
                f"{shown(cells[place])} is not a label: 0 (stable) or 1 (slip)", place
            )
        return label

    def _time_s(self, cell: str) -> float:
        t_s = number_of(cell)
        if t_s is None:
            raise self._error(f"{shown(cell)} is not a finite number of seconds", self.columns.time)
        if abs(t_s) > TIME_MAX_S:
            raise self._error(
                f"{shown(cell)} is no time in seconds: another unit?", self.columns.time
            )
        if t_s < self._t_s:
            raise self._error(
                f"time goes backwards, from {self._t_s} s to {t_s} s", self.columns.time
            )
        self._t_s = t_s
        return t_s

    def _position_rad(self, cells: Sequence[str]) -> NDArray[np.float64] | None:
        if not self.columns.joints:
            return None
        angles = [number_of(cells[place]) for place in self.columns.joints]
        if self._strict and None in angles:
            place = self.columns.joints[angles.index(None)]
            raise self._error(f"{shown(cells[place])} is not an angle in radians", place)
        if not self._ended:
            return np.full(len(angles), math.nan)
        return np.array([math.nan if angle is None else angle for angle in angles])

    def _error(self, problem: str, place: int | None = None) -> RecordingError:
        """What is wrong with the line at hand; `place` is the index of a cell."""
        if not self._ended:
            problem += "; the file ends here without a line end, so it may be cut off"
        column = None if place is None else self.columns.names[place]
        return RecordingError(self._path, problem, line=self._line, column=column)


def columns_of(path: Path, fingers: Sequence[str]) -> Columns:
    """What a recording's columns hold. Raises `RecordingError` if it is none of these fingers."""
    with open_recording(path) as file:
        return Recording(path, read_lines(path, file), fingers).columns


def read_rows(path: Path, fingers: Sequence[str], *, strict: bool = False) -> Iterator[Row]:
    """The rows of a file, as those of a `Recording`. Raises `RecordingError`."""
    with open_recording(path) as file:
        yield from Recording(path, read_lines(path, file), fingers, strict=strict)


def open_recording(path: Path) -> BinaryIO:
    """Open a recording. Raises `RecordingError` unless it is a regular file that can be read."""
    try:
        mode = os.stat(path).st_mode
        if stat.S_ISREG(mode):
            return path.open("rb")
    except (OSError, ValueError) as error:  # ValueError: a NUL in the path
        raise RecordingError(path, _reason(error)) from error
    raise RecordingError(path, "is a directory" if stat.S_ISDIR(mode) else "is not a regular file")


def read_lines(path: Path, stream: BinaryIO) -> Iterator[bytes]:
    """Lines of `stream` with their ends, cut at `LINE_BYTES_MAX` + 1 bytes."""
    while True:
        try:
            line = stream.readline(LINE_BYTES_MAX + 1)
        except OSError as error:
            raise RecordingError(path, _reason(error)) from error
        if not line:
            return
        yield line


def count_of(cell: str) -> int | None:
    """The 12-bit count that a cell holds, or None if it holds no such count."""
    cell = cell.strip(_SPACES)
    if len(cell) > NUMBER_LENGTH_MAX or _UNSIGNED.fullmatch(cell) is None:
        return None
    value = float(cell)
    return int(value) if value.is_integer() and value <= COUNT_MAX else None


def number_of(cell: str) -> float | None:
    """The finite number that a cell holds, or None."""
    cell = cell.strip(_SPACES)
    if len(cell) > NUMBER_LENGTH_MAX or _SIGNED.fullmatch(cell) is None:
        return None
    value = float(cell)
    return value if math.isfinite(value) else None


def shown(cell: str) -> str:
    """A cell as an error message shows it: quoted, escaped and of bounded length."""
    return repr(cell if len(cell) <= SHOWN_LENGTH_MAX else cell[:SHOWN_LENGTH_MAX] + "...")


def _reason(error: OSError | ValueError) -> str:
    system = error.strerror if isinstance(error, OSError) else None
    return (system or str(error)).lower()
