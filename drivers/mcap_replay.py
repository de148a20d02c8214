"""The replay of the daemon's own recordings: its readings again, as old as they were then."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Self

import msgspec
import numpy as np

from drivers.base import ELECTRODES, DriverCounters, JointReading, RecordingError, TactileReading
from drivers.mcap_recording import McapRecording, RecordedMessage, header_of
from drivers.recording import open_recording

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
    """A reading and when it was recorded, monotonic ns of the daemon that did."""

    reading: TactileReading | JointReading
    at_ns: int
    asked: bool = False
    """Whether the controller asked for a judgement before it."""


class McapReplayDriver:
    """Plays MCAP files of graspd, one reading per call of `read_ready` at most.

    `recorded_ns` of a reading is its `t_ns` when it was recorded; `t_ns` makes it as old, when it
    is handed over, as it was then. Several files play in a row as the one run that they are.
    Without `speed` as fast as possible. The constructor raises `ValueError`, `open`
    `RecordingError`. Damage ends a file early, which is counted.
    """

    name = "replay"

    def __init__(
        self,
        paths: Sequence[Path],
        fingers: Sequence[str],
        *,
        speed: float | None = None,
        clock: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        if not paths:
            raise ValueError("no recording to replay")
        if speed is not None and not speed > 0.0:
            raise ValueError(f"speed is {speed}, must be positive")
        self._paths = tuple(paths)
        self._fingers = tuple(fingers)
        self._speed = speed
        self._clock = clock
        self.on_asked: Callable[[], None] | None = None
        """Done where the controller had asked for a judgement."""
        self._timeline: Iterator[_Due] | None = None
        self._reset()

    def _reset(self) -> None:
        self.counters = McapCounters()
        self.period_ns: int | None = None
        """Shortest time, ns, between two readings so far, as played."""
        self.exhausted = False
        self.handed_over_ns = self._clock()
        """When the last reading was: what a judge must take for now, to find it as old as it was
        found then, however busy the machine is."""
        self._opened_ns = self._clock()
        self._began: tuple[int, int] | None = None
        self._next: _Due | None = None
        self._last_ns: int | None = None

    @property
    def serials(self) -> dict[str, str]:
        """A recording does not tell."""
        return {}

    def describe(self) -> dict[str, str]:
        """Which recordings are played."""
        return {"recordings": ", ".join(map(str, self._paths))}

    def open(self) -> None:
        """Check the beginning of every file, then start over with the first one."""
        self.close()
        self._reset()
        for path in self._paths:
            recorded = header_of(path).fingers
            missing = [finger for finger in self._fingers if finger not in recorded]
            if missing:
                raise RecordingError(path, f"has no finger {missing[0]}, only {recorded}")
        self._timeline = self._play()
        self._prepare_next()

    def close(self) -> None:
        """Close the file that plays."""
        timeline, self._timeline = self._timeline, None
        close = getattr(timeline, "close", None)
        if close is not None:
            close()

    def __enter__(self) -> Self:
        self.open()
        return self

    def __exit__(self, *_details: object) -> None:
        self.close()

    def fileno(self) -> int | None:
        """None: a file is always readable, the clock says when."""
        return None

    def due_ns(self) -> int | None:
        """When the next reading is due; a time in the past for at once."""
        if self._timeline is None or self.exhausted:
            return None
        if self._speed is None or self._next is None or self._began is None:
            return self._opened_ns
        began_ns, recorded_ns = self._began
        return began_ns + round((self._next.at_ns - recorded_ns) / self._speed)

    def read_ready(self) -> Sequence[TactileReading | JointReading]:
        """The next reading if it is due, else none."""
        due, due_ns, now_ns = self._next, self.due_ns(), self._clock()
        if due is None or due_ns is None or now_ns < due_ns:
            return ()
        if self._began is None:
            self._began = now_ns, due.at_ns
        elif self._speed is not None and self.period_ns is not None:
            self.counters.late += now_ns - due_ns > self.period_ns
        self._prepare_next()
        if due.asked and self.on_asked is not None:
            self.on_asked()
        return [self._handed_over(due)]

    def _handed_over(self, due: _Due) -> TactileReading | JointReading:
        made, now_ns = due.reading, self._clock()
        self.handed_over_ns = now_ns
        t_ns = now_ns - (due.at_ns - made.t_ns)
        if isinstance(made, JointReading):
            return JointReading(t_ns, made.seq, made.names, made.position_rad, made.t_ns)
        self.counters.readings += 1
        self.counters.faulty_readings += bool(made.faults.any())
        step_ns = made.t_ns - self._last_ns if self._last_ns is not None else 0
        if step_ns > 0:
            step_ns = round(step_ns / (self._speed or 1.0))
            self.period_ns = min(step_ns, self.period_ns or step_ns)
        self._last_ns = made.t_ns
        return TactileReading(t_ns, made.seq, made.counts, made.faults, None, made.t_ns)

    def _prepare_next(self) -> None:
        if self._timeline is not None:
            self._next = next(self._timeline, None)
            self.exhausted = self._next is None

    def _play(self) -> Iterator[_Due]:
        asked = False
        for path in self._paths:
            with open_recording(path) as stream:
                recording = McapRecording(path, stream)
                for message in recording:
                    asked = asked or message.kind == "asked"
                    reading = self._reading(message)
                    if reading is not None:
                        yield _Due(reading, message.at_ns, asked)
                        asked = False
                if recording.cut_off:
                    self.counters.cut_off += 1
                    _log.warning("%s: ends without an end; played as far as it goes", path)

    def _reading(self, message: RecordedMessage) -> TactileReading | JointReading | None:
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
