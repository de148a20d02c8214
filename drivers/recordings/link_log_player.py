"""Play link logs through the decoders of live links, at the recorded times."""

from __future__ import annotations

import time
from collections.abc import Callable, Generator, Iterator, Sequence
from pathlib import Path
from typing import Protocol, TypeVar

from graspd.drivers.base import DriverCounters, Reading, RecordingError
from graspd.drivers.recordings.csv_rows import open_recording
from graspd.drivers.recordings.player import RecordedDriver

CANDUMP, SERIAL = ".log", ".serial"
"""File name endings of the two kinds of link log that graspd writes."""
Record = TypeVar("Record")


class LinkDecoder(Protocol):
    """Decoder of one link's records into readings."""

    @property
    def counters(self) -> DriverCounters:
        """Counters of records and of each kind of damage."""

    @property
    def period_ns(self) -> int | None:
        """Time between readings, ns, as recorded; None until it is known."""


class LinkLog(Protocol[Record]):
    """One kind of link log, and the decoder of its records."""

    @property
    def stream(self) -> LinkDecoder:
        """Decoder, the same as in a driver of this link."""

    def records(self, path: Path) -> Iterator[tuple[int, Record]]:
        """Yield times, ns, and records of a file; skip damage. Raises `RecordingError`."""

    def begin(self) -> None:
        """Start with a new decoder. Raises `DriverError`."""

    def feed(self, t_ns: int, record: Record) -> Sequence[Reading]:
        """Return the readings that a record of `t_ns` completes."""


class LinkLogDriver(RecordedDriver[Record]):
    """Play one or more link logs as one run."""

    def __init__(
        self,
        paths: Sequence[Path],
        log: LinkLog[Record],
        *,
        speed: float | None = None,
        clock: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        """Open nothing yet. Raises `ValueError` if `paths` is empty, or `speed` not above 0.

        `speed`: factor of real time; None: as fast as possible.
        """
        super().__init__(paths, speed, clock)
        self._log = log

    @property
    def counters(self) -> DriverCounters:
        return self._log.stream.counters

    @property
    def period_ns(self) -> int | None:
        """Time between readings as played, ns; None: not known yet."""
        recorded_ns = self._log.stream.period_ns
        return None if recorded_ns is None else round(recorded_ns / (self.speed or 1.0))

    def open(self) -> None:
        """Start from the first file."""
        self.close()
        for path in self.paths:
            open_recording(path).close()
        self._log.begin()
        logs = [self._log.records(path) for path in self.paths]
        self.start(self._records(logs))
        if self.exhausted:
            raise RecordingError(self.paths[0], "has nothing that came over a link")

    def _records(
        self, logs: Sequence[Iterator[tuple[int, Record]]]
    ) -> Generator[tuple[int, Record], None, None]:
        for path, records in zip(self.paths, logs, strict=True):
            try:
                yield from records
            except OSError as error:
                raise RecordingError(path, f"cannot be read: {error.strerror}") from error

    def read_ready(self) -> Sequence[Reading]:
        """Return the readings of the first due record that completes some."""
        while (due := self.take()) is not None:
            t_ns, record, _ = due
            if readings := self._log.feed(t_ns, record):
                return [self.hand_over(reading, t_ns) for reading in readings]
        return ()
