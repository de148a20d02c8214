"""Frames and messages of `deploy/bridge/PROTOCOL.md`, version 1. Bytes only.

A frame is `COBS(type: u8 | payload | crc: u32) 0x00`. Decoding returns None for a message
with a wrong length or with contents that the protocol forbids.
"""

from __future__ import annotations

import struct
import zlib
from dataclasses import dataclass
from typing import ClassVar, Final, Self

import msgspec
import numpy as np
from cobs import cobs
from numpy.typing import NDArray

from graspd.drivers.base import DriverCounters
from graspd.drivers.biotac import FORBIDDEN_COMMAND

DELIMITER: Final = b"\0"
"""Byte that ends a frame and occurs in no frame, so the next one is found after any damage."""
ENCODED_MAX_BYTES = 1024
"""Longest encoded frame without delimiter, bytes; the largest SWEEP of version 1 takes 671."""
VERSION = 1
FIRMWARE = 0x0002
"""Version of the firmware in `deploy/bridge`, major * 256 + minor (`BRIDGE_FIRMWARE` there)."""
DIGEST: Final = 0x0D99E4D6
"""CRC-32 of the protocol's schema: start value of the checksum of frames, except HELLO and PING.

A peer with another layout fails the check and is not misread.
"""

SENSORS_MAX = 5
"""Most sensors of a bridge: one for each finger of a hand."""
SLOTS_MAX = 64
"""Most samples per sweep; the longest sequence of the manual (table 12) has 54."""
TEXT_BYTES = 16
"""Length of a board's name and of a sensor's serial number, bytes (manual table 10)."""
TICK_HZ_MIN = 1_000
"""Slowest accepted clock, Hz: with a slower one two sweeps could have the same tick."""

UNSEEDED: Final = (0x01, 0x81)
"""Types without `DIGEST`: HELLO and PING, which peers of any layout must be able to exchange."""
_CRC_RESIDUE: Final = 0x2144DF1C
"""CRC-32 of any bytes followed by their own checksum; it does not depend on bytes or start."""
_U32 = struct.Struct("<I")
_LAYOUT = struct.Struct("<BI")
_HELLO = struct.Struct(f"<BIIQIH{TEXT_BYTES}sIBB")
_SWEEP = struct.Struct("<IQQBBB")
_STATUS = struct.Struct("<QIIIIB")
_WORD = np.dtype(">u2")


@dataclass(slots=True)
class FrameCounters(DriverCounters):
    """Counters of a parser of frames; its driver's counters contain them."""

    bytes: int = 0
    frames: int = 0
    """Whole frames with the right checksum."""
    bad_cobs: int = 0
    bad_crc: int = 0
    """Frames with a wrong checksum, or too short to have one."""
    too_long: int = 0
    """Frames longer than `ENCODED_MAX_BYTES`."""


def encode_frame(kind: int, payload: bytes, digest: int = 0) -> bytes:
    """Return the frame of a payload. Raises `ValueError` if it is too long.

    `kind`: type of the message. `digest`: start value of the checksum, unused for `UNSEEDED` types.
    """
    body = bytes([kind]) + payload
    seed = 0 if kind in UNSEEDED else digest
    encoded: bytes = cobs.encode(body + _U32.pack(zlib.crc32(body, seed)))
    if len(encoded) > ENCODED_MAX_BYTES:
        raise ValueError(f"the frame takes {len(encoded)} bytes, more than {ENCODED_MAX_BYTES}")
    return encoded + DELIMITER


class FrameParser:
    """Cut a stream of bytes into frames. Never raises; damaged frames are counted and dropped."""

    def __init__(self, digest: int = 0, counters: FrameCounters | None = None) -> None:
        """`digest`: as in `encode_frame`. `counters`: where to count; None: in new ones."""
        self.counters = counters or FrameCounters()
        self._digest = digest
        self.reset()

    @property
    def held_bytes(self) -> int:
        """Number of bytes of an unfinished frame, at most `ENCODED_MAX_BYTES`."""
        return len(self._held)

    def reset(self) -> None:
        """Forget an unfinished frame. Call when the line is reopened."""
        self._held = b""
        self._is_overlong = False

    def feed(self, chunk: bytes) -> list[tuple[int, bytes]]:
        """Return type and payload of each frame that `chunk` completes, oldest first."""
        self.counters.bytes += len(chunk)
        *ended, rest = chunk.split(DELIMITER)
        frames = []
        for piece in ended:
            self._hold(piece)
            frame = self._decode(self._held) if self._held else None
            if frame is not None:
                frames.append(frame)
            self.reset()
        self._hold(rest)
        return frames

    def _hold(self, piece: bytes) -> None:
        if self._is_overlong:
            return
        self._held += piece
        if len(self._held) > ENCODED_MAX_BYTES:
            self.counters.too_long += 1
            self._held = b""
            self._is_overlong = True

    def _decode(self, encoded: bytes) -> tuple[int, bytes] | None:
        try:
            decoded: bytes = cobs.decode(encoded)
        except cobs.DecodeError:
            self.counters.bad_cobs += 1
            return None
        seed = 0 if decoded and decoded[0] in UNSEEDED else self._digest
        if len(decoded) <= _U32.size or zlib.crc32(decoded, seed) != _CRC_RESIDUE:
            self.counters.bad_crc += 1
            return None
        self.counters.frames += 1
        return decoded[0], decoded[1 : -_U32.size]


@dataclass(frozen=True, slots=True)
class Hello:
    """Description of the bridge and its sampling; sent after a PING, and once after a reset.

    Ticks are those of the bridge's clock, here and in the other messages.
    """

    TYPE: ClassVar[int] = 0x01

    nonce: int
    """Nonce of the answered PING; 0 after a reset."""
    tick: int
    tick_hz: int
    period_ticks: int
    serials: tuple[str, ...]
    """Serial number at each chip select; empty where no sensor answered."""
    commands: tuple[int, ...]
    """First command byte of each slot (manual figure 13)."""
    firmware: int = 0
    board: str = ""
    version: int = VERSION
    digest: int = DIGEST

    @property
    def sensors(self) -> int:
        return len(self.serials)

    @property
    def slots(self) -> int:
        return len(self.commands)

    @property
    def sampling(self) -> tuple[object, ...]:
        """The fields that must not change while the bridge sweeps."""
        return (self.sensors, self.commands, self.tick_hz, self.period_ticks)

    @property
    def period_ns(self) -> int:
        return self.period_ticks * 1_000_000_000 // self.tick_hz

    def is_sound(self) -> bool:
        return (
            self.tick_hz >= TICK_HZ_MIN
            and self.period_ticks > 0
            and 1 <= self.sensors <= SENSORS_MAX
            and 1 <= self.slots <= SLOTS_MAX
            and FORBIDDEN_COMMAND not in self.commands
        )

    def to_bytes(self) -> bytes:
        bridge = (self.version, self.digest, self.nonce, self.tick, self.tick_hz, self.firmware)
        sampling = (self.board.encode(), self.period_ticks, self.sensors, self.slots)
        serials = b"".join(serial.encode().ljust(TEXT_BYTES, b"\0") for serial in self.serials)
        return _HELLO.pack(*bridge, *sampling) + serials + bytes(self.commands)

    @classmethod
    def from_bytes(cls, payload: bytes) -> Hello | None:
        if len(payload) < _HELLO.size:
            return None
        version, digest, nonce, tick, tick_hz, firmware, board, period_ticks, sensors, slots = (
            _HELLO.unpack_from(payload)
        )
        serials_end = _HELLO.size + sensors * TEXT_BYTES
        if version != VERSION or len(payload) != serials_end + slots:
            return None
        starts = range(_HELLO.size, serials_end, TEXT_BYTES)
        return cls(
            nonce=nonce,
            tick=tick,
            tick_hz=tick_hz,
            period_ticks=period_ticks,
            serials=tuple(_text(payload[start : start + TEXT_BYTES]) for start in starts),
            commands=tuple(payload[serials_end:]),
            firmware=firmware,
            board=_text(board),
            digest=digest,
        )


class Sweep(msgspec.Struct, frozen=True, eq=False, gc=False):
    """One sweep: the response words of all slots and sensors."""

    TYPE: ClassVar[int] = 0x02

    seq: int
    """Number of the sweep since START, from 0, modulo 2**32."""
    tick_start: int
    tick_end: int
    present: int
    """Bit i is set if sensor i answered when the bridge last asked for its serial number."""
    words: NDArray[np.uint16]
    """Response words (manual figure 15), shape (slots, sensors); the array has any byte order."""

    def is_sound(self) -> bool:
        slots, sensors = self.words.shape
        return (
            1 <= sensors <= SENSORS_MAX
            and 1 <= slots <= SLOTS_MAX
            and self.tick_start <= self.tick_end
            and self.present < 1 << sensors
        )

    def to_bytes(self) -> bytes:
        slots, sensors = self.words.shape
        head = _SWEEP.pack(self.seq, self.tick_start, self.tick_end, self.present, sensors, slots)
        return head + self.words.astype(_WORD, casting="equiv").tobytes()

    @classmethod
    def from_bytes(cls, payload: bytes) -> Sweep | None:
        if len(payload) < _SWEEP.size:
            return None
        seq, tick_start, tick_end, present, sensors, slots = _SWEEP.unpack_from(payload)
        if len(payload) != _SWEEP.size + slots * sensors * 2:
            return None
        words = np.ndarray((slots, sensors), _WORD, payload, _SWEEP.size)
        return cls(seq, tick_start, tick_end, present, words)


@dataclass(frozen=True, slots=True)
class BridgeStatus:
    """The bridge's own counters since its reset, sent once a second."""

    TYPE: ClassVar[int] = 0x03

    tick: int
    sweeps: int
    overruns: int
    tx_dropped: int
    rx_errors: int
    spi_errors: tuple[int, ...]
    """Words of bad parity at each chip select, error words included."""

    def is_sound(self) -> bool:
        return 1 <= len(self.spi_errors) <= SENSORS_MAX

    def to_bytes(self) -> bytes:
        counts = (self.sweeps, self.overruns, self.tx_dropped, self.rx_errors)
        sensors = len(self.spi_errors)
        head = _STATUS.pack(self.tick, *counts, sensors)
        return head + struct.pack(f"<{sensors}I", *self.spi_errors)

    @classmethod
    def from_bytes(cls, payload: bytes) -> BridgeStatus | None:
        if len(payload) < _STATUS.size:
            return None
        tick, sweeps, overruns, tx_dropped, rx_errors, sensors = _STATUS.unpack_from(payload)
        if len(payload) != _STATUS.size + 4 * sensors:
            return None
        spi_errors = struct.unpack_from(f"<{sensors}I", payload, _STATUS.size)
        return cls(tick, sweeps, overruns, tx_dropped, rx_errors, spi_errors)


@dataclass(frozen=True)
class _Bare:
    """Base of messages without payload."""

    def is_sound(self) -> bool:
        return True

    def to_bytes(self) -> bytes:
        return b""

    @classmethod
    def from_bytes(cls, payload: bytes) -> Self | None:
        return None if payload else cls()


class Start(_Bare):
    """Asks the bridge to sweep, from number 0; ignored while it sweeps."""

    TYPE: ClassVar[int] = 0x82


class Stop(_Bare):
    """Asks the bridge to stop after the current sweep."""

    TYPE: ClassVar[int] = 0x83


@dataclass(frozen=True)
class Ping(_Bare):
    """Asks the bridge for a HELLO with the same nonce."""

    TYPE: ClassVar[int] = 0x81

    nonce: int

    def to_bytes(self) -> bytes:
        return _U32.pack(self.nonce)

    @classmethod
    def from_bytes(cls, payload: bytes) -> Self | None:
        return cls(*_U32.unpack(payload)) if len(payload) == _U32.size else None


Message = Hello | Sweep | BridgeStatus | Ping | Start | Stop

_MESSAGES: dict[int, type[Message]] = {
    message.TYPE: message for message in (Hello, Sweep, BridgeStatus, Ping, Start, Stop)
}


def encode(message: Message) -> bytes:
    """Return the frame of a message."""
    return encode_frame(message.TYPE, message.to_bytes(), DIGEST)


def decode(kind: int, payload: bytes) -> Message | None:
    """Return the message of a frame; None for an unknown type, or if the protocol forbids it."""
    message_type = _MESSAGES.get(kind)
    message = None if message_type is None else message_type.from_bytes(payload)
    return message if message is not None and message.is_sound() else None


def layout_of(payload: bytes) -> tuple[int, int] | None:
    """Return version and digest of a HELLO of any version; None if it is too short."""
    return _LAYOUT.unpack_from(payload) if len(payload) >= _LAYOUT.size else None


def _text(padded: bytes) -> str:
    """Return the text without padding; bytes that are not printable ASCII become `?`."""
    text = padded.partition(b"\0")[0].decode("ascii", errors="replace")
    return "".join(letter if letter.isprintable() and letter.isascii() else "?" for letter in text)
