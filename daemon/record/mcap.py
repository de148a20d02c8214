"""Write and read the MCAP files of recordings. Needs the extra `record`."""

from __future__ import annotations

import contextlib
import os
import struct
import zlib
from collections.abc import Iterator, Mapping
from io import BytesIO
from itertools import count
from pathlib import Path
from typing import Any, BinaryIO, Final, NamedTuple, Self

import lz4.frame
import msgspec
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import EndOfFile, McapError, UnsupportedCompressionError
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, McapRecord, Message, Metadata
from mcap.stream_reader import CRCValidationError, StreamReader
from mcap.writer import Writer

from graspd.biotac import FINGERS
from graspd.daemon.record.topics import schemas
from graspd.drivers.base import RecordingError
from graspd.drivers.recordings.csv_rows import open_recording
from graspd.models.session_statistics import SessionState

MODE: Final = 0o640
"""File mode of recordings; not readable for all users, as they show what a hand did."""
METADATA: Final = "graspd"
"""Name of the metadata record at the start of each file of graspd."""
RECORD_MAX_BYTES: Final = 64 << 20
"""Largest record, bytes; a longer one is damaged."""
CHUNK_MAX_BYTES: Final = 8 << 20
"""Largest unpacked chunk, bytes; graspd writes 1 MB, other tools 4 MB."""
RATIO_MAX: Final = 100
"""Largest ratio of unpacked to packed bytes; held grasps have 12, zeros 36."""

_DAMAGE = (
    *(McapError, CRCValidationError, struct.error, zstandard.ZstdError, UnicodeDecodeError),
    *(OverflowError, MemoryError),
)
"""Exceptions of the library for a damaged file; huge lengths cause the last two."""

_TEXTS: Final = ("boot_id", "model", "model_sha256", "trust")
"""Fields written as text, or as base64 if they are bytes; all others are JSON."""


class RecordingHeader(msgspec.Struct, frozen=True, kw_only=True):
    """Description of the run, with session and learning where the file begins."""

    fingers: tuple[str, ...]
    """Fingers in the order of a reading's rows."""
    joints: bool
    """True if the hand had joint angles."""
    boot_id: str
    scene: dict[str, dict[str, Any]]
    """Sections `hand`, `model`, `gate`, `session`, `learn` and `risk`."""
    model: str
    model_sha256: str
    file: int = 0
    """Number of the file in the run; one is skipped after a failure of the disk."""
    wall_minus_monotonic_ns: int = 0
    """Wall time less the daemon's monotonic time, ns."""
    grasps: int = 0
    """Number of the run's last grasp before the file."""
    session: SessionState | None = None
    """Statistics of the session, with a grasp that is held; None: the model has no session."""
    trust: bytes = b""
    """State of learning, from `graspd.daemon.trust.trust.encode`; empty without learning."""

    def texts(self) -> dict[str, str]:
        """Return the fields as texts, for a metadata record of MCAP."""
        return {
            name: value if name in _TEXTS else msgspec.json.encode(value).decode()
            for name, value in msgspec.to_builtins(self).items()
        }

    @classmethod
    def of(cls, texts: Mapping[str, str]) -> Self:
        """Return the header in `texts`. Raises `KeyError` or `ValueError`."""
        fields: dict[str, Any] = {name: texts[name] for name in cls.__struct_fields__}
        for name in fields.keys() - _TEXTS:
            fields[name] = msgspec.json.decode(fields[name])
        header = msgspec.convert(fields, cls)
        if not header.fingers or not set(header.fingers) <= set(FINGERS):
            raise ValueError(f"no fingers of a hand: {header.fingers}")
        return header


class RecordingFile:
    """One file that is being written. Methods raise `OSError` if the disk fails."""

    def __init__(self, path: Path) -> None:
        """Create the file, which must not exist."""
        flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC | os.O_NOFOLLOW
        self._path = path
        self._stream = os.fdopen(os.open(path, flags, MODE), "wb")

    def append(self, content: bytes) -> None:
        self._stream.write(content)

    def flush(self) -> int:
        """Write everything to the disk; return the size of the file, bytes."""
        self._stream.flush()
        os.fdatasync(self._stream.fileno())
        return self._stream.tell()

    def close(self) -> None:
        try:
            self.flush()
        finally:
            self.abandon()

    def abandon(self) -> None:
        """Close after an error; buffered bytes may be lost."""
        with contextlib.suppress(OSError):
            self._stream.close()

    def remove(self) -> None:
        self.abandon()
        with contextlib.suppress(OSError):
            self._path.unlink()


class McapWriter(RecordingFile):
    """Writer of one MCAP file."""

    def __init__(self, path: Path, header: RecordingHeader) -> None:
        """Create the file, and write `header`."""
        super().__init__(path)
        self._offset_ns = header.wall_minus_monotonic_ns
        self._writer = Writer(self._stream)
        self._channels: dict[bytes, tuple[int, Iterator[int]]] = {}
        """Number of the channel and numbers of its next messages, by topic."""
        try:
            self._writer.start(profile="", library="graspd")
            self._writer.add_metadata(METADATA, header.texts())
            self.flush()
        except OSError:
            self.remove()
            raise

    def write(self, topic: bytes, payload: bytes, at_ns: int) -> None:
        """Write a message (JSON) of `topic`. `at_ns`: its monotonic time."""
        if topic not in self._channels:
            self._channels[topic] = self._register(topic.decode()), count()
        channel, numbers = self._channels[topic]
        log_ns = max(at_ns + self._offset_ns, 0)
        self._writer.add_message(channel, log_ns, payload, log_ns, next(numbers))

    def _register(self, topic: str) -> int:
        described = schemas().get(topic.partition(".")[0])
        schema = 0
        if described is not None:
            schema = self._writer.register_schema(described[0], "jsonschema", described[1])
        return self._writer.register_channel(topic, "json", schema)

    def flush(self) -> int:
        self._writer.flush()
        return super().flush()

    def close(self) -> None:
        try:
            self._writer.finish()
        except OSError:
            self.abandon()
            raise
        super().close()


class RecordedMessage(NamedTuple):
    """One message of a recording."""

    kind: str
    """First part of the topic: a value of `Topic`, or unknown."""
    at_ns: int
    """Monotonic time of the recording daemon, ns."""
    payload: bytes
    """Content, JSON."""


class McapReader:
    """Reader of one file: the constructor reads the header, iterating the messages. Iterate once.

    The iteration ends where the file is damaged. It raises `RecordingError` if the file unpacks to
    more than any recording of graspd.
    """

    def __init__(self, path: Path, stream: BinaryIO) -> None:
        """`stream`: the opened file. Raises `RecordingError` if graspd did not write it."""
        self._path = path
        self.cut_off = False
        """True if the part read so far ends in a cut or damage."""
        reader = StreamReader(
            stream, emit_chunks=True, validate_crcs=True, record_size_limit=RECORD_MAX_BYTES
        )
        self._records = reader.records
        self._spare_bytes = CHUNK_MAX_BYTES
        """Number of bytes that may still be unpacked."""
        self._kinds: dict[int, str] = {}
        self.header = self._read_header()

    def _read_header(self) -> RecordingHeader:
        try:
            for record in self._records:
                if isinstance(record, Metadata) and record.name == METADATA:
                    return RecordingHeader.of(record.metadata)
                if isinstance(record, Channel | Message | Chunk):
                    break
        except EndOfFile as error:
            raise RecordingError(self._path, "is empty: nothing was recorded") from error
        except _DAMAGE as error:
            raise RecordingError(self._path, f"is no MCAP file: {error}") from error
        except (KeyError, ValueError) as error:
            raise RecordingError(self._path, "is an MCAP file of another graspd") from error
        raise RecordingError(self._path, "is an MCAP file, but not one of graspd's")

    def __iter__(self) -> Iterator[RecordedMessage]:
        offset_ns = self.header.wall_minus_monotonic_ns
        try:
            for record in self._inner_records():
                if isinstance(record, Channel):
                    self._kinds[record.id] = record.topic.partition(".")[0]
                elif isinstance(record, Message):
                    kind = self._kinds.get(record.channel_id, "")
                    yield RecordedMessage(kind, record.log_time - offset_ns, record.data)
        except _DAMAGE:
            self.cut_off = True

    def _inner_records(self) -> Iterator[McapRecord]:
        """Yield all records, also those in chunks."""
        for record in self._records:
            if isinstance(record, Chunk):
                yield from _within(self._unpacked(record))
            else:
                yield record

    def _unpacked(self, chunk: Chunk) -> bytes:
        self._spare_bytes += RATIO_MAX * len(chunk.data)
        room = min(self._spare_bytes, CHUNK_MAX_BYTES)
        content = _unpack(chunk.compression, chunk.data, room + 1)
        if content is None or len(content) > room or chunk.uncompressed_size > CHUNK_MAX_BYTES:
            raise RecordingError(
                self._path,
                "unpacks to more than any recording of graspd: a chunk of "
                f"{len(chunk.data)} bytes to more than {room}",
            )
        if len(content) != chunk.uncompressed_size:
            raise McapError("a chunk is not as long as it says")
        if chunk.uncompressed_crc not in (0, zlib.crc32(content)):
            raise McapError("a chunk is not what it was")
        self._spare_bytes -= len(content)
        return content


def _within(chunk: bytes) -> Iterator[McapRecord]:
    """Yield channels and messages of a chunk one by one; all at once take 100 times its size."""
    stream = ReadDataStream(BytesIO(chunk))
    while stream.count < len(chunk):
        kind, length = stream.read1(), stream.read8()
        if kind == Opcode.CHANNEL:
            yield Channel.read(stream)
        elif kind == Opcode.MESSAGE:
            yield Message.read(stream, length)
        else:
            stream.read(length)


def _unpack(compression: str, content: bytes, max_bytes: int) -> bytes | None:
    """Return at most `max_bytes` of an unpacked chunk; None if its window is larger."""
    unpacked = content
    if compression == "zstd":
        if zstandard.get_frame_parameters(content).window_size > CHUNK_MAX_BYTES:
            return None
        unpacker = zstandard.ZstdDecompressor(max_window_size=CHUNK_MAX_BYTES)
        with unpacker.stream_reader(content) as stream:
            unpacked = stream.read(max_bytes)
    elif compression == "lz4":
        try:
            unpacked = lz4.frame.LZ4FrameDecompressor().decompress(content, max_bytes)
        except RuntimeError as error:
            raise McapError(str(error)) from error
    elif compression:
        raise UnsupportedCompressionError(compression)
    return unpacked


def header_of(path: Path) -> RecordingHeader:
    """Return the header of a file. Raises `RecordingError`."""
    with open_recording(path) as stream:
        return McapReader(path, stream).header
