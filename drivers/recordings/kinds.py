"""Kinds of recordings, by content: the first bytes decide, never the name.

A packed file (gzip) is unpacked as it is read. Standard input and pipes, which can be read only
once, are first copied to a file.
"""

from __future__ import annotations

import gzip
import io
import os
import re
import stat
import sys
import zlib
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from enum import Enum
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import BinaryIO, Final, cast

from graspd.drivers.base import RecordingError
from graspd.extras import require

STANDARD_INPUT: Final = Path("-")
"""Name of standard input on a command line."""
COPIED_BYTES_MAX: Final = 4 * 2**30
"""Most bytes that are copied from a pipe, and most that a packed file unpacks to."""
LINE_LENGTH_MAX: Final = 65_536
"""Longest line, characters; a full row has 1,200. A disk image may have no line end at all."""
HEAD_BYTES: Final = 65_536
"""Number of first bytes that decide the kind of a file."""
HEADER_BYTES: Final = 64
"""Number of first bytes in which zeros show UTF-16 without a byte order mark."""
METADATA: Final = "metadata.yaml"
"""File in the folder of a ROS 2 bag."""
PAGE: Final = "deploy/RECORDING.md"


class Kind(Enum):
    """Kinds of recordings; the value is a text for people."""

    TEXT = "a text table"
    PARQUET = "a Parquet table"
    MCAP = "a recording of graspd (MCAP)"
    ROS1_BAG = "a ROS 1 bag"
    ROS2_BAG = "a ROS 2 bag"
    CANDUMP = "a CAN log of candump"
    ASC = "a CAN log of Vector (ASC)"
    BLF = "a CAN log of Vector (BLF)"
    TRC = "a CAN log of PEAK (TRC)"
    CSV = "a CAN log of python-can (CSV)"
    SERIAL = "a serial link log of graspd"


TABLES: Final = frozenset((Kind.TEXT, Kind.PARQUET))
CAN_LOGS: Final = frozenset((Kind.CANDUMP, Kind.ASC, Kind.BLF, Kind.TRC, Kind.CSV))
BAGS: Final = frozenset((Kind.ROS1_BAG, Kind.ROS2_BAG))

_GZIP: Final = b"\x1f\x8b\x08"
_MCAP: Final = b"\x89MCAP0\r\n"
_MCAP_ROS2: Final = _MCAP + b"\x01", b"\x04\x00\x00\x00ros2"
"""First bytes of a ROS 2 bag in MCAP, and those of its profile, from byte 17 on."""
_MAGIC: Final = {
    b"PAR1": Kind.PARQUET,
    _MCAP: Kind.MCAP,
    b"#ROSBAG V2.0": Kind.ROS1_BAG,
    b"LOGG": Kind.BLF,
    b";$FILEVERSION": Kind.TRC,
    b";#########": Kind.TRC,  # version 1.0
    b"timestamp,arbitration_id,": Kind.CSV,
}
_MARKS: Final = {
    b"\xff\xfe\0\0": "utf-32",
    b"\xff\xfe": "utf-16",
    b"\xfe\xff": "utf-16",
    b"\xef\xbb\xbf": "utf-8-sig",
}
"""Encodings by their byte order marks."""
_SPACE: Final = rb"(?:[ \t]|\x1b\[[0-9;]*m)"
"""A blank, or the code of a colour."""
_CANDUMP_LINE: Final = re.compile(
    rb"^" + _SPACE + rb"*+(?:\([^)\r\n]{1,40}\)" + _SPACE + rb"*+)?"
    rb"[!-~\x80-\xff]{1,4096}+" + _SPACE + rb"++"
    rb"(?:(?:[0-9A-F]{3}|[0-9A-F]{8})#[0-9A-FR#_. \t]*+T?[ \t]*+"
    rb"|(?:[RT]X [-B] [-E][ \t]+)?[0-9A-F]{1,8}[ \t]+\[ ?[0-9]{1,2}\].*)\r?$",
    re.IGNORECASE | re.MULTILINE,
)
"""A frame as candump writes it into a file, `can0 100#0D3A`, or shows it, `can0 100 [2] 0D 3A`."""
_ASC_LINE: Final = re.compile(
    rb"^(?:base[ \t]+(?:hex|dec)\b"
    rb"|[ \t]*\d+\.\d+[ \t]+\d+[ \t]+[0-9A-F]+x?[ \t]+[RT]x[ \t]+[dr]\b)",
    re.IGNORECASE | re.MULTILINE,
)
"""The header of an ASC file, or a frame, `0.000200 1 5A1 Rx d 7 A4 CB`."""
ZSTD: Final = b"\x28\xb5\x2f\xfd"
SQLITE: Final = b"SQLite format 3\0"
_SERIAL_EVENTS: Final = frozenset((1, 2, 3))
"""Types of the records of `graspd.drivers.recordings.serial_log`."""
_OTHERS: Final = {
    b"#ROSBAG V1": "an old ROS 1 bag: `rosbag fix` makes version 2.0 of it",
    b"\x89PNG": "a PNG image",
    b"\xff\xd8\xff": "a JPEG image",
    b"%PDF": "a PDF document",
    b"PK\x03\x04": "a zip archive or an Excel workbook: unpack it, or save the sheet as CSV",
    b"\xd0\xcf\x11\xe0": "an old Excel workbook: save the sheet as CSV",
    b"\x89HDF": "HDF5: write the table as CSV or Parquet",
    b"MATLAB": "a MATLAB file: write the table as CSV",
    b"\x93NUMPY": "a NumPy array: write CSV with a header; in Python "
    'graspd.load("small-session").predict(array) takes it',
    b"\x80": "a Python pickle: write the table as CSV or Parquet",
    b"ARROW1": "Arrow or Feather: write the table as Parquet",
    b"\xff\xff\xff\xff": "a stream of Arrow: write the table as Parquet",
    ZSTD: "packed with zstd: unpack it first",
    b"BZh": "packed with bzip2: unpack it first",
    b"\xfd7zXZ": "packed with xz: unpack it first",
    b"7z\xbc\xaf": "a 7z archive: unpack it first",
    b"\x7fELF": "a program",
    b"\xd4\xc3\xb2\xa1": "a network capture (pcap)",
    b"\x0a\x0d\x0d\x0a": "a network capture (pcapng)",
    SQLITE: "an SQLite database without the tables of a ROS 2 bag; `can_logconvert` makes ASC of "
    "one of python-can",
    b"Timestamp: ": "what `can_logger` shows: take `can_logger -f log.asc`",
    b"version https://git-lfs": "a pointer of Git LFS: `git lfs pull` brings the file",
    b"<": "a web page, or another text of HTML or XML",
    b"{": "JSON: write the table as CSV",
    b"[{": "JSON: write the table as CSV",
    b"header:": "what `rostopic echo` shows: take `rostopic echo -p`, or a bag",
    _GZIP: "packed twice: unpack it first",
}
"""Text on files that are not read, for people, by their first bytes."""


def kind_of(path: Path) -> Kind:
    """Return the kind of a file or folder.

    Raises `RecordingError` for what graspd does not read, and for a bag without the extra `bag`.
    """
    if os.path.isfile(path / METADATA):  # also False without the right to look
        kind = Kind.ROS2_BAG
    elif os.path.isdir(path):
        problem = f"is a directory without the file {METADATA}, which a ROS 2 bag has"
        raise RecordingError(path, f"{problem}: give its .db3 or .mcap, or `ros2 bag reindex` it")
    else:
        with open_recording(path) as file:
            kind = kind_of_open(path, file)
    if kind in BAGS:
        try:
            require("rosbags.rosbag2", "reading a ROS bag", "bag")
        except ModuleNotFoundError as error:
            raise RecordingError(path, str(error)) from error
    return kind


def kind_of_open(path: Path, file: BinaryIO) -> Kind:
    """Return the kind of an opened file, and rewind it. Raises `RecordingError`."""
    try:
        head = file.read(HEAD_BYTES)
        file.seek(0)
    except OSError as error:
        raise RecordingError(path, reason(error)) from error
    if not head:
        raise RecordingError(path, "the file is empty")
    kind = _kind_of(head)
    if kind is None:
        start = _in_utf_8(head)
        looks = next((text for magic, text in _OTHERS.items() if start.startswith(magic)), None)
        problem = "is of a kind that is not known" if looks is None else f"looks like {looks}"
        raise RecordingError(path, f"{problem}; {PAGE} lists what graspd reads")
    return kind


def kind_of_all(paths: Sequence[Path]) -> Kind:
    """Return the kind of all these files; `Kind.TEXT` for tables, also as Parquet.

    Raises `RecordingError` if they are not of one kind.
    """
    kinds = [kind_of(path) for path in paths]
    kinds = [Kind.TEXT if kind in TABLES else kind for kind in kinds]
    for path, kind in zip(paths, kinds, strict=True):
        if kind is not kinds[0]:
            problem = f"is {kind.value}, {paths[0]} is {kinds[0].value}: they are not one recording"
            raise RecordingError(path, problem)
    return kinds[0]


def refuse_options(path: Path, kind: Kind, options: Mapping[str, object]) -> None:
    """Raise `RecordingError` if `options`, which only tables have, are set for another kind."""
    given = [name for name, value in options.items() if value]
    if kind not in TABLES and given:
        problem = f"is {kind.value}, which is played as it is: no {', '.join(given)}"
        raise RecordingError(path, problem)


def _kind_of(head: bytes) -> Kind | None:
    if head.startswith(_MCAP_ROS2[0]) and head[17:].startswith(_MCAP_ROS2[1]):
        return Kind.ROS2_BAG
    if head.startswith(SQLITE) and b"messages" in head and b"topics" in head:
        return Kind.ROS2_BAG
    for magic, kind in _MAGIC.items():
        if head.startswith(magic):
            return kind
    head = _in_utf_8(head)
    if any(head.startswith(magic) for magic in _OTHERS):
        return None
    if _ASC_LINE.search(head):
        return Kind.ASC
    if _CANDUMP_LINE.search(head):
        return Kind.CANDUMP
    if b"\0" in head:
        from graspd.drivers.spi.messages import FrameParser

        events = (event for event, _ in FrameParser().feed(head))
        if not _SERIAL_EVENTS.isdisjoint(events):
            return Kind.SERIAL
        text = head.rstrip(b"\0")  # a computer that lost power leaves zeros
        return Kind.TEXT if text and b"\0" not in text else None
    return Kind.TEXT


def _in_utf_8(head: bytes) -> bytes:
    """Return the first bytes of a text of another encoding in UTF-8; any others as they are."""
    encoding = encoding_of(head)
    return head if encoding is None else head.decode(encoding, "replace").encode()


def encoding_of(head: bytes) -> str | None:
    """Return the encoding by byte order mark, or zeros in every other byte; None without either."""
    for mark, name in _MARKS.items():
        if head.startswith(mark):
            return name
    even, odd = head[:HEADER_BYTES:2], head[1:HEADER_BYTES:2]
    for zeros, others, name in ((odd, even, "utf-16-le"), (even, odd, "utf-16-be")):
        if zeros and not any(zeros) and all(others):
            return name
    return None


def open_recording(path: Path) -> BinaryIO:
    """Open a file, packed or not; it can be read again from its start.

    Raises `RecordingError` if it is not regular or cannot be read.
    """
    try:
        mode = os.stat(path).st_mode
        if stat.S_ISREG(mode):
            file = path.open("rb")
            if is_packed(path):
                return io.BufferedReader(
                    Unpacked(file, cast(BinaryIO, gzip.GzipFile(fileobj=file)))
                )
            return file
    except (OSError, ValueError) as error:  # ValueError: a NUL in the path
        raise RecordingError(path, reason(error)) from error
    raise RecordingError(path, "is a directory" if stat.S_ISDIR(mode) else "is not a regular file")


def is_packed(path: Path) -> bool:
    """Return True for a gzip file. Raises `OSError`."""
    if not path.is_file():
        return False
    with path.open("rb") as file:
        return file.read(len(_GZIP)) == _GZIP


class Unpacked(io.RawIOBase):
    """The content of a packed file. Reading raises `OSError` if it is damaged or too large."""

    def __init__(self, file: BinaryIO, packed: BinaryIO) -> None:
        """`packed`: stream that unpacks `file`."""
        self._file, self._packed = file, packed

    def readable(self) -> bool:
        return True

    def seekable(self) -> bool:
        return True

    def readinto(self, buffer: memoryview) -> int:  # type: ignore[override]
        try:
            data = self._packed.read(len(buffer))
        except (EOFError, zlib.error) as error:
            raise OSError(None, "the packed file is damaged or cut off") from error
        if self._packed.tell() > COPIED_BYTES_MAX:
            raise OSError(None, f"it unpacks to more than {COPIED_BYTES_MAX} bytes")
        buffer[: len(data)] = data
        return len(data)

    def seek(self, offset: int, whence: int = os.SEEK_SET) -> int:
        return self._packed.seek(offset, whence)

    def tell(self) -> int:
        return self._packed.tell()

    def close(self) -> None:
        self._packed.close()
        self._file.close()
        super().close()


@contextmanager
def files_of(paths: Sequence[Path]) -> Iterator[list[Path]]:
    """Yield `paths` with temporary copies in place of `-` and pipes, which are read only once.

    Raises `RecordingError` for more than `COPIED_BYTES_MAX`.
    """
    with TemporaryDirectory(prefix="graspd-") as folder:
        yield [_file_of(path, Path(folder, str(number))) for number, path in enumerate(paths)]


def _file_of(path: Path, folder: Path) -> Path:
    try:
        is_pipe = path == STANDARD_INPUT or stat.S_ISFIFO(os.stat(path).st_mode)
    except (OSError, ValueError):
        return path  # opening it will raise the error
    if not is_pipe:
        return path
    folder.mkdir()
    name = "standard input" if path == STANDARD_INPUT else path.name
    try:
        with (folder / name).open("xb") as copy:
            if path == STANDARD_INPUT:
                _copy(path, sys.stdin.buffer, copy)
            else:
                with path.open("rb") as pipe:
                    _copy(path, pipe, copy)
    except OSError as error:
        raise RecordingError(path, reason(error)) from error
    return folder / name


def _copy(path: Path, source: BinaryIO, target: BinaryIO) -> None:
    left = COPIED_BYTES_MAX
    while chunk := source.read(HEAD_BYTES):
        left -= len(chunk)
        if left < 0:
            raise RecordingError(path, f"brings more than {COPIED_BYTES_MAX} bytes")
        target.write(chunk)


def reason(error: OSError | ValueError) -> str:
    """Return why a file cannot be read, for people."""
    system = error.strerror if isinstance(error, OSError) else None
    return (system or str(error)).lower()
