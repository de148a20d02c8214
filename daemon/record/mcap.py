"""MCAP files of the daemon: written chunk by chunk, read as far as they were written.

A file that was cut off has no summary at its end, so the reader looks for none. Needs the package
`mcap` (extra `record`).
"""

from __future__ import annotations

import contextlib
import json
import os
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from itertools import count
from pathlib import Path
from typing import Any, BinaryIO, Final

import msgspec
import zstandard
from mcap.exceptions import EndOfFile, McapError
from mcap.records import Channel, Message, Metadata
from mcap.stream_reader import CRCValidationError, StreamReader
from mcap.writer import Writer

from daemon.record.files import create
from daemon.record.header import RecordingHeader
from daemon.record.topics import Topic
from drivers.base import RecordingError
from drivers.recordings.csv_rows import open_recording

METADATA: Final = "graspd"
"""Name of the metadata record that every file of graspd begins with."""
RECORD_MAX_BYTES: Final = 64 << 20
"""graspd's chunks have a megabyte; what says to be far longer is damaged."""

_DAMAGE = (
    *(McapError, CRCValidationError, struct.error, zstandard.ZstdError, UnicodeDecodeError),
    *(OverflowError, MemoryError),
)
"""What the library raises for bytes that are no MCAP, or that were cut off; the last two for a
length that nothing has."""


@cache
def schemas() -> dict[str, tuple[str, bytes]]:
    """Name and JSON Schema, an object at the top, of each topic that is no event."""
    messages = {topic: topic.message for topic in Topic if topic.message is not None}
    definitions = msgspec.json.schema_components(messages.values())[1]
    found = {}
    for topic, message in messages.items():
        whole: dict[str, Any] = {**definitions[message.__name__], "$defs": definitions}
        found[topic.value] = f"graspd.{message.__name__}", json.dumps(whole).encode()
    return found


class McapWriter:
    """One file being written. All methods raise `OSError` when there is no room."""

    def __init__(self, path: Path, header: RecordingHeader) -> None:
        """Make the file, which must not be there yet; `header` stands in front."""
        self._path = path
        self._stream = create(path)
        self._offset_ns = header.wall_minus_monotonic_ns
        self._writer = Writer(self._stream)
        self._channels: dict[bytes, tuple[int, Iterator[int]]] = {}
        """Number of each topic's channel, and the numbers of its messages."""
        try:
            self._writer.start(profile="", library="graspd")
            self._writer.add_metadata(METADATA, header.texts())
            self.flush()
        except OSError:
            self.remove()
            raise

    def write(self, topic: bytes, payload: bytes, at_ns: int) -> None:
        """Take one message of monotonic time `at_ns`, ns."""
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
        """End the chunk at hand, and have the disk keep it; the file's size then, bytes."""
        self._writer.flush()
        os.fdatasync(self._stream.fileno())
        return self._stream.tell()

    def close(self) -> None:
        """Write the summary and close."""
        try:
            self._writer.finish()
            self.flush()
        finally:
            self.abandon()

    def abandon(self) -> None:
        """Close as it is."""
        with contextlib.suppress(OSError):  # what is buffered finds no room either
            self._stream.close()

    def remove(self) -> None:
        """Close, and remove the file: there is nothing in it."""
        self.abandon()
        with contextlib.suppress(OSError):
            self._path.unlink()


@dataclass(frozen=True, slots=True)
class RecordedMessage:
    """One message of a file."""

    kind: str
    """First part of the topic's name: a `Topic`, or one of another version."""
    at_ns: int
    """The daemon's monotonic time when it was recorded, ns."""
    payload: bytes


class McapReader:
    """One file: iterate once, then `cut_off` says whether it ends as it should.

    The constructor raises `RecordingError` for a file that is none of graspd's. What is damaged
    ends the iteration as if the file ended there.
    """

    def __init__(self, path: Path, stream: BinaryIO) -> None:
        """Read the beginning of `stream`, the opened file."""
        self.path = path
        self.cut_off = False
        """After iterating: whether the file has no end, or is damaged."""
        reader = StreamReader(stream, validate_crcs=True, record_size_limit=RECORD_MAX_BYTES)
        self._records = reader.records
        self._kinds: dict[int, str] = {}
        self.header = self._read_header()

    def _read_header(self) -> RecordingHeader:
        try:
            for record in self._records:
                if isinstance(record, Metadata) and record.name == METADATA:
                    return RecordingHeader.of(record.metadata)
                if isinstance(record, Channel | Message):
                    break
        except EndOfFile as error:
            raise RecordingError(self.path, "is empty: nothing was recorded") from error
        except _DAMAGE as error:
            raise RecordingError(self.path, f"is no MCAP file: {error}") from error
        except (KeyError, ValueError) as error:
            raise RecordingError(self.path, "is an MCAP file of another graspd") from error
        raise RecordingError(self.path, "is an MCAP file, but not one of graspd's")

    def __iter__(self) -> Iterator[RecordedMessage]:
        offset_ns = self.header.wall_minus_monotonic_ns
        try:
            for record in self._records:
                if isinstance(record, Channel):
                    self._kinds[record.id] = record.topic.partition(".")[0]
                elif isinstance(record, Message):
                    kind = self._kinds.get(record.channel_id, "")
                    yield RecordedMessage(kind, record.log_time - offset_ns, record.data)
        except _DAMAGE:
            self.cut_off = True


def header_of(path: Path) -> RecordingHeader:
    """What a file says about itself. Raises `RecordingError`."""
    with open_recording(path) as stream:
        return McapReader(path, stream).header
