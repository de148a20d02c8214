"""Read the MCAP files of recordings, in the order of log time. Needs the extra `record`.

Other tools cut and pack such files again: the metadata of graspd may stand anywhere or nowhere.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator, Sequence
from dataclasses import replace
from operator import attrgetter
from pathlib import Path
from typing import BinaryIO, Final, NamedTuple, TypeGuard

import lz4.frame
import zstandard
from mcap.exceptions import EndOfFile, McapError, UnsupportedCompressionError
from mcap.records import Channel, Chunk, McapRecord, Message, Metadata
from mcap.stream_reader import CRCValidationError, StreamReader, breakup_chunk

from graspd.daemon.record.mcap import METADATA, RecordingHeader
from graspd.drivers.base import RecordingError
from graspd.drivers.recordings.kinds import open_recording

RECORD_MAX_BYTES: Final = 64 << 20
"""Largest record, bytes; a longer one is damaged."""
CHUNK_MAX_BYTES: Final = 8 << 20
"""Largest unpacked chunk, bytes; graspd writes 1 MB, other tools 4 MB."""
RATIO_MAX: Final = 100
"""Largest ratio of unpacked to packed bytes; held grasps have 12, zeros 36."""
NO_HEADER: Final = (
    "has no record `graspd`: it is of another program, or has lost it (`mcap filter` needs "
    "--include-metadata)"
)
SEVERAL: Final = "is of several recordings put together: replay each alone"
UNSORTED: Final = "is not in the order of time: `mcap sort` puts it in order"

_DAMAGE = (
    *(McapError, CRCValidationError, struct.error, zstandard.ZstdError, UnicodeDecodeError),
    *(OverflowError, MemoryError, OSError),
)
"""Exceptions for a damaged file; huge lengths cause `OverflowError` and `MemoryError`."""


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

    Messages come in the order of their log time; those of one time in the order of the file. The
    iteration ends where the file is damaged. It raises `RecordingError` if the file unpacks to
    more than any recording of graspd, is of several recordings, or is not in the order of time.
    """

    def __init__(self, path: Path, stream: BinaryIO) -> None:
        """`stream`: the opened file. Raises `RecordingError` if graspd did not write it."""
        self.path, self._stream = path, stream
        self._damage: Exception | None = None
        headers = (self._header_in(record) for record in self._records() if _is_header(record))
        header = next(headers, None)
        if header is None:
            raise self._why_not()
        self.header: RecordingHeader = header

    @property
    def cut_off(self) -> bool:
        """True if the part read so far ends in a cut or damage."""
        return self._damage is not None

    def _records(self) -> Iterator[McapRecord]:
        """Yield the records from the start of the file to its end or damage."""
        self._damage = None
        self._stream.seek(0)
        reader = StreamReader(
            self._stream, emit_chunks=True, validate_crcs=True, record_size_limit=RECORD_MAX_BYTES
        )
        try:
            yield from reader.records
        except _DAMAGE as error:
            self._damage = error

    def _header_in(self, record: Metadata) -> RecordingHeader:
        try:
            return RecordingHeader.of(record.metadata)
        except ValueError as error:
            raise RecordingError(self.path, "is an MCAP file of another graspd") from error

    def _why_not(self) -> RecordingError:
        """Return what a file without a header is."""
        if isinstance(self._damage, EndOfFile):
            return RecordingError(self.path, "is empty: nothing was recorded")
        if self._damage is not None:
            return RecordingError(self.path, f"is no MCAP file: {self._damage}")
        return RecordingError(self.path, NO_HEADER)

    def __iter__(self) -> Iterator[RecordedMessage]:
        offset_ns = self.header.wall_minus_monotonic_ns
        kinds: dict[int, str] = {}
        """First parts of the topics by channel."""
        spare_bytes, last_ns = CHUNK_MAX_BYTES, 0
        for record in self._records():
            if _is_header(record) and self._header_in(record) != self.header:
                raise RecordingError(self.path, SEVERAL)
            records: Sequence[McapRecord] = (record,)
            try:
                if isinstance(record, Chunk):
                    spare_bytes += RATIO_MAX * len(record.data)
                    records = self._unpacked(record, min(spare_bytes, CHUNK_MAX_BYTES))
                    spare_bytes -= record.uncompressed_size
                kinds |= {each.id: _kind(each) for each in records if isinstance(each, Channel)}
                messages = [each for each in records if isinstance(each, Message)]
                for message in sorted(messages, key=attrgetter("log_time")):
                    if message.log_time < last_ns:
                        raise RecordingError(self.path, UNSORTED)
                    last_ns = message.log_time
                    if message.channel_id not in kinds:
                        raise McapError("a message is of a channel that is not known")
                    kind = kinds[message.channel_id]
                    yield RecordedMessage(kind, last_ns - offset_ns, message.data)
            except _DAMAGE as error:
                self._damage = error
                return

    def _unpacked(self, chunk: Chunk, room: int) -> list[McapRecord]:
        """Return the records of a chunk of at most `room` bytes. Raises `RecordingError`."""
        content = _unpack(chunk.compression, chunk.data, room + 1)
        if content is None or len(content) > room or chunk.uncompressed_size > CHUNK_MAX_BYTES:
            raise RecordingError(
                self.path,
                "unpacks to more than any recording of graspd: a chunk of "
                f"{len(chunk.data)} bytes to more than {room}",
            )
        if len(content) != chunk.uncompressed_size:
            raise McapError("a chunk is not as long as it says")
        return breakup_chunk(replace(chunk, compression="", data=content), validate_crc=True)


def _is_header(record: McapRecord) -> TypeGuard[Metadata]:
    return isinstance(record, Metadata) and record.name == METADATA


def _kind(channel: Channel) -> str:
    return channel.topic.partition(".")[0]


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
