"""CAN frames, and the structs of linux/can.h and linux/can/error.h. Bytes only."""

from __future__ import annotations

import struct
from typing import Final

import msgspec

STANDARD_ID_MAX: Final = 0x7FF
EXTENDED_ID_MAX: Final = 0x1FFFFFFF
CLASSIC_DATA_MAX: Final = 8
FD_DATA_MAX: Final = 64

EFF_FLAG: Final = 0x80000000
RTR_FLAG: Final = 0x40000000
ERR_FLAG: Final = 0x20000000
CAN_FRAME: Final = struct.Struct("=IB3x8s")
"""`struct can_frame`: id with flags, length, padding, data. 16 bytes, native byte order."""
CANFD_FRAME: Final = struct.Struct("=IBB2x64s")
"""`struct canfd_frame`: id with flags, length, FD flags, padding, data. 72 bytes."""

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
FD: Final = 8
LOST: Final = 16
"""Marker instead of a frame: frames were lost here."""


class CanFrame(msgspec.Struct, frozen=True, gc=False):
    """One frame from a bus."""

    arbitration_id: int
    """Id without the flag bits of Linux; the error classes of an error frame."""
    data: bytes
    flags: int = 0
    """Sum of `EXTENDED`, `REMOTE`, `ERROR`, `FD` and `LOST`."""


Stamped = tuple[CanFrame, int, int]
"""A frame or the marker `LOST`, and the two monotonic times, ns, between which it arrived."""


def unpack_frame(raw: bytes) -> CanFrame | None:
    """Return the frame in a `can_frame` or `canfd_frame`; None if it is malformed."""
    if len(raw) == CAN_FRAME.size:
        word, length, data = CAN_FRAME.unpack(raw)
        longest, flags = CLASSIC_DATA_MAX, 0
    elif len(raw) == CANFD_FRAME.size:
        word, length, _fd_flags, data = CANFD_FRAME.unpack(raw)
        longest, flags = FD_DATA_MAX, FD
    else:
        return None
    if length > longest:
        return None
    if word & ERR_FLAG:
        return CanFrame(word & EXTENDED_ID_MAX, data[:length], flags | ERROR)
    if word & RTR_FLAG:
        flags |= REMOTE
        data = b""
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
