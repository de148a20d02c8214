"""The replay: tables and streams played as a driver like any other, in real time or fast."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Generator, Sequence
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from drivers.base import (
    ElectrodeFault,
    JointReading,
    Reading,
    TactileReading,
    check_fingers,
)
from drivers.recordings.csv_rows import Recording, Row, open_recording, read_lines
from drivers.recordings.faults import FaultInjector, ReplayCounters, ReplayFaults
from drivers.recordings.player import RecordedDriver, Timeline

DEMO_TABLE = Path(__file__).parent / "demo" / "synthetic_grasps.csv"
"""Synthetic grasps, drawn by `drivers.twins.grasps.synthetic`: nobody ever grasped these."""
DEMO_DAY = Path(__file__).parent / "demo" / "synthetic_day.csv"
"""Synthetic grasps of sensors that drift, drawn by the same."""
DEMO_RECORDING = Path(__file__).parent / "demo" / "synthetic_stream.csv"
"""Whole synthetic grasps, made by `drivers.twins.grasps.whole_grasps`."""
RATE_MIN_HZ, RATE_MAX_HZ = 1e-3, 1e5
SPEED_MIN, SPEED_MAX = 1e-3, 1e3
"""Beyond these a schedule makes no sense; `Pace.FAST` has no schedule at all."""
IGNORED_COLUMNS_LOGGED = 10
"""Names of ignored columns in the log line; the rest only as a number."""

_NS_PER_S = 1_000_000_000
_log = logging.getLogger(__name__)


class Pace(StrEnum):
    """When the next reading is due."""

    REALTIME = "realtime"
    """As recorded (tables: at `rate_hz`), times `speed`."""
    FAST = "fast"
    """At once."""


@dataclass(frozen=True, slots=True, eq=False)
class _Scheduled:
    """A row and its place in time."""

    row: Row
    joint_names: tuple[str, ...]
    period_ns: int | None
    """Nominal time to the next row, as played; None before it is known."""


class ReplayDriver(RecordedDriver[_Scheduled]):
    """Plays CSV recordings, one row per call of `read_ready` at most.

    `fingers` picks the fingers and their order. A row gives a `TactileReading`, in a stream with
    joints a `JointReading` before it. In real time `t_ns` is when the row was due, so that a late
    reading is an old one; else it is the time of handing over. `recorded_ns` is the file's own
    time. The run starts with the first call of `read_ready`; several files play in a row, with
    `loop` without end. A late reading is counted, never skipped.

    The constructor raises `ValueError` for an argument out of range. `open` raises
    `RecordingError` if any of the files or headers is not right, `read_ready` if a row is not;
    values that are not counts, and a last row without a line end, make readings faulty, or with
    `strict` raise as well. See `drivers.recordings.csv_rows.Recording`.
    """

    def __init__(
        self,
        paths: Sequence[Path],
        fingers: Sequence[str] = ("ff", "mf", "th"),
        *,
        pace: Pace = Pace.REALTIME,
        speed: float = 1.0,
        rate_hz: float = 100.0,
        loop: bool = False,
        strict: bool = False,
        faults: ReplayFaults = ReplayFaults(),  # noqa: B008 (immutable)
        clock: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        check_fingers(fingers)
        if not RATE_MIN_HZ <= rate_hz <= RATE_MAX_HZ:
            raise ValueError(f"rate_hz is {rate_hz}, must be in {RATE_MIN_HZ}..{RATE_MAX_HZ}")
        if not SPEED_MIN <= speed <= SPEED_MAX:
            raise ValueError(f"speed is {speed}, must be in {SPEED_MIN}..{SPEED_MAX}")
        self._delay_ns = round(faults.delayed_s * _NS_PER_S)
        # Rows are scheduled as played, so that rounding does not add up.
        played = None if pace is Pace.FAST else 1.0
        super().__init__(paths, Timeline(played, clock, delay_ns=self._delay_ns))
        self._clock = clock
        self._fingers = tuple(fingers)
        self._speed = speed
        self._ns_per_recorded_s = _NS_PER_S / speed
        self._table_period_ns = _NS_PER_S / (rate_hz * speed)
        self._loop = loop
        self._strict = strict
        self._faults = faults
        self.ignored_columns: tuple[str, ...] = ()
        """Columns of the files that are not known, each once. Set by `open`."""
        self._reset()

    def _reset(self) -> None:
        self.counters = ReplayCounters()
        self.period_ns: int | None = None
        """Nominal time, ns, between readings as played, before any fault.

        Tables: from `rate_hz` and `speed`. Streams: the shortest step so far; None before it is
        known.
        """
        self._injector = FaultInjector(self._faults, self._fingers, self.counters)
        self._row_index = 0
        self._seq = 0

    def open(self) -> None:
        """Check the header of every file, then start over with the first one."""
        self.close()
        self._reset()
        self._check()
        self.timeline.start(self._schedules())

    def _check(self) -> None:
        ignored: dict[str, None] = {}
        for path in self.paths:
            with open_recording(path) as stream:
                ignored.update(dict.fromkeys(self._recording(path, stream).columns.ignored))
        self.ignored_columns = tuple(ignored)
        if ignored:
            few = ", ".join(map(repr, self.ignored_columns[:IGNORED_COLUMNS_LOGGED]))
            _log.info("replay: unknown columns ignored: %d, such as %s", len(ignored), few)

    def read_ready(self) -> Sequence[Reading]:
        """The readings of one row if it is due, else none. Raises `RecordingError` for bad rows."""
        taken = self.timeline.take()
        if taken is None:
            return ()
        at_ns, scheduled, late_ns = taken
        if self.timeline.speed is not None and scheduled.period_ns is not None:
            self.counters.late += late_ns > scheduled.period_ns
        self.period_ns = scheduled.period_ns
        return self._readings(at_ns, scheduled)

    def _schedules(self) -> Generator[tuple[int, _Scheduled], None, None]:
        """All rows of all files on one time axis."""
        start_ns = 0
        while True:
            for path in self.paths:
                with open_recording(path) as stream:
                    start_ns = yield from self._schedule(self._recording(path, stream), start_ns)
            if not self._loop:
                return

    def _schedule(
        self, recording: Recording, start_ns: int
    ) -> Generator[tuple[int, _Scheduled], None, int]:
        """The rows of one file; returns when the file after it starts."""
        names = recording.columns.joint_names
        table_ns = self._table_period_ns
        period_ns = round(table_ns) if recording.columns.time is None else None
        at_ns, first_s = start_ns, None
        for index, row in enumerate(recording):
            if row.t_s is None:
                at_ns = start_ns + round(index * table_ns)
            elif first_s is None:
                first_s = row.t_s
            else:
                before_ns = at_ns
                at_ns = start_ns + round((row.t_s - first_s) * self._ns_per_recorded_s)
                if at_ns > before_ns:  # the shortest step, so that a gap is seen as a gap
                    period_ns = min(at_ns - before_ns, period_ns or at_ns)
            yield at_ns, _Scheduled(row, names, period_ns)
        return at_ns + (period_ns or round(table_ns))

    def _recording(self, path: Path, stream: BinaryIO) -> Recording:
        return Recording(path, read_lines(path, stream), self._fingers, strict=self._strict)

    def _readings(self, at_ns: int, scheduled: _Scheduled) -> Sequence[Reading]:
        row, index = scheduled.row, self._row_index
        self._row_index += 1
        seq = self._seq_after_faults(row, index)
        t_ns = self._clock() - self._delay_ns
        if self.timeline.speed is not None:
            t_ns = self.timeline.played_ns(at_ns)
        made_ns = round(at_ns * self._speed)
        readings: list[Reading] = []
        if row.position_rad is not None:
            names, angles = scheduled.joint_names, row.position_rad
            readings.append(JointReading(t_ns, index, names, angles, made_ns))
            self.counters.bad_angles += int(np.isnan(row.position_rad).sum())
        if seq is not None:
            counts, faults, note = row.counts, row.faults, row.annotation
            readings.append(TactileReading(t_ns, seq, counts, faults, note, made_ns))
            self._count(row.faults)
        return readings

    def _seq_after_faults(self, row: Row, index: int) -> int | None:
        """Put the faults into the row; its sequence number, or None if a fault keeps it back."""
        self._injector.observe(index, row.counts, row.faults)
        if not self._injector.makes(index):
            return None
        seq = self._seq
        self._seq += 1
        if self._injector.loses():
            return None
        self._injector.spoil(row.counts, row.faults)
        return seq

    def _count(self, faults: NDArray[np.uint8]) -> None:
        self.counters.readings += 1
        self.counters.injected_delayed += self._delay_ns > 0
        if faults.any():
            self.counters.faulty_readings += 1
            not_counts = faults & np.uint8(ElectrodeFault.NOT_A_COUNT) != 0
            self.counters.not_counts += int(not_counts.sum())
            self.counters.cut_off += bool((faults & np.uint8(ElectrodeFault.CUT_OFF)).any())
