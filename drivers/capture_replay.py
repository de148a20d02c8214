"""What came over a link, decoded again: candump text and framed serial bytes as a driver.

The bytes go through the very decoders that live ones go through, at the times at which they came.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, Protocol, Self

from drivers.base import DriverCounters, Reading, RecordingError, TactileReading
from drivers.recording import open_recording

CANDUMP, SERIAL = ".log", ".serial"
"""Endings of the two kinds of files."""


class Decoding(Protocol):
    """Turns what came at one time into readings."""

    @property
    def counters(self) -> DriverCounters:
        """What came, and every kind of damage."""

    @property
    def period_ns(self) -> int | None:
        """Time between readings, ns, as recorded; None until it is known."""

    def begin(self) -> None:
        """Forget all that came."""

    def feed(self, t_ns: int, record: object) -> Sequence[Reading]:
        """The readings that a record of `t_ns` completes."""


Records = Callable[[Path], Iterator[tuple[int, object]]]
"""Times, ns, and records of a file. Raises `RecordingError`."""


class CaptureReplayDriver:
    """Plays captures in a row, as one run. `recorded_ns` of a reading is its time on their clock.

    Without `speed` as fast as possible. `open` raises `RecordingError`.
    """

    name = "replay"

    def __init__(
        self,
        paths: Sequence[Path],
        records: Records,
        decoding: Decoding,
        *,
        speed: float | None = None,
        clock: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        """Nothing is opened yet. Raises `ValueError` without files or with a speed that is none."""
        if not paths or (speed is not None and not speed > 0.0):
            raise ValueError("captures and a positive speed are needed")
        self._paths = tuple(paths)
        self._records = records
        self._decoding = decoding
        self._speed = speed
        self._clock = clock
        self.handed_over_ns = self._opened_ns = clock()
        """When the last reading was handed over, monotonic ns."""
        self._timeline: Iterator[tuple[int, object]] | None = None
        self._next: tuple[int, object] | None = None
        self._began: tuple[int, int] | None = None
        self.exhausted = False

    @property
    def counters(self) -> DriverCounters:
        """Those of the decoder."""
        return self._decoding.counters

    @property
    def period_ns(self) -> int | None:
        """Time between readings, ns, as played."""
        recorded_ns = self._decoding.period_ns
        return None if recorded_ns is None else round(recorded_ns / (self._speed or 1.0))

    @property
    def serials(self) -> dict[str, str]:
        """A recording is of no sensor that is there."""
        return {}

    def describe(self) -> dict[str, str]:
        """Which captures are played."""
        return {"recordings": ", ".join(map(str, self._paths))}

    def open(self) -> None:
        """Start over with the first file."""
        self.close()
        for path in self._paths:
            open_recording(path).close()
        self._decoding.begin()
        self._began = None
        self._timeline = (record for path in self._paths for record in self._records(path))
        self._take_next()
        if self._next is None:
            raise RecordingError(self._paths[0], "has nothing that came over a link")

    def close(self) -> None:
        """Close the file that plays."""
        timeline: Any = self._timeline
        self._timeline = None
        if timeline is not None:
            timeline.close()

    def __enter__(self) -> Self:
        self.open()
        return self

    def __exit__(self, *_details: object) -> None:
        self.close()

    def fileno(self) -> int | None:
        """None: a file is always readable, the clock says when."""
        return None

    def due_ns(self) -> int | None:
        """When the next record is due; a time in the past for at once."""
        if self._timeline is None or self.exhausted:
            return None
        if self._speed is None or self._next is None or self._began is None:
            return self._opened_ns
        began_ns, recorded_ns = self._began
        return began_ns + round((self._next[0] - recorded_ns) / self._speed)

    def read_ready(self) -> Sequence[Reading]:
        """The readings that the records up to the first complete one give, as far as due."""
        readings: Sequence[Reading] = ()
        while not readings and self._next is not None:
            due_ns, now_ns = self.due_ns(), self._clock()
            if due_ns is None or now_ns < due_ns:
                break
            t_ns, record = self._next
            if self._began is None:
                self._began = now_ns, t_ns
            readings = self._decoding.feed(t_ns, record)
            self._take_next()
            if readings:
                return [self._handed_over(reading, t_ns) for reading in readings]
        return ()

    def _handed_over(self, made: Reading, came_ns: int) -> Reading:
        self.handed_over_ns = self._clock()
        if not isinstance(made, TactileReading):
            return made
        t_ns = self.handed_over_ns - (came_ns - made.t_ns)
        return TactileReading(t_ns, made.seq, made.counts, made.faults, None, made.t_ns)

    def _take_next(self) -> None:
        self._next = None if self._timeline is None else next(self._timeline, None)
        self.exhausted = self._next is None
