"""What drivers that play recordings have in common: files in a row, read one item ahead."""

from __future__ import annotations

import dataclasses
from abc import abstractmethod
from collections.abc import Callable, Generator, Sequence
from pathlib import Path
from typing import Generic, TypeVar

from drivers.base import Opened, Reading

Item = TypeVar("Item")


class TimelineDriver(Opened, Generic[Item]):
    """Plays the items of its files, one after the other. Whoever derives says what items are."""

    name = "replay"
    live = False

    def __init__(self, paths: Sequence[Path], clock: Callable[[], int]) -> None:
        """Nothing is opened yet. Raises `ValueError` without files.

        Whoever derives calls `_reset` at the end of its own.
        """
        if not paths:
            raise ValueError("no recording to replay")
        self._paths = tuple(paths)
        self._clock = clock
        self._timeline: Generator[Item, None, None] | None = None

    def _reset(self) -> None:
        self.exhausted = False
        """True when the last item has been handed over, or after an error, until `open`."""
        self._opened_ns = self._clock()
        self._next: Item | None = None

    @property
    def serials(self) -> dict[str, str]:
        """A recording is of no sensor that is there."""
        return {}

    def describe(self) -> dict[str, str]:
        """Which recordings are played."""
        return {"recordings": ", ".join(map(str, self._paths))}

    def open(self) -> None:
        """Check the beginning of every file, then start over with the first one."""
        self.close()
        self._reset()
        self._check()
        self._timeline = self._play()
        self._prepare_next()

    @abstractmethod
    def _check(self) -> None:
        """Raises `RecordingError` if a file is not what it should be."""

    @abstractmethod
    def _play(self) -> Generator[Item, None, None]:
        """All items of all files."""

    def _prepare_next(self) -> None:
        if self._timeline is not None:
            self._next = next(self._timeline, None)
            self.exhausted = self._next is None

    def close(self) -> None:
        """Close the file that plays."""
        if self._timeline is not None:
            self._timeline.close()
            self._timeline = None

    def fileno(self) -> int | None:
        """None: a file is always readable, the clock says when."""
        return None


class TimedDriver(TimelineDriver[tuple[int, Item]]):
    """Plays items of known times, ns on a clock of the recording's, at any speed."""

    def __init__(
        self, paths: Sequence[Path], speed: float | None, clock: Callable[[], int]
    ) -> None:
        """Without `speed` as fast as possible. Raises `ValueError` also for one that is none."""
        super().__init__(paths, clock)
        if speed is not None and not speed > 0.0:
            raise ValueError(f"{speed} is no positive speed")
        self._speed = speed

    def _reset(self) -> None:
        super()._reset()
        self.handed_over_ns = self._opened_ns
        """When the last reading was: what a judge must take for now, to find it as old as it was
        found then, however busy the machine is."""
        self._began: tuple[int, int] | None = None
        """When the first item was played, by the clock and by the recording's."""

    def due_ns(self) -> int | None:
        """When the next item is due; a time in the past for at once."""
        if self._timeline is None or self.exhausted:
            return None
        if self._speed is None or self._next is None or self._began is None:
            return self._opened_ns
        began_ns, recorded_ns = self._began
        return began_ns + round((self._next[0] - recorded_ns) / self._speed)

    def _take_due(self) -> tuple[int, Item, int] | None:
        """Time and content of the next item, and how late it is, ns; None if it is not due."""
        item, due_ns, now_ns = self._next, self.due_ns(), self._clock()
        if item is None or due_ns is None or now_ns < due_ns:
            return None
        if self._began is None:
            self._began = now_ns, item[0]
        self._prepare_next()
        return *item, now_ns - due_ns

    def _hand_over(self, made: Reading, at_ns: int, axis_ns: int = 0) -> Reading:
        """A reading of the recording as one of now, as old as it was at the recording's `at_ns`.

        `recorded_ns` is counted from `axis_ns`.
        """
        self.handed_over_ns = self._clock()
        t_ns = self.handed_over_ns - (at_ns - made.t_ns)
        return dataclasses.replace(made, t_ns=t_ns, recorded_ns=made.t_ns - axis_ns)
