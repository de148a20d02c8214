"""The bytes of a serial line with their times, as they are kept in a file. Bytes only.

One record after the other, each a frame of `drivers.spi.framing`: type 1 for bytes from the device,
2 for bytes to it, 3 for the port having been opened; payload `t: u64` (monotonic ns, little-endian)
and the bytes. COBS and CRC-32 let a reader find the next record after any damage, also the end of
a file that was cut off.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from enum import IntEnum
from typing import Final

from drivers.spi.framing import FrameParser, encode_frame

PIECE_MAX_BYTES: Final = 960
"""Bytes of one record: a frame has 1024 at most. What came at once is cut into several."""

_TIME: Final = struct.Struct("<Q")


class Way(IntEnum):
    """What a record is about."""

    RECEIVED = 1
    SENT = 2
    OPENED = 3
    """The port was opened: what came before is over."""


@dataclass(frozen=True, slots=True)
class RawRecord:
    """Bytes that went over the line at once."""

    way: Way
    t_ns: int
    """Monotonic time, ns."""
    data: bytes


def encode_records(way: Way, t_ns: int, data: bytes) -> bytes:
    """The records of some bytes. Raises `ValueError` for a time that is none."""
    if not 0 <= t_ns < 1 << 64:
        raise ValueError(f"time {t_ns} ns is out of range")
    head = _TIME.pack(t_ns)
    starts = range(0, max(len(data), 1), PIECE_MAX_BYTES)
    return b"".join(
        encode_frame(way, head + data[start : start + PIECE_MAX_BYTES]) for start in starts
    )


class RawParser:
    """Takes the bytes of a file and gives its records. Never raises, and holds back 1024 bytes."""

    def __init__(self) -> None:
        self._frames = FrameParser()

    @property
    def damaged(self) -> int:
        """Pieces that are no records."""
        counters = self._frames.counters
        return counters.bad_cobs + counters.bad_crc + counters.too_long

    def feed(self, chunk: bytes) -> Iterator[RawRecord]:
        """Records that these bytes complete, oldest first."""
        for kind, payload in self._frames.feed(chunk):
            if kind not in _WAYS or len(payload) < _TIME.size:
                self._frames.counters.bad_crc += 1
                continue
            (t_ns,) = _TIME.unpack_from(payload)
            yield RawRecord(Way(kind), t_ns, payload[_TIME.size :])


_WAYS: Final = frozenset(way.value for way in Way)
