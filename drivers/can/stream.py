"""Decode the frames of one CAN bus, with their times, into readings. No I/O; no frame raises."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final, TypedDict

import numpy as np

from graspd.biotac import ELECTRODES
from graspd.drivers.base import (
    DeviceFault,
    ElectrodeFault,
    Fact,
    LinkCause,
    LinkError,
    Reading,
    TactileReading,
    sensor_rows,
)
from graspd.drivers.biotac import SEQUENCES, channel_of, decode_words
from graspd.drivers.can.frames import (
    ERROR,
    EXTENDED,
    LOST,
    REMOTE,
    STANDARD_ID_MAX,
    CanCounters,
    CanFrame,
    Stamped,
    describe_error,
    is_bus_off,
    is_overflow,
    sample_length,
)
from graspd.drivers.can.samples import SampleAssembler
from graspd.drivers.link import Link, LinkState, longest_silence_ns

NAME: Final = "can"
_SPECIAL: Final = ERROR | REMOTE | LOST


READINGS_MIN: Final = 20
"""Number of readings from which on the board's sequence is compared with the configured one."""


class BoardOptions(TypedDict, total=False):
    """Options of `CanStream` that describe a board."""

    sensors: Sequence[str] | None
    arbitration_id: int | None
    sequence: str
    data_length: int | None


class CanStream:
    """Decoder of one bus; `link` is up while the configured board sends.

    The owner of the bus calls `link.greeting` when the bus is open, `receive` and then `watch` for
    the frames that arrive, and `lost` when the bus is gone. All times are monotonic ns.
    """

    def __init__(
        self,
        bus: str,
        fingers: Sequence[str],
        *,
        sensors: Sequence[str] | None = None,
        arbitration_id: int | None = None,
        sequence: str = "interleaved",
        data_length: int | None = None,
    ) -> None:
        """`bus`: name of the bus in messages. Raises `ValueError` for options that do not fit.

        `fingers`: the rows of a reading. `sensors`: the fingers in the order of the board's words,
        three at most; None: `fingers`. `arbitration_id`: above 0x7FF it has 29 bits. None: take the
        id of the first sound sample, until the link is lost; for bring-up only. `sequence`: a
        key of `SEQUENCES`. `data_length`: bytes of a frame; None: the board does not pad them.
        """
        self.counters = CanCounters()
        self.link = Link(NAME)
        self.last_error: str | None = None
        """Text of the last failure of the bus or error frame, not of silence; None: none yet."""
        self._where, self._sequence = bus, sequence
        self._accepted = 0
        self._silent_at_ns = 0
        rows = sensor_rows(fingers, sensors)
        count = len(fingers if sensors is None else sensors)
        self._length = sample_length(count, data_length)
        self._words_end = sample_length(count, None)
        self._configured_id = self.arbitration_id = arbitration_id
        """Id of the frames that are decoded; None: not known yet."""
        self._flags = 0 if (arbitration_id or 0) <= STANDARD_ID_MAX else EXTENDED
        self._sweeps = SampleAssembler(count, SEQUENCES[sequence], self.counters, rows)

    @property
    def period_ns(self) -> int | None:
        return self._sweeps.period_ns

    @property
    def expected_ns(self) -> int | None:
        """Time when the next reading should be complete, ns; None: not known yet."""
        return self._sweeps.expected_ns

    @property
    def silent_at_ns(self) -> int | None:
        """Time when the link counts as silent, ns; None while it is not up."""
        return self._silent_at_ns if self.link.state is LinkState.UP else None

    def describe(self) -> dict[str, Fact]:
        facts = {"bus": Fact(self._where), **self.link.describe()}
        if self.last_error is not None:
            facts["last error"] = Fact(self.last_error, DeviceFault.BUS_ERROR)
        if not self._has_sequence():
            text = f"is not {self._sequence}, as the scene says"
            facts["sequence"] = Fact(text, DeviceFault.SEQUENCE)
        if self.arbitration_id is not None:
            facts["arbitration id"] = Fact(f"{self.arbitration_id:#x}")
        return facts

    def _has_sequence(self) -> bool:
        """Return False if the ratio of other channels' samples to those of electrodes is below 1/4
        or above 4 times that of the sequence; True before `READINGS_MIN`."""
        counters, expected = self.counters, len(SEQUENCES[self._sequence]) - ELECTRODES
        readings = counters.readings
        if readings < READINGS_MIN or not expected:  # other samples count as `unexpected_channels`
            return True
        electrodes = ELECTRODES * readings - counters.lost_frames
        others = counters.accepted_frames - electrodes
        return 0.25 < others / electrodes * ELECTRODES / expected < 4.0

    def receive(self, frames: Sequence[Stamped]) -> tuple[list[Reading], LinkError | None]:
        """Return the completed readings, oldest first, and why the bus is lost; None: it is not."""
        readings: list[Reading] = []
        trouble = None
        self.counters.frames += sum(frame.flags != LOST for frame, _, _ in frames)
        for frame, t_ns, until_ns in frames:
            if not frame.flags & _SPECIAL:
                readings += self.push(frame, t_ns, until_ns)
                continue
            trouble = self._take_special(frame) or trouble
            if frame.flags & LOST or is_overflow(frame):
                readings += self._sweeps.cut()
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
        """Drop the current sweep and set the link down. Call when the bus broke or did not open."""
        self.counters.bus_faults += 1
        self.last_error = str(error)
        self._down(error, now_ns)

    def interrupt(self) -> None:
        """Drop the current sweep and an arbitration id that was learned: the board may change."""
        self._sweeps.interrupt()
        self.arbitration_id = self._configured_id

    def _down(self, error: LinkError, now_ns: int) -> None:
        self.interrupt()
        self.link.failed(error.cause, f"{self._where}: {error}", now_ns)
        self.counters.link_losses = self.link.losses

    def _take_special(self, frame: CanFrame) -> LinkError | None:
        """Count a remote or error frame; return why the link is lost; None: it is not."""
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

    def push(
        self, frame: CanFrame, t_ns: int, until_ns: int | None = None
    ) -> Sequence[TactileReading]:
        """Return the readings that a data frame completes, oldest first.

        It arrived at `t_ns`, or between `t_ns` and `until_ns` if that is given.
        """
        identifier, counters = self.arbitration_id, self.counters
        if identifier is not None and (
            frame.arbitration_id != identifier or frame.flags & EXTENDED != self._flags
        ):
            counters.foreign_frames += 1
            return ()
        fits = len(frame.data) == self._length
        channel = channel_of(frame.data[0]) if fits else None
        words = frame.data[1 : self._words_end]
        if identifier is None:
            if channel is None or not _is_sound(words):
                counters.foreign_frames += 1
                return ()
            self.arbitration_id, self._flags = frame.arbitration_id, frame.flags & EXTENDED
        elif channel is None:
            counters.wrong_length_frames += not fits
            counters.unknown_commands += fits
            return ()
        counters.accepted_frames += 1
        return self._sweeps.push(channel, words, t_ns, until_ns)


def _is_sound(words: bytes) -> bool:
    """Return True if each word is a count or of an absent sensor, and at least one is a count."""
    _, faults = decode_words(np.frombuffer(words, dtype=">u2"))
    return not (faults & ~np.uint8(ElectrodeFault.MISSING)).any() and not faults.all()
