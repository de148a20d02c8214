"""CAN logs of other programs, read by python-can: ASC and BLF of Vector, TRC of PEAK.

Its readers skip lines in silence, end at the first damaged one, read half a byte as a whole one,
and do not support ASC files whose times are relative to the line before. Each line is therefore
read alone, and compared with the message. Files number channels from 1: channel 1 is `can0`.
"""

from __future__ import annotations

import re
import struct
import zlib
from collections.abc import Callable, Iterable, Iterator
from typing import BinaryIO, Final, TextIO, cast

import can

from graspd.drivers.can.frames import CLASSIC_DATA_MAX, ERR_FLAG, EXTENDED_ID_MAX
from graspd.drivers.recordings.candump import NO_BUS, NS_PER_S, Line, Logged, frame_of

BUS_ERROR: Final = 0x80
"""Error class given to an error frame whose class the log lacks (linux/can/error.h)."""
HEADER_LINES_MAX: Final = 100
"""Most lines of a header; those of TRC files have 30."""
PIECE_BYTES_MAX: Final = 1 << 19
"""Longest piece of a BLF file, bytes; Vector's have 128 KiB before they are packed. A piece unpacks
to at most a thousand times its length."""
FD_FLAG: Final = 0x1000
"""Flag of a CAN FD frame in lines `CANFD` of ASC files, which have classic frames too."""

_DAMAGE: Final = (ValueError, IndexError, KeyError, TypeError, OverflowError, NotImplementedError)
_BLF_DAMAGE: Final = (can.io.blf.BLFParseError, struct.error, zlib.error, *_DAMAGE)
_ASC_BASE: Final = re.compile(
    r"base\s+(hex|dec)(?:\s+timestamps\s+(absolute|relative))?", re.IGNORECASE
)
_ASC_TIME: Final = re.compile(r"\s*(\d+\.\d+)\s")
_ASC_OTHERS: Final = re.compile(
    r"\s*(?:\d+\.\d+\s+)?(?:$|//|date\s|base\s|(?:no )?internal events|(?:begin|end) trigger"
    r"|version\s|start of|previous log|log |trigger"
    r"|(?:CAN(?:FD)?\s+)?\d+\s+(?:status|statistic|overload))",
    re.IGNORECASE,
)
"""Lines of ASC files that are not frames."""
_TRC_OTHERS: Final = re.compile(
    r"\s*(?:$|;|\d+\)?\s+[\d.]+\s+(?:Warng|Error|ST|EC|ER|EV|FFFFFFFF)\b)"
)
"""Lines of TRC files that are not frames; status and errors are among them."""


def read_asc(lines: Iterable[str]) -> Iterator[Line]:
    """Yield frames of an ASC file, lines not understood, and any others with a relative time."""
    base, is_relative = "hex", False
    for number, text in enumerate(lines, 1):
        if head := _ASC_BASE.match(text.strip()):
            base, is_relative = head[1].lower(), (head[2] or "").lower() == "relative"
        is_other = _ASC_OTHERS.match(text) is not None
        logged = None if is_other else _frame_of_asc(base, text)
        if logged is not None:
            yield number, text, logged._replace(may_be_step=is_relative)
            continue
        if is_relative and (time := _ASC_TIME.match(text)):
            t_ns = round(float(time[1]) * NS_PER_S)
            yield number, text, Logged(t_ns, NO_BUS, None, may_be_step=True)
        if not is_other:
            yield number, text, None


def _frame_of_asc(base: str, text: str) -> Logged | None:
    message = _message(can.ASCReader, [f"base {base}", "no internal events logged", text])
    if message is not None and message.is_fd and _is_classic(text, len(message.data)):
        message.is_fd = False
    return _logged(message, text if base == "hex" else "")


def read_trc(lines: Iterable[str]) -> Iterator[Line]:
    """Yield frames of a TRC file, and lines that were not understood."""
    header: list[str] = []
    for number, text in enumerate(lines, 1):
        if text.startswith(";$") and len(header) < HEADER_LINES_MAX:
            header.append(text)
        if not _TRC_OTHERS.match(text):
            message = _message(can.TRCReader, [*header, text])
            yield number, text, _logged(message, text, first_channel=1)


def read_csv(lines: Iterable[str]) -> Iterator[Line]:
    """Yield frames of a CSV file of python-can, which has one bus, and lines not understood."""
    for number, text in enumerate(lines, 1):
        if number > 1 and text.strip():
            message = _message(can.CSVReader, ["", text])
            if message is not None:
                message.channel = 0
            yield number, text, _logged(message, "")


def read_blf(stream: BinaryIO) -> Iterator[Line]:
    """Yield frames of a BLF file up to damage, then a line about it; later frames are not found."""
    number = 0
    try:
        for number, message in enumerate(can.BLFReader(cast(BinaryIO, _Pieces(stream))), 1):
            yield number, str(message), _logged(message, "")
    except _BLF_DAMAGE as error:
        yield number + 1, f"damaged: {error}", None


def _message(
    reader: Callable[[TextIO], Iterable[can.Message]], lines: list[str]
) -> can.Message | None:
    """Return the message in the last of these lines; None: that line is not a frame."""
    try:
        return next(iter(reader(cast(TextIO, _Lines(lines)))), None)
    except _DAMAGE:
        return None


def _logged(message: can.Message | None, text: str, first_channel: int = 0) -> Logged | None:
    """Return the frame of a message; None if it differs from its line or is incomplete. `text`: the
    line, or empty if it has no data in hexadecimal digits to compare. `first_channel`: the number
    of the channel that is `can0`."""
    if message is None or not isinstance(message.channel, int):
        return None
    t_ns, bus = round(message.timestamp * NS_PER_S), f"can{message.channel - first_channel}"
    data, is_remote = bytes(message.data or b""), message.is_remote_frame
    if message.is_fd:
        return Logged(t_ns, bus, None)
    if message.is_error_frame:
        return Logged(t_ns, bus, frame_of(ERR_FLAG | BUS_ERROR, b"", is_long=True, is_remote=False))
    is_whole = is_remote or len(data) == message.dlc <= CLASSIC_DATA_MAX
    if not is_whole or (text and data.hex(" ") not in text.lower()):
        return None
    word, is_long = message.arbitration_id, message.is_extended_id
    if word > EXTENDED_ID_MAX:
        return None
    frame = frame_of(word, data, is_long=is_long, is_remote=is_remote)
    return None if frame is None else Logged(t_ns, bus, frame)


def _is_classic(text: str, data_bytes: int) -> bool:
    """Return True if a line `CANFD` of an ASC file with `data_bytes` of data is a classic frame."""
    words = text.split()
    name_words = 0 if "".join(words[5:6]).isdigit() else 1
    flags = words[11 + name_words + data_bytes :]
    try:
        return bool(flags) and not int(flags[0], 16) & FD_FLAG
    except ValueError:
        return False


class _Lines:
    """Lines as an open text file, as python-can's readers take it."""

    def __init__(self, lines: Iterable[str]) -> None:
        self._lines = iter(lines)

    def __iter__(self) -> Iterator[str]:
        return self._lines

    def __next__(self) -> str:
        return next(self._lines)

    def close(self) -> None:
        """Do nothing; the file is closed by its owner."""


class _Pieces:
    """A file that raises `ValueError` for reads of more than `PIECE_BYTES_MAX` bytes."""

    def __init__(self, stream: BinaryIO) -> None:
        self._stream = stream

    def read(self, size: int) -> bytes:
        if size > PIECE_BYTES_MAX:
            raise ValueError(f"a piece of {size} bytes")
        return self._stream.read(size)

    def close(self) -> None:
        """Do nothing; the file is closed by its owner."""
