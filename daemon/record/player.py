"""The replay of the daemon's own recordings: its readings again, as old as they were then."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Generator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import msgspec
import numpy as np

from daemon.record.mcap import EVENTS, McapRecording, RecordedMessage, header_of
from drivers.base import (
    ELECTRODES,
    DriverCounters,
    JointReading,
    Reading,
    RecordingError,
    TactileReading,
)
from drivers.recordings.csv_rows import open_recording
from drivers.recordings.player import RecordedDriver, Timeline

_log = logging.getLogger(__name__)


class _Tactile(msgspec.Struct, frozen=True):
    """What is needed of a message on `tactile.<hand>`."""

    seq: int
    t_mono_ns: int
    fingers: tuple[str, ...]
    counts: list[list[int]]
    faults: list[list[int]]


class _Joints(msgspec.Struct, frozen=True):
    """What is needed of a recorded joint reading."""

    seq: int
    t_mono_ns: int
    names: tuple[str, ...]
    position_rad: list[float | None]


_tactile_decoder = msgspec.json.Decoder(_Tactile)
_joints_decoder = msgspec.json.Decoder(_Joints)


@dataclass(slots=True)
class McapCounters(DriverCounters):
    """What a replay of recordings counts."""

    late: int = 0
    """Readings handed over more than one period after they were due."""
    malformed: int = 0
    """Messages that are no reading of these fingers."""
    cut_off: int = 0
    """Files that end without an end, as those of a daemon that was killed do."""


@dataclass(frozen=True, slots=True, eq=False)
class _Due:
    """A reading, and what was told between the one before it and this one."""

    reading: Reading
    told: tuple[str, ...] = ()
    """Kinds of `EVENTS`, in their order."""


class McapReplayDriver(RecordedDriver[_Due]):
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
        super().__init__(paths, Timeline(speed, clock))
        self._axis_ns = axis_ns
        self._fingers = tuple(fingers)
        self.on_told: Mapping[str, Callable[[], None]] = {}
        """What is done, by kind of `EVENTS`, where one stands."""
        self._reset()

    def _reset(self) -> None:
        self.counters = McapCounters()
        self.period_ns: int | None = None
        """Shortest time, ns, between two readings so far, as played."""
        self._last_ns: int | None = None

    def open(self) -> None:
        """Check the header of every file, then start over with the first one."""
        self.close()
        self._reset()
        for path in self.paths:
            recorded = header_of(path).fingers
            missing = [finger for finger in self._fingers if finger not in recorded]
            if missing:
                raise RecordingError(path, f"has no finger {missing[0]}, only {recorded}")
        self.timeline.start(self._items())

    def read_ready(self) -> Sequence[Reading]:
        """The next reading if it is due, else none."""
        taken = self.timeline.take()
        if taken is None:
            return ()
        at_ns, due, late_ns = taken
        if self.timeline.speed is not None and self.period_ns is not None:
            self.counters.late += late_ns > self.period_ns
        for kind in due.told:
            if kind in self.on_told:
                self.on_told[kind]()
        if isinstance(due.reading, TactileReading):
            self._count(due.reading)
        return [self.timeline.hand_over(due.reading, at_ns, self._axis_ns)]

    def _count(self, made: TactileReading) -> None:
        self.counters.readings += 1
        self.counters.faulty_readings += bool(made.faults.any())
        step_ns = made.t_ns - self._last_ns if self._last_ns is not None else 0
        if step_ns > 0:
            step_ns = round(step_ns / (self.timeline.speed or 1.0))
            self.period_ns = min(step_ns, self.period_ns or step_ns)
        self._last_ns = made.t_ns

    def _items(self) -> Generator[tuple[int, _Due], None, None]:
        told: tuple[str, ...] = ()
        for path in self.paths:
            with open_recording(path) as stream:
                recording = McapRecording(path, stream)
                for message in recording:
                    if message.kind in EVENTS and message.kind not in told:
                        told = (*told, message.kind)
                    reading = self._reading(message)
                    if reading is not None:
                        yield message.at_ns, _Due(reading, told)
                        told = ()
                if recording.cut_off:
                    self.counters.cut_off += 1
                    _log.warning("%s: ends without an end; played as far as it goes", path)

    def _reading(self, message: RecordedMessage) -> Reading | None:
        """The reading in a message; None for one of another kind, or that has none."""
        try:
            if message.kind == "tactile":
                return tactile_reading(message.payload, self._fingers)
            if message.kind == "joints":
                return _joints(_joints_decoder.decode(message.payload))
        except (msgspec.DecodeError, ValueError, OverflowError):
            self.counters.malformed += 1
        return None


def tactile_reading(payload: bytes, fingers: Sequence[str]) -> TactileReading:
    """The reading in a `tactile` message, with these fingers, in their order.

    Raises `msgspec.DecodeError`, `ValueError` or `OverflowError` for what is none.
    """
    message = _tactile_decoder.decode(payload)
    rows = [message.fingers.index(finger) for finger in fingers]
    shape = (len(message.fingers), ELECTRODES)
    counts = np.array(message.counts, dtype=np.uint16).reshape(shape)
    faults = np.array(message.faults, dtype=np.uint8).reshape(shape)
    return TactileReading(message.t_mono_ns, message.seq, counts[rows], faults[rows])


def _joints(message: _Joints) -> JointReading:
    """Raises `ValueError` for angles without names."""
    if len(message.names) != len(message.position_rad):
        raise ValueError("as many names as angles are needed")
    angles = np.array(message.position_rad, dtype=np.float64)  # None becomes NaN
    return JointReading(message.t_mono_ns, message.seq, message.names, angles)
