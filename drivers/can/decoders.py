"""CAN frames in, readings out: one decoder per format. No I/O; what a bus brings never raises."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence

import numpy as np

from drivers.base import FINGERS, ElectrodeFault, TactileReading, check_fingers, sensor_rows
from drivers.biotac import SEQUENCES, decode_words
from drivers.can.formats import (
    SWEEP_BASE_ID,
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
from drivers.can.readings import CanCounters
from drivers.can.samples import SampleAssembler
from drivers.can.sweep_frames import FrameAssembler

_ABSENT, _REPEATED, _OVERRUN = (
    int(SweepStatus.ABSENT),
    int(SweepStatus.REPEATED),
    int(SweepStatus.OVERRUN),
)
_MISSING, _HELD = int(ElectrodeFault.MISSING), int(ElectrodeFault.HELD)


class CanDecoder(ABC):
    """Turns the data frames of one format into readings."""

    arbitration_id: int | None
    """Id of the frames that are taken, of finger 0 if each has its own; None: any id."""

    def __init__(self, assembler: SampleAssembler | FrameAssembler, counters: CanCounters) -> None:
        self._assembler = assembler
        self._counters = counters

    @property
    def period_ns(self) -> int | None:
        """Time between readings, ns, as measured; None until it is known."""
        return self._assembler.period_ns

    @property
    def expected_ns(self) -> int | None:
        """When the next reading should be complete, monotonic ns, where many frames make one."""
        return None

    @abstractmethod
    def push(
        self, frame: CanFrame, t_ns: int, until_ns: int | None = None
    ) -> Sequence[TactileReading]:
        """Take a data frame received at `t_ns`; the readings that it completes, oldest first.

        With `until_ns` it was received at any time between the two.
        """

    def cut(self) -> Sequence[TactileReading]:
        """Return the readings that end because frames were lost here.

        There are none where frames are numbered: there a loss shows by itself.
        """
        return ()

    def interrupt(self) -> None:
        """The link broke."""
        self._assembler.interrupt()


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
    check_fingers(fingers)
    if arbitration_id is not None and not 0 <= arbitration_id <= EXTENDED_ID_MAX:
        raise ValueError(f"arbitration_id {arbitration_id} is not in 0..{EXTENDED_ID_MAX:#x}")
    if frame_format is CanFormat.SYNTOUCH:
        return SynTouchDecoder(fingers, sensors, arbitration_id, sequence, data_length, counters)
    if sensors is not None:
        raise ValueError("sensors is for the format syntouch; sweep frames say whose they are")
    if data_length is not None:
        raise ValueError("data_length is for the format syntouch; sweep frames have 64 bytes")
    base_id = SWEEP_BASE_ID if arbitration_id is None else arbitration_id
    return SweepFrameDecoder(fingers, base_id, counters)


class SynTouchDecoder(CanDecoder):
    """Samples of SynTouch's board, one frame each.

    Without a configured id it is that of the first sound sample since the link broke.
    """

    _assembler: SampleAssembler

    def __init__(
        self,
        fingers: Sequence[str],
        sensors: Sequence[str] | None,
        arbitration_id: int | None,
        sequence: str,
        data_length: int | None,
        counters: CanCounters,
    ) -> None:
        if sequence not in SEQUENCES:
            raise ValueError(f"sequence {sequence!r} is none of {sorted(SEQUENCES)}")
        rows = sensor_rows(fingers, sensors)
        self._sensors = len(fingers if sensors is None else sensors)
        self._length = sample_length(self._sensors, data_length)
        self._configured = arbitration_id is not None
        self.arbitration_id = arbitration_id
        self._flags = _id_flags(arbitration_id)
        super().__init__(
            SampleAssembler(self._sensors, SEQUENCES[sequence], counters, rows), counters
        )

    @property
    def expected_ns(self) -> int | None:
        """When the next reading should be complete, monotonic ns; None while not known."""
        return self._assembler.expected_ns

    def push(
        self, frame: CanFrame, t_ns: int, until_ns: int | None = None
    ) -> Sequence[TactileReading]:
        """Take a data frame received at `t_ns`; the readings that it completes, oldest first."""
        identifier = self.arbitration_id
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
            self.arbitration_id, self._flags = frame.arbitration_id, frame.flags & EXTENDED
        self._counters.accepted_frames += 1
        return self._assembler.push(sample.channel, sample.words, t_ns, until_ns)

    def cut(self) -> Sequence[TactileReading]:
        """Frames were lost here: the sweep at hand ends."""
        return self._assembler.cut()

    def interrupt(self) -> None:
        """The link broke: what comes next may be another board."""
        super().interrupt()
        if not self._configured:
            self.arbitration_id = None


class SweepFrameDecoder(CanDecoder):
    """graspd's own frames, one per finger and sweep; three a sweep are no reason to rest."""

    _assembler: FrameAssembler

    def __init__(self, fingers: Sequence[str], base_id: int, counters: CanCounters) -> None:
        self._rows = {FINGERS.index(finger): row for row, finger in enumerate(fingers)}
        self._base_id = self.arbitration_id = base_id
        self._flags = _id_flags(base_id + len(FINGERS) - 1)
        if _id_flags(base_id) != self._flags:
            raise ValueError(f"arbitration_id {base_id:#x}: the fingers' ids are of two kinds")
        self._ticks: dict[int, tuple[int, int]] = {}
        super().__init__(FrameAssembler(len(fingers), counters, list(self._rows)), counters)

    def push(
        self, frame: CanFrame, t_ns: int, until_ns: int | None = None
    ) -> Sequence[TactileReading]:
        """Take a data frame received at `t_ns`; the readings that it completes, oldest first."""
        base, counters = self._base_id, self._counters
        finger = frame.arbitration_id - base
        if finger not in self._rows or frame.flags & EXTENDED != self._flags:
            counters.foreign_frames += 1
            return ()
        sweep = parse_sweep(frame.data) if frame.flags & FD else Reject.CONTENT
        if isinstance(sweep, Reject):
            _count_reject(counters, sweep, base)
            return ()
        if sweep.finger != finger:
            _count_reject(counters, Reject.CONTENT, base)
            return ()
        counters.accepted_frames += 1
        stands = self._tick_stands(finger, sweep.sequence, sweep.tick_us)
        counters.overruns += bool(sweep.status & _OVERRUN)
        faults = _MISSING if sweep.status & _ABSENT else 0
        faults |= _HELD if stands or sweep.status & _REPEATED else 0
        row = self._rows[finger]
        return self._assembler.push(row, sweep.sequence, sweep.tick_us, sweep.words, faults, t_ns)

    def _tick_stands(self, finger: int, sequence: int, tick_us: int) -> bool:
        """Return True if another sweep of a finger ended at the same time: nothing was sampled."""
        before = self._ticks.get(finger)
        stands = before is not None and before[1] == tick_us and before[0] != sequence
        self._counters.stuck_ticks += stands
        self._ticks[finger] = (sequence, tick_us)
        return stands


def _is_sound(words: bytes) -> bool:
    """Return True if some word is a count, and every other one that of an absent sensor."""
    _, faults = decode_words(np.frombuffer(words, dtype=">u2"))
    return not (faults & ~np.uint8(_MISSING)).any() and not faults.all()


def _id_flags(identifier: int | None) -> int:
    """Ids above 0x7FF have 29 bits, the others 11."""
    if identifier is None or identifier <= STANDARD_ID_MAX:
        return 0
    return EXTENDED


def _count_reject(counters: CanCounters, reject: Reject, identifier: int | None) -> None:
    """Count by kind; without a known id the frame may have been meant for others."""
    name = "foreign_frames" if identifier is None else reject.value
    setattr(counters, name, getattr(counters, name) + 1)
