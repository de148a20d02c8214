"""Base of drivers that play files: items are read one ahead, and each is due at its time."""

from __future__ import annotations

import time
from collections.abc import Callable, Generator, Sequence
from pathlib import Path
from typing import Generic, TypeVar

import msgspec

from graspd.drivers.base import Fact, Opened, Reading, RecordingError

Item = TypeVar("Item")


class RecordedDriver(Opened, Generic[Item]):
    """Base of drivers that play items of known times at any speed. Times: ns, recording's clock.

    The run begins when the first item is asked for. Items are read one ahead, so that the work of
    reading does not add to their age. An error is raised after the items before it are taken.
    """

    name = "replay"
    live = False

    def __init__(
        self,
        paths: Sequence[Path],
        speed: float | None = None,
        clock: Callable[[], int] = time.monotonic_ns,
        *,
        delay_ns: int = 0,
    ) -> None:
        """Raises `ValueError` without `paths`, or for a `speed` of 0 or less.

        `speed`: factor of real time; None: as fast as possible. `delay_ns`: lateness of each item.
        """
        if not paths:
            raise ValueError("no recording to replay")
        if speed is not None and not speed > 0.0:
            raise ValueError(f"{speed} is no positive speed")
        self.paths = tuple(paths)
        self.speed = speed
        self.exhausted = False
        """True after the last item or an error, until `start`."""
        self.handed_over_ns = self._opened_ns = clock()
        """Time when the last reading was handed over, ns; the judge's now."""
        self._clock = clock
        self._delay_ns = delay_ns
        self._playing: Generator[tuple[int, Item], None, None] | None = None
        self._next: tuple[int, Item] | None = None
        self._failure: RecordingError | None = None
        self._began: tuple[int, int] | None = None
        """Start of the run, ns, by the clock and by the recording; None before."""

    @property
    def serials(self) -> dict[str, str]:
        return {}

    def describe(self) -> dict[str, Fact]:
        return {"recordings": Fact(", ".join(map(str, self.paths)))}

    def fileno(self) -> int | None:
        """Return None: a file is always readable, so the loop waits for `due_ns`."""
        return None

    def start(self, items: Generator[tuple[int, Item], None, None]) -> None:
        self.close()
        self._began = None
        self.handed_over_ns = self._opened_ns = self._clock()
        self._playing = items
        self._read_ahead(items)

    def close(self) -> None:
        if self._playing is not None:
            self._playing.close()
            self._playing = None

    def due_ns(self) -> int | None:
        """Return when the next item is due, ns; in the past: now. None: no item."""
        if self._playing is None or self.exhausted:
            return None
        if self.speed is None or self._next is None or self._began is None:
            return self._opened_ns
        return self.played_ns(self._next[0]) + self._delay_ns

    def played_ns(self, at_ns: int) -> int:
        """Return when an item of `at_ns` should be played, monotonic ns, without the delay."""
        began_ns, first_ns = self._began or (self._opened_ns, at_ns)
        return began_ns + round((at_ns - first_ns) / (self.speed or 1.0))

    def take(self) -> tuple[int, Item, int] | None:
        """Return time, content and lateness, ns, of a due item. Raises `RecordingError`."""
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
        return *item, now_ns - due_ns

    def hand_over(self, made: Reading, at_ns: int, axis_ns: int = 0) -> Reading:
        """Return the reading `made`, complete at `at_ns`, moved to now.

        `axis_ns`: time on the recording's clock that `recorded_ns` counts from.
        """
        self.handed_over_ns = self._clock()
        t_ns = self.handed_over_ns - (at_ns - made.t_ns)
        return msgspec.structs.replace(made, t_ns=t_ns, recorded_ns=made.t_ns - axis_ns)

    def _read_ahead(self, items: Generator[tuple[int, Item], None, None]) -> None:
        self._next, self._failure = None, None
        try:
            self._next = next(items, None)
            self.exhausted = self._next is None
        except RecordingError as error:
            self._failure = error
            self.exhausted = False
