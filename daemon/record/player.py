"""The replay of the daemon's own recordings: its readings again, as old as they were then."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Generator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from daemon.record.mcap import McapReader, RecordedMessage, header_of
from daemon.record.topics import EVENTS, Topic, joint_reading, tactile_reading
from drivers.base import DriverCounters, Reading, RecordingError, TactileReading
from drivers.recordings.csv_rows import open_recording
from drivers.recordings.player import TimedDriver

_log = logging.getLogger(__name__)


@dataclass(slots=True)
class McapCounters(DriverCounters):
    """What a replay of recordings counts."""

    late: int = 0
    """Readings handed over more than one period after they were due."""
    malformed: int = 0
    """Messages that are no reading of these fingers."""
    cut_off: int = 0
    """Files that end without an end, as those of a daemon that was killed do."""


class McapReplayDriver(TimedDriver[Reading | Topic]):
    """Plays MCAP files of graspd, one reading per call of `read_ready` at most.

    `recorded_ns` of a reading is its `t_ns` when it was recorded, counted from `axis_ns`; `t_ns`
    makes it as old, when it is handed over, as it was then. Several files play in a row as the one
    run that they are. Without `speed` as fast as possible. The constructor raises `ValueError`,
    `open` `RecordingError`. Damage ends a file early, which is counted.
    """

    def __init__(
        self,
        paths: Sequence[Path],
        fingers: Sequence[str],
        *,
        speed: float | None = None,
        axis_ns: int = 0,
        clock: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        super().__init__(paths, speed, clock)
        self._axis_ns = axis_ns
        self._fingers = tuple(fingers)
        self.on_event: Mapping[Topic, Callable[[], None]] = {}
        """What to call where one of `EVENTS` stands; nothing for those that are not in it."""
        self._reset()

    def _reset(self) -> None:
        super()._reset()
        self.counters = McapCounters()
        self.period_ns: int | None = None
        """Shortest time, ns, between two readings so far, as played."""
        self._last_ns: int | None = None

    def _check(self) -> None:
        for path in self._paths:
            recorded = header_of(path).fingers
            missing = [finger for finger in self._fingers if finger not in recorded]
            if missing:
                raise RecordingError(path, f"has no finger {missing[0]}, only {recorded}")

    def read_ready(self) -> Sequence[Reading]:
        """The next reading if it is due, else none."""
        taken = self._take_due()
        if taken is None:
            return ()
        at_ns, item, late_ns = taken
        if isinstance(item, Topic):
            if item in self.on_event:
                self.on_event[item]()
            return ()
        if self._speed is not None and self.period_ns is not None:
            self.counters.late += late_ns > self.period_ns
        if isinstance(item, TactileReading):
            self._count(item)
        return [self._hand_over(item, at_ns, self._axis_ns)]

    def _count(self, made: TactileReading) -> None:
        self.counters.readings += 1
        self.counters.faulty_readings += bool(made.faults.any())
        step_ns = made.t_ns - self._last_ns if self._last_ns is not None else 0
        if step_ns > 0:
            step_ns = round(step_ns / (self._speed or 1.0))
            self.period_ns = min(step_ns, self.period_ns or step_ns)
        self._last_ns = made.t_ns

    def _play(self) -> Generator[tuple[int, Reading | Topic], None, None]:
        for path in self._paths:
            with open_recording(path) as stream:
                recording = McapReader(path, stream)
                for message in recording:
                    item = self._item(message)
                    if item is not None:
                        yield message.at_ns, item
                if recording.cut_off:
                    self.counters.cut_off += 1
                    _log.warning("%s: ends without an end; played as far as it goes", path)

    def _item(self, message: RecordedMessage) -> Reading | Topic | None:
        """The reading or event that a message tells of; None if it tells of neither."""
        try:
            if message.kind == Topic.TACTILE:
                return tactile_reading(message.payload, self._fingers)
            if message.kind == Topic.JOINTS:
                return joint_reading(message.payload)
        except (ValueError, OverflowError):
            self.counters.malformed += 1
            return None
        return Topic(message.kind) if message.kind in EVENTS else None
