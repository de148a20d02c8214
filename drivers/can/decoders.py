"""CAN frames in, readings out: one decoder per format. No I/O; what a bus brings never raises."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, Protocol

import numpy as np

from drivers.base import FINGERS, ElectrodeFault, TactileReading
from drivers.biotac import SEQUENCES, decode_words
from drivers.can.formats import (
    CanFormat,
    Reject,
    SweepStatus,
    parse_sample,
    parse_sweep,
    sample_length,
)
from drivers.can.frames import (
    EXTENDED,
    EXTENDED_ID_MAX,
    FD,
    STANDARD_ID_MAX,
    CanFrame,
)
from drivers.can.samples import SampleSweeps, SweepCounters
from drivers.can.sweep_frames import FrameSweeps

_ABSENT, _REPEATED, _OVERRUN = (
    int(SweepStatus.ABSENT),
    int(SweepStatus.REPEATED),
    int(SweepStatus.OVERRUN),
)
_MISSING, _HELD = int(ElectrodeFault.MISSING), int(ElectrodeFault.HELD)


@dataclass(slots=True)
class CanCounters(SweepCounters):
    """What a CAN bus brought, and what became of it."""

    frames: int = 0
    """Frames of every kind that the bus brought."""
    accepted_frames: int = 0
    """Of these, samples or sweep frames of our sensors, before duplicates and losses."""
    foreign_frames: int = 0
    """Frames with another arbitration id than the configured or the latched one; until an id is
    latched, frames that are no sound sample."""
    remote_frames: int = 0
    error_frames: int = 0
    """Frames in which the controller reports trouble on the bus."""
    wrong_length_frames: int = 0
    """Our arbitration id, another length than configured."""
    unknown_commands: int = 0
    """Our arbitration id, but the first byte samples no channel."""
    unknown_versions: int = 0
    """Sweep frames of another layout version."""
    malformed_frames: int = 0
    """Our arbitration id, contents that the format forbids."""
    stuck_ticks: int = 0
    """Sweep frames of a new sweep with the tick of the sweep before; their words are `HELD`."""
    overruns: int = 0
    """Sweep frames that report a sweep that began late."""
    controller_overflows: int = 0
    """Error frames that report a receive overflow of the controller."""
    kernel_drops: int = 0
    """Frames that the kernel dropped because the socket's buffer was full (socketcan only)."""
    bus_off: int = 0
    """Times that the controller left the bus after too many errors."""
    bus_faults: int = 0
    """Failures of the bus or of python-can, opening it included."""
    link_losses: int = 0
    """Times that the link was up and was lost."""


class CanDecoder(Protocol):
    """Turns the data frames of one format into readings."""

    @property
    def period_ns(self) -> int | None:
        """Time between readings, ns, as measured; None until it is known."""

    @property
    def expected_ns(self) -> int | None:
        """When the next reading should be complete, monotonic ns, where many frames make one."""

    @property
    def arbitration_id(self) -> int | None:
        """Whose frames are taken; None while any would be."""

    def push(
        self, frame: CanFrame, t_ns: int, until_ns: int | None = None
    ) -> Sequence[TactileReading]:
        """Take a data frame received at `t_ns`; the readings that it completes, oldest first.

        With `until_ns` it was received at any time between the two.
        """

    def cut(self) -> Sequence[TactileReading]:
        """Frames were lost here: the readings that end with that."""

    def interrupt(self) -> None:
        """The link broke."""


def make_decoder(
    frame_format: CanFormat,
    fingers: Sequence[str],
    *,
    counters: CanCounters,
    arbitration_id: int | None,
    sequence: str,
    data_length: int | None,
    sensors: Sequence[str] | None = None,
) -> CanDecoder:
    """The decoder of a format. Raises `ValueError` for arguments that do not fit it.

    `fingers`: rows of a reading. `sensors`: fingers in the order of a sample's words, the same
    unless given (`syntouch` only).
    """
    for names in (fingers, sensors if sensors is not None else fingers):
        if not names or len(set(names)) != len(names) or not set(names) <= set(FINGERS):
            raise ValueError(f"fingers {list(names)} are not different ones of {list(FINGERS)}")
    if arbitration_id is not None and not 0 <= arbitration_id <= EXTENDED_ID_MAX:
        raise ValueError(f"arbitration_id {arbitration_id} is not in 0..{EXTENDED_ID_MAX:#x}")
    if frame_format is CanFormat.SYNTOUCH:
        return SynTouchDecoder(
            fingers,
            fingers if sensors is None else sensors,
            arbitration_id,
            sequence,
            data_length,
            counters,
        )
    if sensors is not None:
        raise ValueError("sensors is for the format syntouch; sweep frames say whose they are")
    if data_length is not None:
        raise ValueError("data_length is for the format syntouch; sweep frames have 64 bytes")
    return SweepFrameDecoder(fingers, arbitration_id, counters)


class SynTouchDecoder:
    """Samples of SynTouch's board, one frame each."""

    def __init__(
        self,
        fingers: Sequence[str],
        sensors: Sequence[str],
        arbitration_id: int | None,
        sequence: str,
        data_length: int | None,
        counters: CanCounters,
    ) -> None:
        if sequence not in SEQUENCES:
            raise ValueError(f"sequence {sequence!r} is none of {sorted(SEQUENCES)}")
        if not set(fingers) <= set(sensors):
            raise ValueError(f"fingers {list(fingers)} are not all of {list(sensors)}")
        self._sensors = len(sensors)
        self._length = sample_length(len(sensors), data_length)
        self._configured = arbitration_id is not None
        self._id = arbitration_id
        self._flags = _id_flags(arbitration_id)
        self._counters = counters
        rows = [sensors.index(finger) for finger in fingers]
        self._sweeps = SampleSweeps(len(sensors), SEQUENCES[sequence], counters, rows)

    @property
    def period_ns(self) -> int | None:
        """Time between sweeps, ns, as measured; None until it is known."""
        return self._sweeps.period_ns

    @property
    def expected_ns(self) -> int | None:
        """When the next reading should be complete, monotonic ns; None while not known."""
        return self._sweeps.expected_ns

    @property
    def arbitration_id(self) -> int | None:
        """The configured id, or the first heard with a sound sample since the link broke."""
        return self._id

    def push(
        self, frame: CanFrame, t_ns: int, until_ns: int | None = None
    ) -> Sequence[TactileReading]:
        """Take a data frame received at `t_ns`; the readings that it completes, oldest first."""
        identifier = self._id
        if identifier is not None and (
            frame.arbitration_id != identifier or frame.flags & EXTENDED != self._flags
        ):
            self._counters.foreign_frames += 1
            return ()
        if frame.flags & FD:
            _count_reject(self._counters, Reject.CONTENT, identifier)
            return ()
        sample = parse_sample(frame.data, self._sensors, self._length)
        if isinstance(sample, Reject):
            _count_reject(self._counters, sample, identifier)
            return ()
        if identifier is None:
            if not _is_sound(sample.words):
                self._counters.foreign_frames += 1
                return ()
            self._id, self._flags = frame.arbitration_id, frame.flags & EXTENDED
        self._counters.accepted_frames += 1
        return self._sweeps.push(sample.channel, sample.words, t_ns, until_ns)

    def cut(self) -> Sequence[TactileReading]:
        """Frames were lost here: the sweep at hand ends."""
        return self._sweeps.cut()

    def interrupt(self) -> None:
        """The link broke: what comes next may be another board."""
        self._sweeps.interrupt()
        if not self._configured:
            self._id = None


class SweepFrameDecoder:
    """graspd's own frames, one per finger and sweep."""

    def __init__(self, fingers: Sequence[str], base_id: int | None, counters: CanCounters) -> None:
        self._rows = {FINGERS.index(finger): row for row, finger in enumerate(fingers)}
        self._base = base_id
        self._flags = _id_flags(None if base_id is None else base_id + len(FINGERS) - 1)
        if base_id is not None and _id_flags(base_id) != self._flags:
            raise ValueError(f"arbitration_id {base_id:#x}: the fingers' ids are of two kinds")
        self._counters = counters
        self._sweeps = FrameSweeps(len(fingers), counters, list(self._rows))
        self._ticks: dict[int, tuple[int, int]] = {}

    @property
    def period_ns(self) -> int | None:
        """Time between sweeps, ns, as measured; None until it is known."""
        return self._sweeps.period_ns

    @property
    def expected_ns(self) -> int | None:
        """None: three frames a sweep are no reason to rest."""
        return None

    @property
    def arbitration_id(self) -> int | None:
        """That of finger 0."""
        return self._base

    def push(
        self, frame: CanFrame, t_ns: int, until_ns: int | None = None
    ) -> Sequence[TactileReading]:
        """Take a data frame received at `t_ns`; the readings that it completes, oldest first."""
        base, counters = self._base, self._counters
        expected: int | None = None
        if base is not None:
            expected = frame.arbitration_id - base
            if expected not in self._rows or frame.flags & EXTENDED != self._flags:
                counters.foreign_frames += 1
                return ()
        sweep = parse_sweep(frame.data) if frame.flags & FD else Reject.CONTENT
        if isinstance(sweep, Reject):
            _count_reject(counters, sweep, base)
            return ()
        row = self._rows.get(sweep.finger)
        if row is None or (expected is not None and sweep.finger != expected):
            _count_reject(counters, Reject.CONTENT, base)
            return ()
        counters.accepted_frames += 1
        stands = self._tick_stands(sweep.finger, sweep.sequence, sweep.tick_us)
        counters.overruns += bool(sweep.status & _OVERRUN)
        faults = _MISSING if sweep.status & _ABSENT else 0
        faults |= _HELD if stands or sweep.status & _REPEATED else 0
        return self._sweeps.push(row, sweep.sequence, sweep.tick_us, sweep.words, faults, t_ns)

    def cut(self) -> Sequence[TactileReading]:
        """Nothing: sweep frames are numbered, so a loss shows by itself."""
        return ()

    def interrupt(self) -> None:
        """The link broke."""
        self._sweeps.interrupt()

    def _tick_stands(self, finger: int, sequence: int, tick_us: int) -> bool:
        """Whether another sweep of a finger has ended at the same time: nothing was sampled."""
        before = self._ticks.get(finger)
        stands = before is not None and before[1] == tick_us and before[0] != sequence
        self._counters.stuck_ticks += stands
        self._ticks[finger] = (sequence, tick_us)
        return stands


def _is_sound(words: bytes) -> bool:
    """Whether some word is a count, and every other one that of a sensor that is not there."""
    _, faults = decode_words(np.frombuffer(words, dtype=">u2").astype(np.uint16))
    return not (faults & ~np.uint8(_MISSING)).any() and not faults.all()


def _id_flags(identifier: int | None) -> int:
    """Ids above 0x7FF have 29 bits, the others 11."""
    if identifier is None or identifier <= STANDARD_ID_MAX:
        return 0
    return EXTENDED


_COUNTER_OF: Final = {
    Reject.LENGTH: "wrong_length_frames",
    Reject.COMMAND: "unknown_commands",
    Reject.VERSION: "unknown_versions",
    Reject.CONTENT: "malformed_frames",
}


def _count_reject(counters: CanCounters, reject: Reject, identifier: int | None) -> None:
    """Count by kind; without a configured id nobody knows whether the frame was meant for us."""
    name = "foreign_frames" if identifier is None else _COUNTER_OF[reject]
    setattr(counters, name, getattr(counters, name) + 1)
