"""Frames of the serial bridge: COBS ends them unmistakably, CRC-32 says whether they are whole.

`COBS(type: u8 | payload | crc: u32) 0x00`, as `deploy/bridge/PROTOCOL.md` lays down.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Collection
from dataclasses import dataclass
from typing import Final

from cobs import cobs

DELIMITER: Final = b"\0"
"""Ends a frame and occurs nowhere else, so that the next frame is found after any damage."""
ENCODED_MAX_BYTES = 1024
"""Longest encoded frame without its delimiter; the largest of version 1, a SWEEP of 64 slots and 5
sensors, takes 671. It bounds what a parser holds back."""

_CRC = struct.Struct("<I")
_CRC_RESIDUE: Final = 0x2144DF1C
"""CRC-32 of anything with its own checksum behind it, whatever the checksum was continued from."""
_SHORTEST = 1 + _CRC.size
"""A frame without payload: type and checksum, bytes."""

Frame = tuple[int, bytes]
"""Type and payload."""


@dataclass(slots=True)
class FrameCounters:
    """What a parser has seen since it was made. Every drop is one count."""

    bytes: int = 0
    frames: int = 0
    """Whole frames with the right checksum."""
    bad_cobs: int = 0
    """Frames that are no COBS."""
    bad_crc: int = 0
    """Frames with a wrong checksum, or without room for one."""
    too_long: int = 0
    """Frames longer than `ENCODED_MAX_BYTES`."""
    empty: int = 0
    """Delimiters without a frame before them: harmless."""


def encode_frame(kind: int, payload: bytes, digest: int = 0) -> bytes:
    """A frame with its delimiter, its checksum continued from `digest`.

    Raises `ValueError` for a type that is no byte and a frame longer than `ENCODED_MAX_BYTES`.
    """
    if not 0 <= kind <= 0xFF:
        raise ValueError(f"frame type {kind} is not a byte")
    body = bytes([kind]) + payload
    encoded: bytes = cobs.encode(body + _CRC.pack(zlib.crc32(body, digest)))
    if len(encoded) > ENCODED_MAX_BYTES:
        raise ValueError(f"the frame takes {len(encoded)} bytes, more than {ENCODED_MAX_BYTES}")
    return encoded + DELIMITER


class FrameParser:
    """Takes bytes as they come and gives whole frames. Never raises, holds back 1024 bytes at most.

    Whatever is damaged is counted and dropped; the frame after the next delimiter is found again.
    """

    def __init__(self, digest: int = 0, unseeded: Collection[int] = ()) -> None:
        """`digest` begins every checksum except those of the frame types in `unseeded`."""
        self.counters = FrameCounters()
        self._digest = digest
        self._unseeded = frozenset(unseeded)
        self._held = b""
        self._overlong = False

    @property
    def held_bytes(self) -> int:
        """Bytes of an unfinished frame that are held back."""
        return len(self._held)

    def reset(self) -> None:
        """Forget an unfinished frame: the line was opened anew."""
        self._held = b""
        self._overlong = False

    def feed(self, chunk: bytes) -> list[Frame]:
        """Frames that these bytes complete, oldest first."""
        self.counters.bytes += len(chunk)
        *ended, rest = chunk.split(DELIMITER)
        frames = []
        for piece in ended:
            self._hold(piece)
            if not self._overlong and (frame := self._decode(self._held)) is not None:
                frames.append(frame)
            self._held, self._overlong = b"", False
        if rest:
            self._hold(rest)
        return frames

    def _hold(self, piece: bytes) -> None:
        if self._overlong:
            return
        if len(self._held) + len(piece) > ENCODED_MAX_BYTES:
            self.counters.too_long += 1
            self._held = b""
            self._overlong = True
            return
        self._held += piece

    def _decode(self, encoded: bytes) -> Frame | None:
        if not encoded:
            self.counters.empty += 1
            return None
        try:
            decoded: bytes = cobs.decode(encoded)
        except cobs.DecodeError:
            self.counters.bad_cobs += 1
            return None
        seed = 0 if decoded and decoded[0] in self._unseeded else self._digest
        if len(decoded) < _SHORTEST or zlib.crc32(decoded, seed) != _CRC_RESIDUE:
            self.counters.bad_crc += 1
            return None
        self.counters.frames += 1
        return decoded[0], decoded[1 : -_CRC.size]
