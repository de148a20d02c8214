"""What came over a link, decoded again: candump text and framed serial bytes as a driver.

The bytes go through the very decoders that live ones go through, at the times at which they came.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Generator, Iterator, Sequence
from pathlib import Path
from typing import Protocol

from drivers.base import DriverCounters, Reading, RecordingError
from drivers.recordings.csv_rows import open_recording
from drivers.recordings.player import TimedDriver

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


class CaptureReplayDriver(TimedDriver[object]):
    """Plays captures in a row, as one run. `recorded_ns` of a reading is its time on their clock.

    Without `speed` as fast as possible. `open` raises `RecordingError`.
    """

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
        super().__init__(paths, speed, clock)
        self._records = records
        self._decoding = decoding
        self._reset()

    @property
    def counters(self) -> DriverCounters:
        """Those of the decoder."""
        return self._decoding.counters

    @property
    def period_ns(self) -> int | None:
        """Time between readings, ns, as played."""
        recorded_ns = self._decoding.period_ns
        return None if recorded_ns is None else round(recorded_ns / (self._speed or 1.0))

    def open(self) -> None:
        """Start over with the first file."""
        super().open()
        if self._next is None:
            raise RecordingError(self._paths[0], "has nothing that came over a link")

    def _check(self) -> None:
        for path in self._paths:
            open_recording(path).close()
        self._decoding.begin()

    def _play(self) -> Generator[tuple[int, object], None, None]:
        for path in self._paths:
            yield from self._records(path)

    def read_ready(self) -> Sequence[Reading]:
        """The readings that the records up to the first complete one give, as far as due."""
        while (due := self._take_due()) is not None:
            t_ns, record, _ = due
            if readings := self._decoding.feed(t_ns, record):
                return [self._hand_over(reading, t_ns) for reading in readings]
        return ()
