"""Base of drivers that play link logs through the decoders of live links."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Generator, Iterator, Sequence
from pathlib import Path
from typing import Protocol, TypeVar

from graspd.drivers.base import DriverCounters, Reading, RecordingError
from graspd.drivers.recordings.csv_rows import open_recording
from graspd.drivers.recordings.player import RecordedDriver

CANDUMP, SERIAL = ".log", ".serial"
"""File name endings of the two kinds of link log that graspd writes."""
Record = TypeVar("Record")


class LinkDecoder(Protocol):
    """Decoder of one link, the same as in its driver."""

    @property
    def counters(self) -> DriverCounters: ...

    @property
    def period_ns(self) -> int | None:
        """Time between readings, ns, as recorded; None until it is known."""


class LinkLogDriver(RecordedDriver[Record]):
    """Play one or more link logs as one run."""

    stream: LinkDecoder

    @abstractmethod
    def records(self, path: Path) -> Iterator[tuple[int, Record]]:
        """Yield times, ns, and records of a file; skip damage. Raises `RecordingError`."""

    @abstractmethod
    def begin(self) -> None:
        """Make a new `stream`. Raises `DriverError`."""

    @abstractmethod
    def feed(self, t_ns: int, record: Record) -> Sequence[Reading]:
        """Return the readings that a record of `t_ns` completes."""

    @property
    def counters(self) -> DriverCounters:
        return self.stream.counters

    @property
    def period_ns(self) -> int | None:
        """Time between readings as played, ns; None: not known yet."""
        recorded_ns = self.stream.period_ns
        return None if recorded_ns is None else round(recorded_ns / (self.speed or 1.0))

    def open(self) -> None:
        """Start from the first file."""
        self.close()
        for path in self.paths:
            open_recording(path).close()
        self.begin()
        logs = [self.records(path) for path in self.paths]
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
            if readings := self.feed(t_ns, record):
                return [self.hand_over(reading, t_ns) for reading in readings]
        return ()
