"""Table or stream: the rows of a file are grasps or sweeps, by its times or by the rows.

A sweep of a stream is never judged as a grasp, so doubt is refused.
"""

from __future__ import annotations

import statistics
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import chain, islice, pairwise
from operator import itemgetter
from pathlib import Path
from typing import BinaryIO, Final, Literal

import numpy as np
from numpy.typing import NDArray

from graspd.biotac import FINGERS
from graspd.drivers.base import ANGLE_MAX_RAD, RecordingError
from graspd.drivers.recordings.cells import Cells
from graspd.drivers.recordings.columns import ONE_ROW, Columns, TimeColumn
from graspd.drivers.recordings.kinds import open_recording
from graspd.drivers.recordings.values import (
    count_of,
    is_clock,
    is_outcome,
    number_of,
    problem_with,
    time_of,
)

ReadAs = Literal["table", "stream"]
BLOCK_ROWS: Final = 512
"""Rows that are compared with each other, and rows at the begin whose values are checked."""
CLIP_COUNTS: Final = 64.0
"""Most by which one electrode counts: a broken one may have any value."""
NEAR_COUNTS: Final = 8.0
"""Root of the mean square by which rows differ that nearly repeat each other, counts.

Sweeps of a hand at rest differ by 3 to 6. At most 5 % of the published grasps are as near to
another one, and 20 % of ten of one object; 33 to 61 % of the sweeps of streams at 4 to 100 Hz are.
"""
STEP_COUNTS: Final = 25.0
"""The same of rows that may be sweeps in a row: 74 to 97 % of streams, 13 to 44 % of tables."""
NEAR_SHARE_MAX: Final = 0.2
"""Largest share of rows up to `NEAR_COUNTS` from another in a grasp table."""
ALIKE_SHARE_MAX: Final = 0.85
"""Largest share of rows up to `STEP_COUNTS` from another, where near ones count twice: of sweeps
with broken electrodes, or of much noise, up to 100 % are, and not one of them is near."""
DOUBTED_SHARES: Final = 0.1, 0.6
"""The same shares where rows do not say that lifts ended both ways, as sweeps never do.

Pieces of 12 sweeps at 4 Hz have less in 2 %, and in 22 % less than the shares above; 12 published
grasps in a row have more in 20 %, and any 12 in under 1 %.
"""
FEW_ROWS: Final = 10
"""Fewest rows whose shares can refuse a table for good."""
MIDDLE_SHARE_MAX: Final = 0.1
"""Largest share of rows that are neither near nor far, in a table of several readings of each
grasp, which has up to 5 %; streams have 35 to 45 %."""
BETWEEN_SHARE_MAX: Final = 0.6
"""Largest share of them among those that are not near: streams have 63 to 95 %."""
JUMP_SHARE_MIN: Final = 0.02
"""Least share of rows that are far from the row before, in such a table: 50 readings."""
STEP_S: Final = (0.002, 0.5)
"""Shortest and longest usual time between sweeps, s. In each unit other numbers are usual."""
SLOWEST_S: Final = 1.0
"""Time between rows, s, from which on they may be grasps."""
BACK_SHARE_MAX: Final = 0.1
"""Largest share of rows of a stream that go back in time; it ends at the first of them."""
EPOCHS: Final = ((1e17, 1e-9), (1e14, 1e-6), (1e11, 1e-3))
"""Times since 1970 lie above these numbers if they are in these units, s."""


@dataclass(frozen=True, slots=True)
class Layout:
    """The columns of a file, and the meaning of its rows."""

    columns: Columns
    is_stream: bool
    unit_s: float = 1.0
    """Unit of the column of times, s."""
    rate_hz: float | None = None
    """Sweeps per second, in place of times."""

    has_outcomes: bool = False
    """True if the lifts' outcomes are known; of a table, of some of its first rows."""

    @property
    def joints(self) -> Mapping[str, int]:
        """Places of joints; a table has none."""
        return self.columns.joints if self.is_stream else {}


def layout_of(
    path: Path,
    fingers: Sequence[str],
    read_as: ReadAs | None = None,
    rate_hz: float | None = None,
) -> Layout:
    """Return the layout of a file; `fingers`: those to read, none for all that it has.

    `read_as` and `rate_hz` decide what is in doubt. Raises `RecordingError`.
    """
    with open_recording(path) as file:
        return survey(path, file, fingers, read_as, rate_hz)


def survey(
    path: Path,
    file: BinaryIO,
    fingers: Sequence[str],
    read_as: ReadAs | None = None,
    rate_hz: float | None = None,
) -> Layout:
    """Return the layout of an opened file, and rewind it: see `layout_of`."""
    cells = Cells(path, file)
    columns = Columns.of(path, cells.names, fingers, cells.header_line)
    rows = _Rows(path, columns, cells)
    rows.refuse_values()
    rows.refuse_fingers_by_row()
    if rows.is_timed(read_as, rate_hz):
        if rate_hz is not None and read_as is None and columns.time is not None:
            problem = "the rows have times: --rate-hz is for --as stream, which leaves them out"
            raise RecordingError(path, problem, column=columns.time.name)
        rows.refuse_degrees()
        if columns.time is None or rate_hz is not None:
            layout = Layout(columns, is_stream=True, rate_hz=rate_hz)
        else:
            layout = _timed(rows, columns.time, read_as)
    else:
        repeats = problem_of_sweeps(rows.blocks(), read_as, labelled=rows.are_labelled())
        if repeats is not None:
            raise RecordingError(path, repeats)
        rows.refuse_fingers_by_row()
        layout = Layout(columns, is_stream=False)
    file.seek(0)
    return replace(layout, has_outcomes=rows.has_outcomes(layout))


def _until_damage(rows: Iterator[list[str]]) -> Iterator[list[str]]:
    """Yield rows up to one that cannot be read; reading the file again raises its error."""
    try:
        yield from rows
    except RecordingError:
        return


class _Rows:
    """The first rows of a file, and what is known of them."""

    def __init__(self, path: Path, columns: Columns, cells: Cells) -> None:
        self.path = path
        self.columns = columns
        each = iter(cells)
        first = list(islice(each, 1))
        if not first:
            raise RecordingError(path, "the file has a header and no rows")
        self._others = _until_damage(each)
        self.first = [*first, *islice(self._others, BLOCK_ROWS - 1)]
        self._comma = cells.decimal_comma
        self._electrodes = itemgetter(*columns.electrodes)
        self._named = set[str]()
        """Fingers of rows, one more at most than there are."""
        self._note_fingers(self.first)

    def refuse_values(self) -> None:
        """Raise if the values of electrodes are something else than counts."""
        values = [value for cells in self.first for value in self._electrodes(cells)]
        problem = problem_with(values, decimal_comma=self._comma)
        if problem is not None:
            raise RecordingError(self.path, problem)

    def refuse_fingers_by_row(self) -> None:
        """Raise if the rows so far are of several fingers, and would be read as those of one."""
        if self.columns.finger is not None and 1 < len(self._named) <= len(FINGERS):
            one, other = sorted(self._named)[:2]
            problem = f"has rows of {one} and of {other}: {ONE_ROW}"
            raise RecordingError(self.path, problem, column=self.columns.finger[1])

    def refuse_degrees(self) -> None:
        """Raise if a joint has angles that no joint reaches, in radians, in a tenth of the rows."""
        for name, place in self.columns.joints.items():
            angles = [number_of(row[place], decimal_comma=self._comma) for row in self.first]
            large = [angle for angle in angles if angle is not None and abs(angle) > ANGLE_MAX_RAD]
            if 10 * len(large) > len(angles):
                problem = f"{name} = {large[0]:g} rad is beyond every joint: degrees? write radians"
                raise RecordingError(self.path, problem)

    def is_timed(self, read_as: ReadAs | None, rate_hz: float | None) -> bool:
        """Return True for rows with times. Raises if `read_as` says so, and they have none."""
        if read_as == "stream" and self.columns.time is None and rate_hz is None:
            raise RecordingError(self.path, "has no column of times: give --rate-hz too")
        return read_as == "stream" or (read_as is None and self.columns.time is not None)

    def has_outcomes(self, layout: Layout) -> bool:
        place = self.columns.slipped
        if place is None or layout.is_stream:  # which may begin with an open hand
            return place is not None
        return any(is_outcome(row[place]) for row in self.first)

    def are_labelled(self) -> bool:
        """Return True for rows that each have an object and an outcome, of both kinds."""
        name, slipped = self.columns.object, self.columns.slipped
        if name is None or slipped is None:
            return False
        return are_labelled((row[name], row[slipped]) for row in self.first)

    def times(self, column: TimeColumn) -> list[float]:
        """Return the times of the first rows in the unit of the column."""
        found = [time_value(column, row, decimal_comma=self._comma) for row in self.first]
        return [value for value in found if value is not None]

    def is_clock(self, column: TimeColumn) -> bool:
        return is_clock(self.first[0][column.places[0]])

    def blocks(self) -> Iterator[NDArray[np.float32]]:
        """Yield the counts of the whole file, shape (rows, electrodes); a missing one is NaN."""
        rows: Iterable[list[str]] = chain(self.first, self._others)
        while cells := list(islice(rows, BLOCK_ROWS)):
            self._note_fingers(cells)
            yield self._counts(cells)

    def follow_each_other(self) -> bool:
        """Return True if most of the first rows are a small step from the row before."""
        counts = _without_gaps(self._counts(self.first))
        steps = _apart(counts[1:], counts[:-1])
        return 2 * int((steps <= STEP_COUNTS).sum()) > len(steps)

    def _note_fingers(self, rows: Sequence[Sequence[str]]) -> None:
        if self.columns.finger is not None and len(self._named) <= len(FINGERS):
            place, _ = self.columns.finger
            self._named |= set(sorted({row[place] for row in rows})[: len(FINGERS) + 1])

    def _counts(self, rows: Sequence[Sequence[str]]) -> NDArray[np.float32]:
        return np.array(
            [
                [count_of(cell, decimal_comma=self._comma) for cell in self._electrodes(row)]
                for row in rows
            ],
            dtype=np.float32,
        )


def time_value(
    column: TimeColumn, cells: Sequence[str], *, decimal_comma: bool = False
) -> float | None:
    """Return the time of a row in the unit of the column; None if it has none."""
    value = time_of(cells[column.places[0]], decimal_comma=decimal_comma)
    if len(column.places) == 1 or value is None:
        return value
    rest_ns = number_of(cells[column.places[1]], decimal_comma=decimal_comma)
    return None if rest_ns is None else value + rest_ns * 1e-9


def _unit_s(rows: _Rows, column: TimeColumn, times: Sequence[float], step: float) -> float:
    """Return the unit of times, s: as it is called, as large times have, or as steps are usual."""
    if rows.is_clock(column):
        return 1.0
    if column.unit_s is not None:
        return column.unit_s
    usual = [unit for unit in (1.0, 1e-3, 1e-6, 1e-9) if STEP_S[0] <= step * unit <= STEP_S[1]]
    largest = max(map(abs, times), default=0.0)
    epoch = next((unit for least, unit in EPOCHS if largest > least), None)
    return epoch or (usual[0] if usual else 1.0)


def _timed(rows: _Rows, column: TimeColumn, read_as: ReadAs | None) -> Layout:
    """Return the layout of rows with times. Raises if these are of grasps, or none at all."""
    times = rows.times(column)
    step = _median_step(times)
    layout = Layout(rows.columns, is_stream=True, unit_s=_unit_s(rows, column, times, step))
    is_read = len(times) >= FEW_ROWS
    if is_read and step == 0.0:
        problem = (
            "most rows have the time of the row before: grasps of a table (--as table), or sweeps, "
            "of which there are how many a second (--as stream --rate-hz)?"
        )
        raise RecordingError(rows.path, problem, column=column.name)
    back = sum(after < before for before, after in pairwise(times))
    if read_as is None and is_read and back > BACK_SHARE_MAX * len(times):
        problem = (
            f"{back} of {len(times)} rows have a time before that of the row above: grasps of a "
            "table (--as table)? Sweeps of a stream are in the order of time"
        )
        raise RecordingError(rows.path, problem, column=column.name)
    if read_as is not None or len(times) < 2:
        return layout
    is_known = layout.unit_s == 1.0 or column.unit_s is not None or abs(times[0]) > EPOCHS[-1][0]
    step_s = step * layout.unit_s
    if step_s >= SLOWEST_S or not (is_known or rows.follow_each_other()):
        problem = (
            f"rows are {step:g} apart: grasps of a table (--as table), or sweeps of a stream "
            f"{step_s:g} s apart (--as stream)?"
        )
        raise RecordingError(rows.path, problem, column=column.name)
    return layout


def are_labelled(cells: Iterable[tuple[str, str]]) -> bool:
    """Return True for rows that each have an object and an outcome, of both kinds."""
    outcomes = set[str]()
    for name, outcome in cells:
        if not name.strip() or not is_outcome(outcome):
            return False
        outcomes.add(outcome)
    return len(outcomes) > 1


def problem_of_sweeps(
    blocks: Iterable[NDArray[np.floating]], read_as: ReadAs | None, *, labelled: bool
) -> str | None:
    """Return why rows are not grasps: many nearly repeat another, as sweeps do. None: they are.

    `blocks`: counts, shape (rows, electrodes), NaN where one is missing. With
    `read_as="table"` rows may be several readings of each grasp. `labelled`: True for lifts that
    ended both ways.
    """
    nearest, jumps = [], 0
    last: NDArray[np.floating] | None = None
    for block in map(_without_gaps, blocks):
        nearest.append(_nearest(block))
        before = block[:1] if last is None else last
        rows = np.concatenate((before, block))
        jumps += int((_apart(rows[1:], rows[:-1]) > STEP_COUNTS).sum())
        last = block[-1:]
    apart = np.concatenate(nearest)
    number, near = len(apart), int((apart <= NEAR_COUNTS).sum())
    far = int((apart > STEP_COUNTS).sum())
    between = number - near - far
    is_known = labelled or read_as is not None
    near_max, alike_max = (NEAR_SHARE_MAX, ALIKE_SHARE_MAX) if is_known else DOUBTED_SHARES
    if near > near_max * number:
        problem = f"{near} of {number} rows nearly repeat another"
    elif 2 * near + between > alike_max * number:
        problem = f"most of {number} rows are much like another"
    else:
        return None
    if read_as is None:
        return (
            f"{problem}: sweeps of a stream (--as stream, and --rate-hz if it has no times), or "
            "several readings of each grasp (--as table)?"
        )
    middle = max(MIDDLE_SHARE_MAX * number, BETWEEN_SHARE_MAX * (between + far))
    if number >= FEW_ROWS and (between > middle or jumps < JUMP_SHARE_MIN * number):
        return f"{problem}: they change as sweeps of a stream do, and are not grasps of a table"
    return None


def _apart(one: NDArray[np.floating], other: NDArray[np.floating]) -> NDArray[np.floating]:
    """Return by how much rows differ, counts; shape (rows,)."""
    clipped = np.minimum(np.abs(one - other), CLIP_COUNTS)
    apart: NDArray[np.floating] = np.sqrt(np.square(clipped).mean(axis=1))
    return apart


def _nearest(block: NDArray[np.floating]) -> NDArray[np.floating]:
    """Return by how much each row differs from the row most like it, counts; shape (rows,)."""
    nearest = np.full(len(block), np.inf)
    for place in range(len(block) - 1):
        apart = _apart(block[place + 1 :], block[place])
        np.minimum(nearest[place + 1 :], apart, out=nearest[place + 1 :])
        nearest[place] = min(nearest[place], apart.min())
    return nearest


def _without_gaps(counts: NDArray[np.floating]) -> NDArray[np.floating]:
    """Return counts with the median of its electrode in place of a missing one."""
    missing = np.isnan(counts)
    if not missing.any():
        return counts
    usual = np.nanmedian(np.where(missing.all(axis=0), 0.0, counts), axis=0)
    filled: NDArray[np.floating] = np.where(missing, usual, counts)
    return filled


def _median_step(times: Sequence[float]) -> float:
    steps = [abs(after - before) for before, after in pairwise(times)]
    return statistics.median(steps) if steps else 0.0
