"""Bases of drivers that play files: items are read one ahead, and each is due at its time."""

from __future__ import annotations

import time
from abc import abstractmethod
from collections.abc import Callable, Generator, Iterator, Sequence
from pathlib import Path
from typing import Final, Generic, Protocol, TypeVar

import msgspec

from graspd.drivers.base import DriverCounters, Fact, Opened, Reading, RecordingError
from graspd.drivers.recordings.kinds import open_recording

Item = TypeVar("Item")
TIME_MAX_NS: Final = 9 * 10**18
"""Latest time, ns, which is in 2255. Integers of 64 bits end at 9.22e18."""


def within_limits(path: Path, t_ns: int, line: int | None = None) -> int:
    """Return `t_ns`. Raises `RecordingError` if it is later than `TIME_MAX_NS`.

    `line`: line of the file that has this time.
    """
    if t_ns > TIME_MAX_NS:
        problem = f"the time {t_ns / 1e9:.12g} s is later than any: {TIME_MAX_NS / 1e9:.12g} s"
        raise RecordingError(path, problem, line=line)
    return t_ns


class RecordedDriver(Opened, Generic[Item]):
    """Base of drivers that play items at any speed. Times of items: ns, recording's clock.

    The run begins when the first item is requested. Items are read one ahead, so that reading
    does not add to their age. An error is raised once the items before it are taken.
    """

    name = "replay"
    live = False

    def __init__(
        self,
        paths: Sequence[Path],
        speed: float | None = None,
        clock: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        """`speed`: factor of real time; None: as fast as possible."""
        self.paths = tuple(paths)
        self.speed = speed
        self.exhausted = False
        """True after the last item or an error, until `start`."""
        self.handed_over_ns = self._opened_ns = clock()
        """Time when the last reading was handed over, ns, which the judge uses as now."""
        self._clock = clock
        self._playing: Generator[tuple[int, Item], None, None] | None = None
        self._next: tuple[int, Item] | None = None
        self._failure: RecordingError | None = None
        self._began: tuple[int, int] | None = None
        """Start of the run, ns, by `clock` and by the recording; None: not begun."""

    @property
    def serials(self) -> dict[str, str]:
        return {}

    def describe(self) -> dict[str, Fact]:
        return {"recordings": Fact(", ".join(map(str, self.paths)))}

    def fileno(self) -> int | None:
        """Return None: a file is always readable, so the loop waits for `due_ns`."""
        return None

    def start(self, items: Generator[tuple[int, Item], None, None]) -> None:
        """Play `items`, pairs of time, ns, and content. Call it while closed."""
        self._began = None
        self.handed_over_ns = self._opened_ns = self._clock()
        self._playing = items
        self._read_ahead(items)

    def close(self) -> None:
        if self._playing is not None:
            self._playing.close()
            self._playing = None

    def due_ns(self) -> int | None:
        """Return when the next item is due, monotonic ns; the past means now. None: no item."""
        if self._playing is None or self.exhausted:
            return None
        if self.speed is None or self._next is None or self._began is None:
            return self._opened_ns
        return self.played_ns(self._next[0])

    def played_ns(self, at_ns: int) -> int:
        """Return when an item of `at_ns` should be played, monotonic ns."""
        began_ns, first_ns = self._began or (self._opened_ns, at_ns)
        return began_ns + round((at_ns - first_ns) / (self.speed or 1.0))

    def take(self) -> tuple[int, Item] | None:
        """Return time, ns, and content of the next item; None: not due, or none left. Raises
        `RecordingError`."""
        if self._playing is None:
            raise RuntimeError("the replay is not open")
        now_ns, item = self._clock(), self._next
        if self._began is None and item is not None:
            self._began = now_ns, item[0]
        due_ns = self.due_ns()
        if due_ns is None or now_ns < due_ns:
            return None
        if item is None:
            self.exhausted = True
            if self._failure is not None:
                raise self._failure
            return None
        self._read_ahead(self._playing)
        return item

    def hand_over(self, made: Reading, at_ns: int) -> Reading:
        """Return the reading `made`, which was complete at `at_ns`, as if `at_ns` were now; its
        `recorded_ns` is the time that it had."""
        self.handed_over_ns = self._clock()
        t_ns = self.handed_over_ns - (at_ns - made.t_ns)
        return msgspec.structs.replace(made, t_ns=t_ns, recorded_ns=made.t_ns)

    def _read_ahead(self, items: Generator[tuple[int, Item], None, None]) -> None:
        self._next, self._failure = None, None
        try:
            self._next = next(items, None)
            self.exhausted = self._next is None
        except RecordingError as error:
            self._failure = error
            self.exhausted = False


class ReadingsDriver(RecordedDriver[Item]):
    """Base of drivers that play readings, each with the time at which it was made."""

    def __init__(
        self,
        paths: Sequence[Path],
        fingers: Sequence[str],
        *,
        speed: float | None = None,
        clock: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        """`fingers`: the rows of a reading; each file must have these fingers. `speed`: factor of
        real time; None: as fast as possible."""
        super().__init__(paths, speed, clock)
        self._fingers = tuple(fingers)
        self.reset()

    def reset(self) -> None:
        """Forget the readings of a former run."""
        self.period_ns: int | None = None
        """Shortest time between two readings as played, ns; None: not known yet."""
        self._last_ns: int | None = None

    def follow(self, t_ns: int) -> None:
        """Update `period_ns` by the time at which a reading was made, ns."""
        if self._last_ns is not None and t_ns > self._last_ns:
            step_ns = round((t_ns - self._last_ns) / (self.speed or 1.0))
            self.period_ns = min(step_ns, self.period_ns or step_ns)
        self._last_ns = t_ns


class LinkDecoder(Protocol):
    """Decoder of one link, as used by the live driver."""

    @property
    def counters(self) -> DriverCounters: ...

    @property
    def period_ns(self) -> int | None:
        """Time between readings, ns, as recorded; None until it is known."""


class LinkLogDriver(RecordedDriver[Item]):
    """Play one or more link logs as one run, through the decoder of the live link."""

    stream: LinkDecoder

    @abstractmethod
    def records(self, path: Path) -> Iterator[tuple[int, Item]]:
        """Yield times, ns, and records of a file; skip damage. Raises `RecordingError`."""

    @abstractmethod
    def begin(self) -> None:
        """Make a new decoder, `stream`."""

    @abstractmethod
    def feed(self, t_ns: int, record: Item) -> Sequence[Reading]:
        """Return the readings that a record of `t_ns` completes."""

    @property
    def counters(self) -> DriverCounters:
        return self.stream.counters

    @property
    def period_ns(self) -> int | None:
        """Time between readings as played, ns; None: not known yet."""
        recorded_ns = self.stream.period_ns
        return None if recorded_ns is None else round(recorded_ns / (self.speed or 1.0))

    def survey(self) -> None:
        """Look at the files before they are played. Raises `RecordingError`."""
        for path in self.paths:
            open_recording(path).close()

    def open(self) -> None:
        """Start from the first file. Raises `RecordingError`, also if no file has a record."""
        self.close()
        self.survey()
        self.begin()
        logs = [self.records(path) for path in self.paths]
        self.start(self._records(logs))
        if self.exhausted:
            raise RecordingError(self.paths[0], "has nothing that came over a link")

    def _records(
        self, logs: Sequence[Iterator[tuple[int, Item]]]
    ) -> Generator[tuple[int, Item], None, None]:
        for path, records in zip(self.paths, logs, strict=True):
            try:
                yield from records
            except OSError as error:
                raise RecordingError(path, f"cannot be read: {error.strerror}") from error

    def read_ready(self) -> Sequence[Reading]:
        """Return the readings of the first due record that completes some."""
        while (due := self.take()) is not None:
            t_ns, record = due
            if readings := self.feed(t_ns, record):
                return [self.hand_over(reading, t_ns) for reading in readings]
        return ()
