"""Decode the frames of one CAN bus, with their times, into readings. No I/O; no frame raises."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final, TypedDict, Unpack

import numpy as np

from graspd.drivers.base import (
    FINGERS,
    DeviceFault,
    ElectrodeFault,
    Fact,
    LinkCause,
    LinkError,
    Reading,
    TactileReading,
    sensor_rows,
)
from graspd.drivers.biotac import SEQUENCES, decode_words
from graspd.drivers.can.formats import (
    SWEEP_BASE_ID,
    CanFormat,
    Reject,
    SweepStatus,
    parse_sample,
    parse_sweep,
    sample_length,
)
from graspd.drivers.can.frames import (
    ERROR,
    EXTENDED,
    FD,
    LOST,
    REMOTE,
    STANDARD_ID_MAX,
    CanFrame,
    Stamped,
    describe_error,
    is_bus_off,
    is_overflow,
)
from graspd.drivers.can.readings import CanCounters
from graspd.drivers.can.samples import SampleAssembler
from graspd.drivers.can.sweep_frames import FrameAssembler
from graspd.drivers.link import Link, LinkState, longest_silence_ns

NAME: Final = "can"
_SPECIAL: Final = ERROR | REMOTE | LOST


class CanStream:
    """Decoder of one bus; `link` is up while the configured board sends.

    The owner of the bus calls `link.greeting` when the bus is open, `receive` and then `watch` for
    the frames that arrive, and `lost` when the bus is gone. All times are monotonic ns.
    """

    def __init__(self, bus: str, fingers: Sequence[str], **board: Unpack[BoardOptions]) -> None:
        """`bus`: name of the bus in messages. `fingers` and `board`: see `make_decoder`."""
        self.counters = CanCounters()
        self.link = Link(NAME)
        self.last_error: str | None = None
        """Last failure of the bus or error frame, for people; silence does not count."""
        self._where = f"{bus}, {CanFormat(board.get('format', CanFormat.SYNTOUCH))}"
        self._accepted = 0
        self._silent_at_ns = 0
        self._decoder = make_decoder(fingers, self.counters, **board)

    @property
    def period_ns(self) -> int | None:
        return self._decoder.sweeps.period_ns

    @property
    def expected_ns(self) -> int | None:
        """Time when the next reading should be complete, ns; None: not known or not used."""
        return self._decoder.sweeps.expected_ns

    @property
    def silent_at_ns(self) -> int | None:
        """Time when the link counts as silent, ns; None while it is not up."""
        return self._silent_at_ns if self.link.state is LinkState.UP else None

    def describe(self) -> dict[str, Fact]:
        facts = {"bus": Fact(self._where), **self.link.describe()}
        if self.last_error is not None:
            facts["last error"] = Fact(self.last_error, DeviceFault.BUS_ERROR)
        if self._decoder.arbitration_id is not None:
            facts["arbitration id"] = Fact(f"{self._decoder.arbitration_id:#x}")
        return facts

    def receive(self, frames: Sequence[Stamped]) -> tuple[list[Reading], LinkError | None]:
        """Return the readings that are complete, oldest first, and why the bus is lost."""
        readings: list[Reading] = []
        trouble = None
        for frame, t_ns, until_ns in frames:
            if not frame.flags & _SPECIAL:
                readings += self._decoder.push(frame, t_ns, until_ns)
                continue
            trouble = self._take_special(frame) or trouble
            if frame.flags & LOST or is_overflow(frame):
                readings += self._decoder.sweeps.cut()
        return readings, trouble

    def watch(self, now_ns: int, *, more: bool = False) -> None:
        """Set the link up after the board's first frame, and down after its silence.

        `more`: True if frames still wait in the bus, so that silence is not certain.
        """
        if self.counters.accepted_frames > self._accepted:
            self._accepted = self.counters.accepted_frames
            self._silent_at_ns = now_ns + longest_silence_ns(self.period_ns)
            if self.link.state is LinkState.GREETING:
                self.link.up(self._where, now_ns)
        elif self.link.state is LinkState.UP and now_ns >= self._silent_at_ns and not more:
            silence_ms = longest_silence_ns(self.period_ns) / 1e6
            text = f"nothing from the board for {silence_ms:.0f} ms"
            self._down(LinkError(LinkCause.TIMEOUT, text), now_ns)
            self.link.greeting()

    def lost(self, error: LinkError, now_ns: int) -> None:
        """Call when the bus broke or could not be opened."""
        self.counters.bus_faults += 1
        self.last_error = str(error)
        self._down(error, now_ns)

    def interrupt(self) -> None:
        """Drop the current sweep. Call when the next frames will be missing."""
        self._decoder.interrupt()

    def _down(self, error: LinkError, now_ns: int) -> None:
        self.interrupt()
        self.link.failed(error.cause, f"{self._where}: {error}", now_ns)
        self.counters.link_losses = self.link.losses

    def _take_special(self, frame: CanFrame) -> LinkError | None:
        """Count a remote or error frame; return why the link is lost, if it is."""
        if frame.flags & (REMOTE | LOST):
            self.counters.remote_frames += bool(frame.flags & REMOTE)
            return None
        self.counters.error_frames += 1
        self.counters.controller_overflows += is_overflow(frame)
        self.last_error = describe_error(frame)
        if not is_bus_off(frame):
            return None
        self.counters.bus_off += 1
        return LinkError(LinkCause.BUS_OFF, "bus-off")


class SynTouchDecoder:
    """Decoder of SynTouch's board. Without an id it takes that of the first sound sample."""

    def __init__(
        self,
        fingers: Sequence[str],
        sensors: Sequence[str] | None,
        arbitration_id: int | None,
        sequence: str,
        data_length: int | None,
        counters: CanCounters,
    ) -> None:
        rows = sensor_rows(fingers, sensors)
        self._sensors = len(fingers if sensors is None else sensors)
        self._length = sample_length(self._sensors, data_length)
        self._configured_id = self.arbitration_id = arbitration_id
        """Id of the frames that are decoded; None: not known yet."""
        self._flags = _id_flags(arbitration_id)
        self._counters = counters
        self.sweeps = SampleAssembler(self._sensors, SEQUENCES[sequence], counters, rows)

    def push(
        self, frame: CanFrame, t_ns: int, until_ns: int | None = None
    ) -> Sequence[TactileReading]:
        """Return the readings that a data frame completes, oldest first.

        It arrived at `t_ns`, or between `t_ns` and `until_ns` if that is given.
        """
        identifier = self.arbitration_id
        if identifier is not None and (
            frame.arbitration_id != identifier or frame.flags & EXTENDED != self._flags
        ):
            self._counters.foreign_frames += 1
            return ()
        sample = parse_sample(frame.data, self._sensors, self._length)
        if frame.flags & FD:
            sample = Reject.CONTENT
        if isinstance(sample, Reject):
            _count_reject(self._counters, sample, identifier)
            return ()
        channel, words = sample
        if identifier is None:
            if not _is_sound(words):
                self._counters.foreign_frames += 1
                return ()
            self.arbitration_id, self._flags = frame.arbitration_id, frame.flags & EXTENDED
        self._counters.accepted_frames += 1
        return self.sweeps.push(channel, words, t_ns, until_ns)

    def interrupt(self) -> None:
        """Drop the current sweep. Another board may come next."""
        self.sweeps.interrupt()
        self.arbitration_id = self._configured_id


class SweepFrameDecoder:
    """Decoder of graspd's own format: one frame per finger and sweep."""

    def __init__(self, fingers: Sequence[str], base_id: int, counters: CanCounters) -> None:
        self._rows = {FINGERS.index(finger): row for row, finger in enumerate(fingers)}
        self.arbitration_id = base_id
        """Id of the frames of finger 0."""
        self._flags = _id_flags(base_id + len(FINGERS) - 1)
        if _id_flags(base_id) != self._flags:
            raise ValueError(f"arbitration_id {base_id:#x}: the fingers' ids are of two kinds")
        self._ticks: dict[int, tuple[int, int]] = {}
        self._counters = counters
        self.sweeps = FrameAssembler(list(self._rows), counters)

    def push(
        self, frame: CanFrame, t_ns: int, _until_ns: int | None = None
    ) -> Sequence[TactileReading]:
        base_id, counters = self.arbitration_id, self._counters
        finger = frame.arbitration_id - base_id
        if finger not in self._rows or frame.flags & EXTENDED != self._flags:
            counters.foreign_frames += 1
            return ()
        sweep = parse_sweep(frame.data) if frame.flags & FD else Reject.CONTENT
        if not isinstance(sweep, Reject) and sweep.finger != finger:
            sweep = Reject.CONTENT
        if isinstance(sweep, Reject):
            _count_reject(counters, sweep, base_id)
            return ()
        counters.accepted_frames += 1
        stands = self._tick_stands(finger, sweep.sequence, sweep.tick_us)
        counters.overruns += bool(sweep.status & SweepStatus.OVERRUN)
        faults = ElectrodeFault.NONE
        if sweep.status & SweepStatus.ABSENT:
            faults |= ElectrodeFault.MISSING
        if stands or sweep.status & SweepStatus.REPEATED:
            faults |= ElectrodeFault.HELD
        row = self._rows[finger]
        return self.sweeps.push(row, sweep.sequence, sweep.tick_us, sweep.words, faults, t_ns)

    def interrupt(self) -> None:
        self.sweeps.interrupt()

    def _tick_stands(self, finger: int, sequence: int, tick_us: int) -> bool:
        """Return True if the sweep before ended at the same tick: nothing was sampled."""
        before = self._ticks.get(finger)
        stands = before is not None and before[1] == tick_us and before[0] != sequence
        self._counters.stuck_ticks += stands
        self._ticks[finger] = (sequence, tick_us)
        return stands


CanDecoder = SynTouchDecoder | SweepFrameDecoder


class BoardOptions(TypedDict, total=False):
    """Options of `make_decoder` that describe a board."""

    sensors: Sequence[str] | None
    format: str
    arbitration_id: int | None
    sequence: str
    data_length: int | None


def make_decoder(
    fingers: Sequence[str],
    counters: CanCounters,
    *,
    sensors: Sequence[str] | None = None,
    format: str = CanFormat.SYNTOUCH,  # noqa: A002 (the key of the scene)
    arbitration_id: int | None = None,
    sequence: str = "interleaved",
    data_length: int | None = None,
) -> CanDecoder:
    """Return the decoder of a `CanFormat`. Raises `ValueError` for options that do not fit it.

    `fingers`: the rows of a reading. `arbitration_id`: id of the samples, or of finger 0 (`ff`) of
    the sweep frames (default 0x5B0); ids above 0x7FF have 29 bits. A decoder of samples without one
    takes the id of the first sound sample until the link is lost; use that for bring-up only.

    For `syntouch` only: `sensors`, the fingers in the order of the board's words, three at most, by
    default `fingers`; `sequence`, a key of `graspd.drivers.biotac.SEQUENCES`; `data_length`, bytes
    of a frame that the board pads.
    """
    if CanFormat(format) is CanFormat.SYNTOUCH:
        return SynTouchDecoder(fingers, sensors, arbitration_id, sequence, data_length, counters)
    if data_length is not None:
        raise ValueError("data_length is for the format syntouch; sweep frames have 64 bytes")
    base_id = SWEEP_BASE_ID if arbitration_id is None else arbitration_id
    return SweepFrameDecoder(fingers, base_id, counters)


def _is_sound(words: bytes) -> bool:
    """Return True if at least one word is a count and all others are of absent sensors."""
    _, faults = decode_words(np.frombuffer(words, dtype=">u2"))
    return not (faults & ~np.uint8(ElectrodeFault.MISSING)).any() and not faults.all()


def _id_flags(identifier: int | None) -> int:
    if identifier is None or identifier <= STANDARD_ID_MAX:
        return 0
    return EXTENDED


def _count_reject(counters: CanCounters, reject: Reject, identifier: int | None) -> None:
    """Count a refused frame by its kind; as foreign while the id is not known."""
    name = "foreign_frames" if identifier is None else reject.value
    setattr(counters, name, getattr(counters, name) + 1)
