"""Kernel stamps of a received datagram or frame: time of arrival, and number of drops."""

from __future__ import annotations

import socket
import struct
from typing import Final

SO_TIMESTAMPNS: Final = 35
"""Linux option to stamp arrivals, missing in Python's `socket` (asm-generic/socket.h)."""
SO_RXQ_OVFL: Final = 40
"""Linux option to count drops, missing in Python's `socket` (asm-generic/socket.h)."""
TIMESPEC: Final = struct.Struct("@ll")
"""Ancillary data of `SO_TIMESTAMPNS`: wall time, seconds and ns."""
DROPS: Final = struct.Struct("@I")
"""Ancillary data of `SO_RXQ_OVFL`: drops since the socket was opened, modulo 2**32."""
ANCILLARY_BYTES: Final = socket.CMSG_SPACE(TIMESPEC.size) + socket.CMSG_SPACE(DROPS.size)


def read_stamps(ancillary: list[tuple[int, int, bytes]]) -> tuple[int | None, int | None]:
    """Return wall time of arrival, ns, and drops since the socket was opened; None if absent."""
    wall_ns = drops = None
    for level, kind, data in ancillary:
        if level != socket.SOL_SOCKET:
            continue
        if kind == SO_TIMESTAMPNS and len(data) == TIMESPEC.size:
            seconds, rest_ns = TIMESPEC.unpack(data)
            wall_ns = seconds * 1_000_000_000 + rest_ns
        elif kind == SO_RXQ_OVFL and len(data) == DROPS.size:
            (drops,) = DROPS.unpack(data)
    return wall_ns, drops
