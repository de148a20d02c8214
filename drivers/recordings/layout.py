"""Decide whether a file is a table of grasps or a stream of sweeps, by times or by its rows. A
sweep of a stream is never judged as a grasp, so a doubtful file is refused."""

from __future__ import annotations

import statistics
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import chain, islice, pairwise
from operator import itemgetter
from pathlib import Path
from typing import BinaryIO, Final, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from graspd.biotac import FINGERS
from graspd.drivers.base import ANGLE_MAX_RAD, RecordingError
from graspd.drivers.recordings.cells import Cells
from graspd.drivers.recordings.columns import SLIPPED, Columns, TimeColumn, problem_of_fingers
from graspd.drivers.recordings.kinds import open_recording
from graspd.drivers.recordings.values import (
    are_texts,
    count_of,
    is_clock,
    is_outcome,
    number_of,
    outcome_of,
    problem_with,
)

ReadAs = Literal["table", "stream"]
BLOCK_ROWS: Final = 512
"""Number of rows that are compared with each other, and of first rows that are checked."""
CLIP_COUNTS: Final = 64.0
"""Limit of one electrode's difference, counts: larger ones count as this, as of a broken one."""
NEAR_COUNTS: Final = 8.0
"""Largest root mean square difference, counts, of rows that nearly repeat each other.

Sweeps of a hand at rest differ by 3 to 6. At most 5 % of the published grasps are that near to
another one, and 20 % among ten of one object. In streams at 4 to 100 Hz 33 to 61 % are.
"""
STEP_COUNTS: Final = 25.0
"""Largest difference of rows that may be successive sweeps, counts. In streams 74 to 97 % of rows
are that near to another, in tables 13 to 44 %."""
NEAR_SHARE_MAX: Final = 0.2
"""Largest share of rows up to `NEAR_COUNTS` from another in a grasp table."""
ALIKE_SHARE_MAX: Final = 0.85
"""Largest share, in a grasp table, of rows up to `STEP_COUNTS` from another; rows within
`NEAR_COUNTS` count twice. In noisy streams up to 100 % are within `STEP_COUNTS`, none nearer."""
DOUBTED_SHARES: Final = 0.1, 0.6
"""`NEAR_SHARE_MAX` and `ALIKE_SHARE_MAX` for rows with neither both outcomes nor `read_as`.

Among pieces of 12 sweeps at 4 Hz, 2 % are below these limits, and 22 % below the usual two. Among
pieces of 12 published grasps in a row, 20 % are above these, and among random ones under 1 %.
"""
FEW_ROWS: Final = 10
"""Fewest rows by which a file is refused in spite of `read_as`, or for times that fall."""
MIDDLE_SHARE_MAX: Final = 0.1
"""Largest share of rows `NEAR_COUNTS` to `STEP_COUNTS` from the nearest, in a table with several
readings of each grasp. Such tables have up to 5 %, streams 35 to 45 %."""
BETWEEN_SHARE_MAX: Final = 0.6
"""Largest share of the rows of `MIDDLE_SHARE_MAX` among all beyond `NEAR_COUNTS` from the nearest;
streams have 63 to 95 %."""
JUMP_SHARE_MIN: Final = 0.02
"""Smallest share of rows beyond `STEP_COUNTS` from the row before, in a table with several readings
of each grasp: one new grasp in 50 readings."""
STEP_S: Final = (0.002, 0.5)
"""Shortest and longest usual time between sweeps, s, by which the unit of times is found."""
SLOWEST_S: Final = 1.0
"""Time between rows, s, from which on they may be grasps."""
BACK_SHARE_MAX: Final = 0.1
"""Largest share of rows of a stream that go back in time; reading fails at the first of them."""
EPOCHS: Final = ((1e17, 1e-9), (1e14, 1e-6), (1e11, 1e-3))
"""Smallest number of a time since 1970 in each unit, and that unit, s."""


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
    """True for a table with outcomes; for a stream, if it has their column, even if still blank."""
    unread_outcome: str = ""
    """Why the first outcome cannot be read, if none seen can; empty: one can, or there are none."""

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

    `read_as`: what the rows are; None: find out. `rate_hz`: sweeps per second of a stream, in place
    of times. Raises `RecordingError`, also in doubt.
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
    """Return the layout of an opened file as `layout_of` does, and rewind the file."""
    if read_as not in (None, *get_args(ReadAs)):
        raise RecordingError(path, f"is read as 'table' or 'stream', not as {read_as!r}")
    cells = Cells(path, file)
    columns = Columns.of(path, cells.names, fingers, cells.header_line)
    rows = _Rows(path, columns, cells)
    rows.refuse_values()
    rows.refuse_outcomes()
    rows.refuse_fingers_by_row()
    if rows.is_timed(read_as, rate_hz):
        if rate_hz is not None and read_as is None and columns.time is not None:
            problem = "the rows have times: --rate-hz is for --as stream, which leaves them out"
            raise RecordingError(path, problem, column=columns.time.name)
        rows.refuse_degrees()
        rows.refuse_fingers_below()
        if columns.time is None or rate_hz is not None:
            layout = Layout(columns, is_stream=True, rate_hz=rate_hz)
        else:
            layout = _timed(rows, columns.time, read_as)
    else:
        repeats = problem_of_sweeps(rows.blocks(), read_as, labelled=rows.are_labelled())
        if repeats is not None:
            raise RecordingError(path, repeats)
        rows.refuse_fingers_below()
        rows.refuse_outcomes()
        layout = Layout(columns, is_stream=False)
    file.seek(0)
    has_outcomes = rows.have_outcomes or (layout.is_stream and columns.slipped is not None)
    unread = "" if rows.have_outcomes or rows.unread is None else str(rows.unread)
    return replace(layout, has_outcomes=has_outcomes, unread_outcome=unread)


def _until_damage(rows: Iterator[list[str]]) -> Iterator[list[str]]:
    """Yield rows up to one that cannot be read; reading the file again raises its error."""
    try:
        yield from rows
    except RecordingError:
        return


class _Rows:
    """The first rows of a file, and what is known of them."""

    def __init__(self, path: Path, columns: Columns, cells: Cells) -> None:
        self.path, self.columns = path, columns
        self._comma = cells.decimal_comma
        self._electrodes = itemgetter(*columns.electrodes)
        self.have_outcomes = False
        self.unread: RecordingError | None = None
        """Problem of the first outcome so far that cannot be read; `have_outcomes`: one can."""
        each = self._each(cells)
        first = list(islice(each, 1))
        if not first:
            raise RecordingError(path, "the file has a header and no rows")
        self._others = _until_damage(each)
        self.first = [*first, *islice(self._others, BLOCK_ROWS - 1)]
        self._named = set[str]()
        """Words in the column `finger`; at most one more than hands have fingers."""
        self._note_fingers(self.first)

    def refuse_values(self) -> None:
        """Raise `RecordingError` if the values of electrodes are not counts, such as volts."""
        values = [value for cells in self.first for value in self._electrodes(cells)]
        if problem := problem_with(values, decimal_comma=self._comma):
            raise RecordingError(self.path, problem)

    def refuse_outcomes(self) -> None:
        """Raise if some outcomes so far can be read and others not: one side may be missing."""
        if self.have_outcomes and self.unread is not None:
            raise self.unread

    def refuse_fingers_by_row(self) -> None:
        """Raise if the rows so far are of several fingers, and would be read as those of one."""
        problem = problem_of_fingers(self._named) if len(self._named) <= len(FINGERS) else None
        if self.columns.finger is not None and problem is not None:
            raise RecordingError(self.path, problem, column=self.columns.finger[1])

    def refuse_fingers_below(self) -> None:
        """Read on to the end, if a column may name fingers, and raise if there are several."""
        if self.columns.finger is not None:
            while cells := list(islice(self._others, BLOCK_ROWS)):
                self._note_fingers(cells)
            self.refuse_fingers_by_row()

    def refuse_degrees(self) -> None:
        """Raise if a joint's name says degrees, or over a tenth of its angles are beyond reach."""
        if names := self.columns.degrees:
            raise RecordingError(self.path, "angles are in degrees: write radians", column=names[0])
        for name, place in self.columns.joints.items():
            angles = [number_of(row[place], decimal_comma=self._comma) for row in self.first]
            large = [angle for angle in angles if angle is not None and abs(angle) > ANGLE_MAX_RAD]
            if 10 * len(large) > len(angles):
                problem = f"{name} = {large[0]:g} rad is beyond every joint: degrees? write radians"
                raise RecordingError(self.path, problem)

    def is_timed(self, read_as: ReadAs | None, rate_hz: float | None) -> bool:
        """Return True for a stream, by `read_as` or times; raise for one without times or rate."""
        if read_as == "stream" and self.columns.time is None and rate_hz is None:
            raise RecordingError(self.path, "has no column of times: give --rate-hz too")
        return read_as == "stream" or (read_as is None and self.columns.time is not None)

    def are_labelled(self) -> bool:
        """Return True if each first row has an object and an outcome, and both outcomes occur."""
        name, slipped = self.columns.object, self.columns.slipped
        if name is None or slipped is None:
            return False
        return are_labelled((row[name], row[slipped]) for row in self.first)

    def times(self, column: TimeColumn) -> list[float]:
        """Return the times of the first rows in the unit of the column."""
        found = [column.value(row, decimal_comma=self._comma) for row in self.first]
        return [value for value in found if value is not None]

    def blocks(self) -> Iterator[NDArray[np.float32]]:
        """Yield the counts of the whole file in blocks, shape (rows, electrodes); NaN: missing."""
        rows: Iterable[list[str]] = chain(self.first, self._others)
        while cells := list(islice(rows, BLOCK_ROWS)):
            self._note_fingers(cells)
            yield self._counts(cells)

    def follow_each_other(self) -> bool:
        """Return True if most of the first rows are up to `STEP_COUNTS` from the row before."""
        counts = _without_gaps(self._counts(self.first))
        steps = _apart(counts[1:], counts[:-1])
        return 2 * int((steps <= STEP_COUNTS).sum()) > len(steps)

    def _each(self, cells: Cells) -> Iterator[list[str]]:
        """Yield the rows, and note their outcomes."""
        place = self.columns.slipped
        for row in cells:
            if place is not None and (not self.have_outcomes or self.unread is None):
                try:
                    self.have_outcomes |= outcome_of(row[place]) is not None
                except ValueError as error:
                    if self.unread is None and not are_texts(self._electrodes(row)):
                        self.unread = cells.error(str(error), SLIPPED)
            yield row

    def _note_fingers(self, rows: Sequence[Sequence[str]]) -> None:
        if self.columns.finger is not None and len(self._named) <= len(FINGERS):
            place, _ = self.columns.finger
            named = {row[place].strip().lower() for row in rows} - {""}
            if self.columns.names_finger:  # other words may be of something else
                named &= set(FINGERS)
            self._named |= set(sorted(named)[: len(FINGERS) + 1])

    def _counts(self, rows: Sequence[Sequence[str]]) -> NDArray[np.float32]:
        return np.array(
            [
                [count_of(cell, decimal_comma=self._comma) for cell in self._electrodes(row)]
                for row in rows
            ],
            dtype=np.float32,
        )


def _unit_s(rows: _Rows, column: TimeColumn, times: Sequence[float], step: float) -> float:
    """Return the unit of times, s, by the column's name, their size, or their median `step`."""
    if is_clock(rows.first[0][column.places[0]]):
        return 1.0
    if column.unit_s is not None:
        return column.unit_s
    usual = [unit for unit in (1.0, 1e-3, 1e-6, 1e-9) if STEP_S[0] <= step * unit <= STEP_S[1]]
    usual_size = abs(statistics.median(times)) if times else 0.0  # one may be a missing value
    epoch = next((unit for least, unit in EPOCHS if usual_size > least), None)
    return epoch or (usual[0] if usual else 1.0)


def _timed(rows: _Rows, column: TimeColumn, read_as: ReadAs | None) -> Layout:
    """Return the layout of rows with times. Raises if they may be grasps."""
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
    """Return True if each pair is an object and an outcome, and both outcomes occur."""
    outcomes = set[bool | None]()
    for name, outcome in cells:
        if not name.strip() or not is_outcome(outcome):
            return False
        outcomes.add(outcome_of(outcome))
    return len(outcomes) > 1


def problem_of_sweeps(
    blocks: Iterable[NDArray[np.floating]], read_as: ReadAs | None, *, labelled: bool
) -> str | None:
    """Return why rows seem to be sweeps: many nearly repeat another row. None: they are grasps.

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
    is_known = labelled or read_as == "table"
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
    """Return the root mean square difference of pairs of rows, counts, shape (rows,)."""
    clipped = np.minimum(np.abs(one - other), CLIP_COUNTS)
    apart: NDArray[np.floating] = np.sqrt(np.square(clipped).mean(axis=1))
    return apart


def _nearest(block: NDArray[np.floating]) -> NDArray[np.floating]:
    """Return each row's difference from the row most like it, counts, shape (rows,)."""
    nearest = np.full(len(block), np.inf)
    for place in range(len(block) - 1):
        apart = _apart(block[place + 1 :], block[place])
        np.minimum(nearest[place + 1 :], apart, out=nearest[place + 1 :])
        nearest[place] = min(nearest[place], apart.min())
    return nearest


def _without_gaps(counts: NDArray[np.floating]) -> NDArray[np.floating]:
    """Return counts in which an electrode's median replaces its missing values."""
    missing = np.isnan(counts)
    if not missing.any():
        return counts
    usual = np.nanmedian(np.where(missing.all(axis=0), 0.0, counts), axis=0)
    filled: NDArray[np.floating] = np.where(missing, usual, counts)
    return filled


def _median_step(times: Sequence[float]) -> float:
    steps = [abs(after - before) for before, after in pairwise(times)]
    return statistics.median(steps) if steps else 0.0
