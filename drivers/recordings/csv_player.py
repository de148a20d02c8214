"""Driver that plays tables and streams, in real time or fast."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from graspd.drivers.base import (
    DriverCounters,
    ElectrodeFault,
    JointReading,
    Reading,
    TactileReading,
)
from graspd.drivers.recordings.csv_rows import Row, read_rows
from graspd.drivers.recordings.layout import Layout, ReadAs, layout_of
from graspd.drivers.recordings.player import ReadingsDriver, within_limits

DEMO_TABLE = Path(__file__).parent / "demo" / "synthetic_grasps.csv"
"""Table of synthetic grasps. `python -m tests.kit.demos` makes all four demos again."""
DEMO_DAY = Path(__file__).parent / "demo" / "synthetic_day.csv"
"""Table of synthetic grasps of sensors that drift."""
DEMO_RECORDING = Path(__file__).parent / "demo" / "synthetic_stream.csv"
"""Stream of whole synthetic grasps."""
SHOW_RECORDING = Path(__file__).parent / "demo" / "synthetic_show.csv"
"""Stream of synthetic grasps that are each held for two seconds, for people to watch."""
TABLE_RATE_HZ = 100.0
"""Grasps of a table per second, as played."""
UNITS = {1e-3: "ms", 1e-6: "us", 1e-9: "ns"}
"""Names of units of time, by their length in s."""
IGNORED_COLUMNS_LOGGED = 10
"""Most names of ignored columns in a log line."""

_NS_PER_S = 1_000_000_000
_log = logging.getLogger(__name__)


@dataclass(slots=True)
class ReplayCounters(DriverCounters):
    """Counters of a replay."""

    not_counts: int = 0
    """Electrode values handed over that are not 12-bit counts."""
    cut_off: int = 0
    """Readings handed over whose row has no line end."""
    bad_angles: int = 0


class ReplayDriver(ReadingsDriver[tuple[Row, bool]]):
    """Play one or more tables and streams, at most one row per call of `read_ready`.

    A row gives a `TactileReading` of `fingers`, after a `JointReading` if the file has joints.
    `recorded_ns` counts from the first row of the first file. No reading is skipped.

    `open` and `read_ready` raise `RecordingError` for a wrong file, header or row. Values that are
    not counts, and a last row without a line end, make a reading faulty; with `strict` they raise.
    With `outcomes` an unreadable outcome raises; else it is not known, which is logged if all are.
    """

    counters: ReplayCounters

    def __init__(
        self,
        paths: Sequence[Path],
        fingers: Sequence[str] = ("ff", "mf", "th"),
        *,
        layouts: Mapping[Path, Layout] | None = None,
        speed: float | None = 1.0,
        rate_hz: float | None = None,
        read_as: ReadAs | None = None,
        loop: bool = False,
        strict: bool = False,
        outcomes: bool = False,
        clock: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        """`layouts`: layout of each file, if known. `speed`: factor of real time; None: as fast as
        possible. `rate_hz`: rows per second of a file without times; None: 100 for a table.
        `read_as`: what the rows are; None: find out. `loop`: start again after the last file."""
        super().__init__(paths, fingers, speed=speed, clock=clock)
        self._table_period_ns = _NS_PER_S / (rate_hz or TABLE_RATE_HZ)
        self._find = partial(layout_of, fingers=self._fingers, read_as=read_as, rate_hz=rate_hz)
        self._layouts = dict(layouts or {})
        self._loop = loop
        self._refuses = {"strict": strict, "outcomes": outcomes}

    def reset(self) -> None:
        super().reset()
        self.counters = ReplayCounters()

    def open(self) -> None:
        """Check the header of each file, then start from the first file."""
        self.close()
        self.reset()
        ignored: dict[str, None] = {}
        for path in self.paths:
            layout = self._layouts.get(path) or self._find(path)
            self._layouts[path] = layout
            ignored.update(dict.fromkeys(layout.columns.ignored))
            if layout.unit_s != 1.0 and layout.columns.time is not None:
                name, unit = layout.columns.time.name, UNITS[layout.unit_s]
                _log.info("replay: %s: the times of column %s are in %s", path, name, unit)
            if layout.is_stream and layout.columns.unclear:
                names = ", ".join(map(repr, layout.columns.unclear[:IGNORED_COLUMNS_LOGGED]))
                problem = "%s: %s may be a joint's angle, and is not read: name it FFJ3, in radians"
                _log.warning(problem, path, names)
            if layout.unread_outcome and not self._refuses["outcomes"]:
                _log.warning("no outcome is known: %s", layout.unread_outcome)
        if ignored:
            names = ", ".join(map(repr, list(ignored)[:IGNORED_COLUMNS_LOGGED]))
            _log.info("replay: unknown columns ignored: %d, such as %s", len(ignored), names)
        self.start(self._items())

    def read_ready(self) -> Sequence[Reading]:
        """Return the readings of one row if it is due. Raises `RecordingError` for a bad row."""
        taken = self.take()
        if taken is None:
            return ()
        at_ns, (row, interrupted) = taken
        self.follow(at_ns)
        made = self._readings(row, at_ns, interrupted)
        return [self.hand_over(reading, at_ns) for reading in made]

    def _items(self) -> Generator[tuple[int, tuple[Row, bool]], None, None]:
        """Yield time, ns, on one axis for all files, row, and True if a new stream begins there."""
        start_ns = 0
        while True:
            for path in self.paths:
                start_ns = yield from self._items_of(path, start_ns)
            if not self._loop:
                return

    def _items_of(
        self, path: Path, start_ns: int
    ) -> Generator[tuple[int, tuple[Row, bool]], None, int]:
        """Yield the rows of one file as `_items` does; return the start of the next file, ns."""
        at_ns, first_s, period_ns = start_ns, None, 0
        rows = read_rows(path, self._fingers, layout=self._layouts[path], **self._refuses)
        for index, row in enumerate(rows):
            before_ns = at_ns
            if row.t_s is None:
                at_ns = start_ns + round(index * self._table_period_ns)
            else:
                first_s = row.t_s if first_s is None else first_s
                # A float of seconds since 1970 is not finer than a microsecond.
                at_ns = start_ns + 1000 * round((row.t_s - first_s) * 1e6)
            if at_ns > before_ns:
                period_ns = min(at_ns - before_ns, period_ns or at_ns)
            is_new = index == 0 < start_ns and row.t_s is not None
            yield within_limits(path, at_ns, row.annotation.line), (row, is_new)
        return at_ns + (period_ns or round(self._table_period_ns))

    def _readings(self, row: Row, at_ns: int, interrupted: bool) -> Iterator[Reading]:
        """Yield the readings of a row, joints (if it has any) before counts, and count them."""
        index, faults = self.counters.readings, row.faults
        if row.joint_names:
            yield JointReading(at_ns, index, row.joint_names, row.position_rad)
            self.counters.bad_angles += int(np.isnan(row.position_rad).sum())
        yield TactileReading(
            at_ns, index, row.counts, faults, row.annotation, interrupted=interrupted
        )
        self.counters.readings += 1
        if faults.any():
            self.counters.faulty_readings += 1
            self.counters.not_counts += int((faults & ElectrodeFault.NOT_A_COUNT != 0).sum())
            self.counters.cut_off += bool((faults & ElectrodeFault.CUT_OFF).any())
