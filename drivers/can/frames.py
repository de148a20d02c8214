"""CAN frames, the structs of linux/can.h and linux/can/error.h, and the samples in their data.

SynTouch's board sends one classic frame per sample: the command byte, then each sensor's response
word (`graspd.drivers.biotac`). Source: the public driver `clearpathrobotics/numatac_can_driver`
(`numatac_can_driver.cpp`, `bt_can.h`). Arbitration id and frame length are not public, so the scene
gives them. `deploy/can/PROTOCOL.md` and `deploy/can/graspd.dbc` describe the frame.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from typing import Final

import msgspec

from graspd.drivers.base import DriverCounters
from graspd.drivers.biotac import sample_command

STANDARD_ID_MAX: Final = 0x7FF
EXTENDED_ID_MAX: Final = 0x1FFFFFFF
CLASSIC_DATA_MAX: Final = 8
WORD_BYTES: Final = 2

EFF_FLAG: Final = 0x80000000
RTR_FLAG: Final = 0x40000000
ERR_FLAG: Final = 0x20000000
CAN_FRAME: Final = struct.Struct("=IB3x8s")
"""`struct can_frame`: id with flags, length, padding, data. 16 bytes, native byte order."""

ERROR_CONTROLLER: Final = 0x004
ERROR_BUS_OFF: Final = 0x040
CONTROLLER_RX_OVERFLOW: Final = 0x01
_ERROR_CLASSES: Final = {
    0x001: "transmit timeout",
    0x002: "lost arbitration",
    0x004: "controller problem",
    0x008: "protocol violation",
    0x010: "transceiver problem",
    0x020: "no acknowledgement",
    0x040: "bus-off",
    0x080: "bus error",
    0x100: "controller restarted",
    0x200: "error counters",
}


# Flags of a frame; 0 is a classic data frame with an 11-bit id. They are plain integers, because an
# IntFlag costs a microsecond per operation.
EXTENDED: Final = 1
"""29-bit arbitration id."""
REMOTE: Final = 2
ERROR: Final = 4
"""Error frame, made by the controller: the id holds error classes."""
LOST: Final = 8
"""Marker instead of a frame: frames were lost here."""


class CanFrame(msgspec.Struct, frozen=True, gc=False):
    """One frame from a bus."""

    arbitration_id: int
    """Id without the flag bits of Linux; the error classes of an error frame."""
    data: bytes
    flags: int = 0
    """Sum of `EXTENDED`, `REMOTE`, `ERROR` and `LOST`."""


Stamped = tuple[CanFrame, int, int]
"""A frame or the marker `LOST`, and the two monotonic times, ns, between which it arrived."""


@dataclass(slots=True)
class CanCounters(DriverCounters):
    """Counters of frames, sweeps and the bus."""

    lost_frames: int = 0
    """Frames that never arrived, although other frames of their sweep did."""
    duplicate_frames: int = 0
    reordered_frames: int = 0
    """Frames that arrived in time for their sweep, but after a later frame."""
    late_frames: int = 0
    """Frames that arrived when their sweep was over; dropped."""
    unsynchronised_frames: int = 0
    """Frames dropped after opening or a known loss, until a sweep began."""
    untimed_frames: int = 0
    """Samples dropped because the loop stalled and the bus has no stamps."""
    unexpected_channels: int = 0
    """Samples of a channel that the configured sequence does not have."""
    interrupted_sweeps: int = 0
    """Sweeps dropped because the link broke in the middle."""
    cut_sweeps: int = 0
    """Sweeps ended in the middle because frames were known to be lost there."""
    parity_words: int = 0
    error_words: int = 0
    unplugged_words: int = 0
    """Response words read from a line that no sensor drives."""
    frames: int = 0
    accepted_frames: int = 0
    """Samples of the configured sensors, duplicates included."""
    foreign_frames: int = 0
    """Frames with another arbitration id. While the id is unknown: all but a sound sample."""
    remote_frames: int = 0
    error_frames: int = 0
    """Frames in which the controller reports trouble on the bus."""
    wrong_length_frames: int = 0
    unknown_commands: int = 0
    """Frames with the right id whose first byte is not a command that samples a channel."""
    malformed_frames: int = 0
    """Received records that are not a classic frame, such as a CAN FD frame of another device."""
    controller_overflows: int = 0
    """Error frames that say that the controller's receive buffer overflowed."""
    kernel_drops: int = 0
    """Frames that the kernel dropped because a socket was full (socketcan, udp_multicast)."""
    bus_off: int = 0
    bus_faults: int = 0
    """Failures of the bus or of python-can, also when opening it."""
    link_losses: int = 0


def unpack_frame(raw: bytes) -> CanFrame | None:
    """Return the frame in a `can_frame`; None if it is malformed."""
    if len(raw) != CAN_FRAME.size:
        return None
    word, length, data = CAN_FRAME.unpack(raw)
    if length > CLASSIC_DATA_MAX:
        return None
    if word & ERR_FLAG:
        return CanFrame(word & EXTENDED_ID_MAX, data[:length], ERROR)
    flags = 0
    if word & RTR_FLAG:
        flags, data = REMOTE, b""
    if word & EFF_FLAG:
        return CanFrame(word & EXTENDED_ID_MAX, data[:length], flags | EXTENDED)
    return CanFrame(word & STANDARD_ID_MAX, data[:length], flags)


def is_bus_off(frame: CanFrame) -> bool:
    """Return True if an error frame says that the controller left the bus."""
    return bool(frame.flags & ERROR and frame.arbitration_id & ERROR_BUS_OFF)


def is_overflow(frame: CanFrame) -> bool:
    """Return True if an error frame says that the controller's receive buffer overflowed."""
    if not (frame.flags & ERROR and frame.arbitration_id & ERROR_CONTROLLER):
        return False
    return len(frame.data) > 1 and bool(frame.data[1] & CONTROLLER_RX_OVERFLOW)


def describe_error(frame: CanFrame) -> str:
    """Return the error classes of an error frame in words."""
    names = [name for bit, name in _ERROR_CLASSES.items() if frame.arbitration_id & bit]
    return ", ".join(names) or "unknown error class"


def encode_sample(channel: int, words: bytes) -> bytes:
    """Return the data of a frame: the command that samples `channel`, then the response `words`.
    Raises `ValueError` for an unknown channel."""
    return bytes((sample_command(channel),)) + words


def sample_length(sensors: int, length: int | None) -> int:
    """Return the number of data bytes of a frame with the samples of `sensors` fingers.

    `length`: length set in the scene, bytes; None: just long enough. Raises `ValueError` for a
    length that is too short, or over `CLASSIC_DATA_MAX`.
    """
    used = 1 + WORD_BYTES * sensors
    length = length or used
    if not used <= length <= CLASSIC_DATA_MAX:
        raise ValueError(f"frames of {length} bytes cannot carry {sensors} sensors' samples")
    return length
