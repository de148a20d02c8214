"""The two formats of a CAN frame's data: SynTouch's samples, and graspd's sweep frames.

SynTouch's board sends one classic frame per sample: the command byte, then each sensor's response
word (`graspd.drivers.biotac`). Source: the public driver `clearpathrobotics/numatac_can_driver`
(`numatac_can_driver.cpp`, `bt_can.h`). Arbitration id and frame length are not public, so the scene
gives them. The sweep frame is graspd's own: one CAN FD frame per finger and sweep.
`deploy/can/PROTOCOL.md` and `deploy/can/graspd.dbc` describe both.

A new format needs a member of `CanFormat`, a decoder in `stream.make_decoder`, a name in
`daemon/scene/drivers.py`, a twin that sends it, and a description on the two pages above.
"""

from __future__ import annotations

import struct
from enum import IntFlag, StrEnum
from typing import Final

import msgspec

from graspd.drivers.base import ELECTRODES
from graspd.drivers.biotac import channel_of, sample_command
from graspd.drivers.can.frames import CLASSIC_DATA_MAX, FD_DATA_MAX

WORD_BYTES: Final = 2

SWEEP_VERSION: Final = 1
"""Version of the sweep frame's layout; raise it with each change of meaning."""
SWEEP_BASE_ID: Final = 0x5B0
"""Default arbitration id of finger 0; finger i has this id + i."""
_SWEEP_HEAD: Final = struct.Struct("<BBHI")
_SWEEP_STATUS: Final = struct.Struct("<H")
_STATUS_AT: Final = _SWEEP_HEAD.size + ELECTRODES * WORD_BYTES
_RESERVED_AT: Final = _STATUS_AT + _SWEEP_STATUS.size
_RESERVED: Final = bytes(FD_DATA_MAX - _RESERVED_AT)


class CanFormat(StrEnum):
    """Format of the frames on a bus."""

    SYNTOUCH = "syntouch"
    """SynTouch's board: one classic frame per sample."""
    SWEEP_FD = "sweep_fd"
    """graspd's own: one CAN FD frame per finger and sweep."""


class Reject(StrEnum):
    """Reason why a frame is not of the format; the values are names of `CanCounters`."""

    LENGTH = "wrong_length_frames"
    COMMAND = "unknown_commands"
    VERSION = "unknown_versions"
    CONTENT = "malformed_frames"


class SweepStatus(IntFlag):
    """Status bits of a sweep frame. All other bits are reserved and zero."""

    NONE = 0
    ABSENT = 1
    """The sensor did not answer when it was last asked; its words mean nothing."""
    REPEATED = 2
    """The words are those of an earlier sweep; nothing new was sampled."""
    OVERRUN = 4
    """The sweep began late, because the sweep before took longer than the period."""


_STATUS_BITS: Final = int(SweepStatus.ABSENT | SweepStatus.REPEATED | SweepStatus.OVERRUN)


class SweepFrame(msgspec.Struct, frozen=True, gc=False):
    """All electrodes of one finger, sampled in one sweep."""

    finger: int
    """Index in `graspd.drivers.base.FINGERS`: 0 ff, 1 mf, 2 rf, 3 lf, 4 th."""
    sequence: int
    """Number of the device's sweep, the same for all fingers, modulo 65536."""
    tick_us: int
    """End of the sweep by the device's clock, microseconds, modulo 2**32."""
    words: bytes
    """Response words of E1 to E24, 48 bytes, first byte on the SPI wire first."""
    status: int = 0

    def to_bytes(self) -> bytes:
        head = _SWEEP_HEAD.pack(SWEEP_VERSION, self.finger, self.sequence, self.tick_us)
        return head + self.words + _SWEEP_STATUS.pack(self.status) + _RESERVED


def encode_sample(channel: int, words: bytes) -> bytes:
    """Return the data of a SynTouch frame. Raises `ValueError` for an unknown channel."""
    return bytes((sample_command(channel),)) + words


def parse_sample(data: bytes, sensors: int, length: int) -> tuple[int, bytes] | Reject:
    """Return channel and response words of a frame of `length` bytes, padding included."""
    if len(data) != length:
        return Reject.LENGTH
    channel = channel_of(data[0])
    if channel is None:
        return Reject.COMMAND
    return channel, data[1 : 1 + WORD_BYTES * sensors]


def parse_sweep(data: bytes) -> SweepFrame | Reject:
    """Return the sweep frame in the data of a CAN FD frame, or why it is refused."""
    if len(data) != FD_DATA_MAX:
        return Reject.LENGTH
    version, finger, sequence, tick_us = _SWEEP_HEAD.unpack_from(data)
    if version != SWEEP_VERSION:
        return Reject.VERSION
    (status,) = _SWEEP_STATUS.unpack_from(data, _STATUS_AT)
    if status & ~_STATUS_BITS or data[_RESERVED_AT:] != _RESERVED:
        return Reject.CONTENT
    return SweepFrame(finger, sequence, tick_us, data[_SWEEP_HEAD.size : _STATUS_AT], status)


def sample_length(sensors: int, length: int | None) -> int:
    """Return the number of data bytes of a SynTouch frame with the samples of `sensors` fingers.

    `length`: length set in the scene, bytes; None: just long enough. Raises `ValueError` for a
    length that is too short, or over `CLASSIC_DATA_MAX`.
    """
    used = 1 + WORD_BYTES * sensors
    length = length or used
    if not used <= length <= CLASSIC_DATA_MAX:
        raise ValueError(f"frames of {length} bytes cannot carry {sensors} sensors' samples")
    return length
