"""Read tables and streams row by row, so that memory does not grow.

A grasp table has one row per grasp, as in the BioTac SP Stability Set. A stream has one row per
sweep, with a column of times and optional joint angles.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from operator import itemgetter
from pathlib import Path
from typing import BinaryIO, Final

import numpy as np
from numpy.typing import NDArray

from graspd.biotac import COUNT_MAX, ELECTRODES
from graspd.drivers.base import ANGLE_MAX_RAD, Annotation, ElectrodeFault
from graspd.drivers.recordings.cells import Cells
from graspd.drivers.recordings.columns import SLIPPED
from graspd.drivers.recordings.kinds import open_recording
from graspd.drivers.recordings.layout import Layout, survey
from graspd.drivers.recordings.values import (
    COUNT_OF_TEXT,
    are_texts,
    count_of,
    has_thousands,
    number_of,
    outcome_of,
    problem_with,
    shown,
)

TIME_SPAN_MAX_S: Final = 4e9
"""Longest time between a row and the first, s. A clock that is set jumps by up to 1.8e9 s, from
1970 on; nanoseconds of 64 bits end at 9.2e9 s."""


@dataclass(frozen=True, slots=True)
class Row:
    """One row of a file."""

    counts: NDArray[np.uint16]
    """Shape (fingers, 24)."""
    faults: NDArray[np.uint8]
    """`ElectrodeFault` bits of each electrode, shape (fingers, 24)."""
    annotation: Annotation
    t_s: float | None
    """Time of the row, s, never lower than before; None for a table."""
    joint_names: tuple[str, ...]
    position_rad: NDArray[np.float64]
    """Shape (joints,), radians; NaN where the file has no possible angle."""


class Recording:
    """The rows of one file. Iterate once.

    Iterating raises `RecordingError` for a wrong row. A value that is not a count makes its
    electrode faulty; with `strict` it raises. An unreadable outcome counts as not known; with
    `outcomes` it raises.

    A count is an integer in 0..4095 in ASCII digits: `2602`, `2602.0` or `2.602e3`. A last row
    without a line end may be cut off within a value, so all its electrodes are faulty and its
    angles NaN. With `strict` such a row raises, as does a value that is not an angle.
    """

    def __init__(
        self, path: Path, file: BinaryIO, layout: Layout, *, strict: bool, outcomes: bool
    ) -> None:
        """`file`: opened, at its start. `layout`: of this file. `strict`, `outcomes`: True raises
        for a value that is not a count, and for an unreadable outcome."""
        self._path = path
        self._strict = strict
        self._outcomes = outcomes
        self.layout = layout
        columns = self.layout.columns
        self._cells = Cells(path, file)
        self._comma = self._cells.decimal_comma
        self._electrodes = columns.electrodes
        self._pick = itemgetter(*columns.electrodes)
        self._shape = len(columns.electrodes) // ELECTRODES, ELECTRODES
        self._joints = tuple(self.layout.joints)
        self._t_s = -math.inf
        self._first_s: float | None = None
        self._row_number = 0

    def __iter__(self) -> Iterator[Row]:
        for cells in self._cells:
            yield self._row(cells)
            self._row_number += 1

    def _row(self, cells: Sequence[str]) -> Row:
        counts, faults = self._counts(cells)
        if not self._cells.has_end:
            if self._strict:
                raise self._cells.error("the last row has no line end")
            faults |= np.uint8(ElectrodeFault.CUT_OFF)
        place = self.layout.columns.object
        return Row(
            counts=counts,
            faults=faults,
            annotation=Annotation(
                source=self._path,
                line=self._cells.line,
                object_name=None if place is None else cells[place].strip() or None,
                slipped=self._slipped(cells),
            ),
            t_s=self._time_s(cells),
            joint_names=self._joints,
            position_rad=self._position_rad(cells),
        )

    def _counts(self, cells: Sequence[str]) -> tuple[NDArray[np.uint16], NDArray[np.uint8]]:
        """Return counts and faults of a row, shape (fingers, 24) each."""
        texts = self._pick(cells)
        counts = list(map(COUNT_OF_TEXT.get, texts))
        faults = np.zeros(self._shape, dtype=np.uint8)
        if None in counts:
            for place, count in enumerate(counts):
                if count is None:
                    counts[place] = self._unusual(texts[place], place, faults)
            if faults.all() and are_texts(texts):
                begin = (text.lstrip()[:1] for text in texts)
                problem = problem_with(texts, decimal_comma=self._comma)
                if problem is None or not any(map(str.isdigit, begin)):
                    problem = "has text in place of counts: another header, or units?"
                raise self._cells.error(problem)
        return np.array(counts, dtype=np.uint16).reshape(self._shape), faults

    def _unusual(self, text: str, place: int, faults: NDArray[np.uint8]) -> int:
        """Return the count in a cell of unusual text; without one, return 0 and flag its electrode.

        `place`: that electrode, in `faults` laid flat. Raises instead of flagging if strict.
        """
        count = count_of(text, decimal_comma=self._comma)
        if count is not None:
            return count
        if self._strict:
            problem = f"{shown(text)} is not a count, an integer in 0..{COUNT_MAX}"
            raise self._cells.error(problem, self._name(self._electrodes[place]))
        faults.flat[place] = ElectrodeFault.NOT_A_COUNT
        return 0

    def _slipped(self, cells: Sequence[str]) -> bool | None:
        place = self.layout.columns.slipped
        if place is None:
            return None
        try:
            return outcome_of(cells[place])
        except ValueError as error:
            if self._outcomes:
                raise self._cells.error(str(error), SLIPPED) from error
            return None

    def _time_s(self, cells: Sequence[str]) -> float | None:
        layout = self.layout
        column = layout.columns.time
        if layout.rate_hz is not None:
            return self._row_number / layout.rate_hz
        if not layout.is_stream or column is None:
            return None
        value = column.value(cells, decimal_comma=self._comma)
        if value is None:
            problem = f"{shown(cells[column.places[0]])} is not a time, such as 12.34 in seconds"
            raise self._cells.error(problem, column.name)
        t_s = value * layout.unit_s
        if t_s < self._t_s:
            problem = f"time goes backwards, from {self._t_s} s to {t_s} s"
            if self._comma and has_thousands(cells[column.places[0]]):
                cell = shown(cells[column.places[0]])
                problem += f"; has {cell} a separator of thousands? write times without one"
            raise self._cells.error(problem, column.name)
        self._first_s = t_s if self._first_s is None else self._first_s
        if t_s - self._first_s > TIME_SPAN_MAX_S:
            problem = f"{t_s:.12g} s is too far from the first time, {self._first_s:.12g} s"
            raise self._cells.error(problem, column.name)
        self._t_s = t_s
        return t_s

    def _position_rad(self, cells: Sequence[str]) -> NDArray[np.float64]:
        position_rad = np.full(len(self._joints), math.nan)
        for index, place in enumerate(self.layout.joints.values()):
            angle = number_of(cells[place], decimal_comma=self._comma)
            is_angle = angle is not None and abs(angle) <= ANGLE_MAX_RAD
            if self._strict and not is_angle:
                problem = f"{shown(cells[place])} is not an angle in radians"
                raise self._cells.error(problem, self._name(place))
            if is_angle and self._cells.has_end:
                position_rad[index] = angle
        return position_rad

    def _name(self, place: int) -> str:
        return self._cells.names[place]


def read_rows(
    path: Path,
    fingers: Sequence[str],
    *,
    strict: bool = False,
    outcomes: bool = False,
    layout: Layout | None = None,
) -> Iterator[Row]:
    """Yield the rows of a file. `layout`: of this file; None: find it out.

    Raises `RecordingError`; with `strict` also for a value that is not a count or angle and for a
    last row without a line end, with `outcomes` for an unreadable outcome.
    """
    with open_recording(path) as file:
        layout = layout or survey(path, file, fingers)
        yield from Recording(path, file, layout, strict=strict, outcomes=outcomes)
