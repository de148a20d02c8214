"""Messages of the bridge between BioTac SPs and a serial line, version 1.

Both directions, as `deploy/bridge/PROTOCOL.md` lays down: encoding validates and raises
`ValueError`, decoding gives None for what makes no sense.
"""

from __future__ import annotations

import struct
import zlib
from dataclasses import dataclass
from typing import ClassVar, Final, Self

import msgspec
import numpy as np
from numpy.typing import NDArray

from drivers.biotac import FORBIDDEN_COMMAND
from drivers.spi.framing import FrameParser, encode_frame

VERSION = 1
FIRMWARE = 0x0002
"""Firmware in `deploy/bridge` of this graspd, major * 256 + minor (`BRIDGE_FIRMWARE` there)."""
SCHEMA = """\
graspd bridge 1
01 HELLO   u8 version; u32 digest; u32 nonce; u64 tick; u32 tick_hz; u16 firmware; char board[16]; \
u32 period_ticks; u8 sensors; u8 slots; char serial[sensors][16]; u8 command[slots]
02 SWEEP   u32 seq; u64 tick_start; u64 tick_end; u8 present; u8 sensors; u8 slots; \
u8 word[slots][sensors][2]
03 STATUS  u64 tick; u32 sweeps; u32 overruns; u32 tx_dropped; u32 rx_errors; u8 sensors; \
u32 spi_errors[sensors]
81 PING    u32 nonce
82 START   (nothing)
83 STOP    (nothing)
"""
DIGEST = zlib.crc32(SCHEMA.encode("ascii"))
"""Begins the checksum of every frame but HELLO and PING, so that another layout fails it."""

SENSORS_MAX = 5
"""Fingers of a hand, and chip selects of the largest board."""
SLOTS_MAX = 64
"""Samples per sweep; the longest sequence of the manual (table 12) has 54."""
TEXT_BYTES = 16
"""Length of a board's name and of a sensor's serial number (manual table 10)."""
TICK_HZ_MIN = 1_000
"""A clock that is slower cannot tell sweeps apart."""

_U8, _U16, _U32, _U64 = (1 << 8) - 1, (1 << 16) - 1, (1 << 32) - 1, (1 << 64) - 1
_HEAD = struct.Struct("<BII")
_HELLO = struct.Struct(f"<BIIQIH{TEXT_BYTES}sIBB")
_SWEEP = struct.Struct("<IQQBBB")
_STATUS = struct.Struct("<QIIIIB")
_PING = struct.Struct("<I")
_WORD = np.dtype(">u2")


@dataclass(frozen=True, slots=True)
class HelloHead:
    """The part of HELLO that keeps its place in every version."""

    version: int
    digest: int
    nonce: int

    @classmethod
    def from_bytes(cls, payload: bytes) -> HelloHead | None:
        """Head of any version's HELLO, or None if it is too short."""
        return cls(*_HEAD.unpack_from(payload)) if len(payload) >= _HEAD.size else None


@dataclass(frozen=True, slots=True)
class Hello:
    """What the bridge is and how it samples; answers PING, and comes once after a reset."""

    TYPE: ClassVar[int] = 0x01

    nonce: int
    """Of the PING that it answers, 0 after a reset."""
    tick: int
    """The bridge's clock when it took the PING in."""
    tick_hz: int
    period_ticks: int
    """Nominal ticks from one sweep to the next."""
    serials: tuple[str, ...]
    """Serial number of each sensor, empty where none answered; in the order of chip selects."""
    commands: tuple[int, ...]
    """First command byte of each slot (manual figure 13)."""
    firmware: int = 0
    """Major * 256 + minor."""
    board: str = ""
    version: int = VERSION
    digest: int = DIGEST

    @property
    def sensors(self) -> int:
        """Sensors on the bridge, 1..5."""
        return len(self.serials)

    @property
    def slots(self) -> int:
        """Samples of each sensor per sweep, 1..64."""
        return len(self.commands)

    @property
    def period_ns(self) -> int:
        """Nominal time from one sweep to the next, ns."""
        return self.period_ticks * 1_000_000_000 // self.tick_hz

    def to_bytes(self) -> bytes:
        """The payload. Raises `ValueError`."""
        _check_range("version", self.version, 0, _U8)
        _check_range("digest", self.digest, 0, _U32)
        _check_range("nonce", self.nonce, 0, _U32)
        _check_range("tick", self.tick, 0, _U64)
        _check_range("tick_hz", self.tick_hz, TICK_HZ_MIN, _U32)
        _check_range("firmware", self.firmware, 0, _U16)
        _check_range("period_ticks", self.period_ticks, 1, _U32)
        _check_range("sensors", self.sensors, 1, SENSORS_MAX)
        _check_range("slots", self.slots, 1, SLOTS_MAX)
        if FORBIDDEN_COMMAND in self.commands:
            raise ValueError(f"command 0x{FORBIDDEN_COMMAND:02X} must never be sent to a sensor")
        head = _HELLO.pack(
            self.version,
            self.digest,
            self.nonce,
            self.tick,
            self.tick_hz,
            self.firmware,
            _text_to_bytes(self.board),
            self.period_ticks,
            self.sensors,
            self.slots,
        )
        serials = b"".join(_text_to_bytes(serial) for serial in self.serials)
        return head + serials + bytes(self.commands)

    @classmethod
    def from_bytes(cls, payload: bytes) -> Hello | None:
        """The message, or None if this is no HELLO of version 1."""
        if len(payload) < _HELLO.size:
            return None
        version, digest, nonce, tick, tick_hz, firmware, board, period_ticks, sensors, slots = (
            _HELLO.unpack_from(payload)
        )
        serials_end = _HELLO.size + sensors * TEXT_BYTES
        commands = payload[serials_end:]
        sound = (
            version == VERSION
            and tick_hz >= TICK_HZ_MIN
            and period_ticks > 0
            and 1 <= sensors <= SENSORS_MAX
            and 1 <= slots <= SLOTS_MAX
            and len(payload) == serials_end + slots
            and FORBIDDEN_COMMAND not in commands
        )
        if not sound:
            return None
        starts = range(_HELLO.size, serials_end, TEXT_BYTES)
        return cls(
            nonce=nonce,
            tick=tick,
            tick_hz=tick_hz,
            period_ticks=period_ticks,
            serials=tuple(_text(payload[start : start + TEXT_BYTES]) for start in starts),
            commands=tuple(commands),
            firmware=firmware,
            board=_text(board),
            digest=digest,
        )


class Sweep(msgspec.Struct, frozen=True, eq=False, gc=False):
    """The response words of one sweep over all slots and sensors, as they were read."""

    TYPE: ClassVar[int] = 0x02

    seq: int
    """Counts sweeps since START, from 0, wrapping at 2**32."""
    tick_start: int
    tick_end: int
    """The bridge's clock at the first command and after the last word."""
    present: int
    """Bit i: sensor i had a serial number when it was last looked for."""
    words: NDArray[np.uint16]
    """Shape (slots, sensors), 16-bit response words of either byte order, not yet judged (manual
    figure 15)."""

    def to_bytes(self) -> bytes:
        """The payload. Raises `ValueError`."""
        if self.words.ndim != 2 or self.words.dtype not in (np.uint16, _WORD):
            raise ValueError(f"words are {self.words.dtype} of shape {self.words.shape}")
        slots, sensors = self.words.shape
        _check_range("seq", self.seq, 0, _U32)
        _check_range("tick_start", self.tick_start, 0, self.tick_end)
        _check_range("tick_end", self.tick_end, 0, _U64)
        _check_range("sensors", sensors, 1, SENSORS_MAX)
        _check_range("slots", slots, 1, SLOTS_MAX)
        _check_range("present", self.present, 0, (1 << sensors) - 1)
        head = _SWEEP.pack(self.seq, self.tick_start, self.tick_end, self.present, sensors, slots)
        return head + self.words.astype(_WORD).tobytes()

    @classmethod
    def from_bytes(cls, payload: bytes) -> Sweep | None:
        """The message, or None if this is no SWEEP."""
        if len(payload) < _SWEEP.size:
            return None
        seq, tick_start, tick_end, present, sensors, slots = _SWEEP.unpack_from(payload)
        sound = (
            1 <= sensors <= SENSORS_MAX
            and 1 <= slots <= SLOTS_MAX
            and len(payload) == _SWEEP.size + slots * sensors * 2
            and tick_start <= tick_end
            and present < 1 << sensors
        )
        if not sound:
            return None
        words = np.ndarray((slots, sensors), _WORD, payload, _SWEEP.size)
        return cls(seq, tick_start, tick_end, present, words)


@dataclass(frozen=True, slots=True)
class BridgeStatus:
    """The bridge's own counters since its reset; comes once a second."""

    TYPE: ClassVar[int] = 0x03

    tick: int
    sweeps: int
    """Sweeps finished."""
    overruns: int
    """Sweeps that began late because the one before took too long."""
    tx_dropped: int
    """Frames that the host's side did not take in time."""
    rx_errors: int
    """Frames from the host that were damaged, too long or unknown."""
    spi_errors: tuple[int, ...]
    """Words per sensor whose parity was bad, error words among them."""

    def to_bytes(self) -> bytes:
        """The payload. Raises `ValueError`."""
        sensors = len(self.spi_errors)
        _check_range("sensors", sensors, 1, SENSORS_MAX)
        _check_range("tick", self.tick, 0, _U64)
        counts = (self.sweeps, self.overruns, self.tx_dropped, self.rx_errors)
        for count in (*counts, *self.spi_errors):
            _check_range("a count", count, 0, _U32)
        head = _STATUS.pack(self.tick, *counts, sensors)
        return head + struct.pack(f"<{sensors}I", *self.spi_errors)

    @classmethod
    def from_bytes(cls, payload: bytes) -> BridgeStatus | None:
        """The message, or None if this is no STATUS."""
        if len(payload) < _STATUS.size:
            return None
        tick, sweeps, overruns, tx_dropped, rx_errors, sensors = _STATUS.unpack_from(payload)
        if not 1 <= sensors <= SENSORS_MAX or len(payload) != _STATUS.size + 4 * sensors:
            return None
        spi_errors = struct.unpack_from(f"<{sensors}I", payload, _STATUS.size)
        return cls(tick, sweeps, overruns, tx_dropped, rx_errors, spi_errors)


@dataclass(frozen=True, slots=True)
class Ping:
    """Asks for a HELLO with the same nonce."""

    TYPE: ClassVar[int] = 0x81

    nonce: int

    def to_bytes(self) -> bytes:
        """The payload. Raises `ValueError`."""
        _check_range("nonce", self.nonce, 0, _U32)
        return _PING.pack(self.nonce)

    @classmethod
    def from_bytes(cls, payload: bytes) -> Ping | None:
        """The message, or None if this is no PING."""
        return cls(*_PING.unpack(payload)) if len(payload) == _PING.size else None


@dataclass(frozen=True)
class _Bare:
    """A message that is all said by its type."""

    def to_bytes(self) -> bytes:
        """The payload: nothing."""
        return b""

    @classmethod
    def from_bytes(cls, payload: bytes) -> Self | None:
        """The message, or None if there is a payload."""
        return None if payload else cls()


class Start(_Bare):
    """Begins sweeping with sequence number 0; ignored while sweeping."""

    TYPE: ClassVar[int] = 0x82


class Stop(_Bare):
    """Ends sweeping after the sweep at hand."""

    TYPE: ClassVar[int] = 0x83


Message = Hello | Sweep | BridgeStatus | Ping | Start | Stop

UNSEEDED: Final = frozenset({Hello.TYPE, Ping.TYPE})
"""Frames that peers with different layouts must still be able to exchange."""
_MESSAGES: dict[int, type[Message]] = {
    message.TYPE: message for message in (Hello, Sweep, BridgeStatus, Ping, Start, Stop)
}


def encode(message: Message, digest: int = DIGEST) -> bytes:
    """The whole frame of a message as it goes on the wire. Raises `ValueError`."""
    seed = 0 if message.TYPE in UNSEEDED else digest
    return encode_frame(message.TYPE, message.to_bytes(), seed)


def decode(kind: int, payload: bytes) -> Message | None:
    """The message of a frame, or None if it is none of version 1 or makes no sense."""
    message = _MESSAGES.get(kind)
    return None if message is None else message.from_bytes(payload)


def frame_parser() -> FrameParser:
    """A parser for frames of either direction."""
    return FrameParser(DIGEST, UNSEEDED)


def _check_range(name: str, value: int, low: int, high: int) -> None:
    if not low <= value <= high:
        raise ValueError(f"{name} is {value}, must be in {low}..{high}")


def _text_to_bytes(text: str) -> bytes:
    """NUL-padded ASCII of 16 bytes."""
    if not text.isascii() or "\0" in text or len(text) > TEXT_BYTES:
        raise ValueError(f"{text!r} is not at most {TEXT_BYTES} ASCII characters")
    return text.encode("ascii").ljust(TEXT_BYTES, b"\0")


def _text(padded: bytes) -> str:
    """A sensor that answers nonsense must not take the link down: odd bytes become `?`."""
    text = padded.partition(b"\0")[0].decode("ascii", errors="replace")
    return "".join(letter if letter.isprintable() and letter.isascii() else "?" for letter in text)
