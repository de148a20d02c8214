"""What drivers that play files have in common: items read one ahead, each due at its time."""

from __future__ import annotations

from collections.abc import Callable, Generator, Sequence
from pathlib import Path
from typing import Generic, TypeVar

import msgspec

from graspd.drivers.base import Fact, Opened, Reading, RecordingError

Item = TypeVar("Item")


class RecordedDriver(Opened, Generic[Item]):
    """Base of drivers that play items of known times, ns on the recording's clock, at any speed.

    The first item begins the run when it is asked for. Reading one ahead keeps the work of reading
    out of the age of what is read; an error waits until the items before it are taken.
    """

    name = "replay"
    live = False

    def __init__(
        self,
        paths: Sequence[Path],
        speed: float | None,
        clock: Callable[[], int],
        *,
        delay_ns: int = 0,
    ) -> None:
        """Without `speed`, as fast as possible; else `delay_ns` late. Raises `ValueError`."""
        if not paths:
            raise ValueError("no recording to replay")
        if speed is not None and not speed > 0.0:
            raise ValueError(f"{speed} is no positive speed")
        self.paths = tuple(paths)
        self.speed = speed
        self.exhausted = False
        """True when the last item has been taken, or after an error, until `start`."""
        self.handed_over_ns = self._opened_ns = clock()
        """Time of the last reading handed over: the judge's now, whatever the load."""
        self._clock = clock
        self._delay_ns = delay_ns
        self._playing: Generator[tuple[int, Item], None, None] | None = None
        self._next: tuple[int, Item] | None = None
        self._failure: RecordingError | None = None
        self._began: tuple[int, int] | None = None
        """When the first item was asked for, by the clock and by the recording's."""

    @property
    def serials(self) -> dict[str, str]:
        return {}

    def describe(self) -> dict[str, Fact]:
        return {"recordings": Fact(", ".join(map(str, self.paths)))}

    def fileno(self) -> int | None:
        """None: a file is always readable, the clock says when."""
        return None

    def start(self, items: Generator[tuple[int, Item], None, None]) -> None:
        """Play these from the first one on."""
        self.close()
        self._began = None
        self.handed_over_ns = self._opened_ns = self._clock()
        self._playing = items
        self._read_ahead(items)

    def close(self) -> None:
        """Close the file that plays."""
        if self._playing is not None:
            self._playing.close()
            self._playing = None

    def due_ns(self) -> int | None:
        """When the next item is due; a time in the past for at once; None if there is none."""
        if self._playing is None or self.exhausted:
            return None
        if self.speed is None or self._next is None or self._began is None:
            return self._opened_ns
        return self.played_ns(self._next[0]) + self._delay_ns

    def played_ns(self, at_ns: int) -> int:
        """When an item of this time should be played, monotonic ns, without any delay."""
        began_ns, first_ns = self._began or (self._opened_ns, at_ns)
        return began_ns + round((at_ns - first_ns) / (self.speed or 1.0))

    def take(self) -> tuple[int, Item, int] | None:
        """Return a due item's time, content and lateness, ns. Raises `RecordingError`."""
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
        """Return a reading of `at_ns` moved to now; `axis_ns`: the recording's zero, ns."""
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
