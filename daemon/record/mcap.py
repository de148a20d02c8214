"""Recordings of the daemon: MCAP files, read from front to end, as far as they were written.

A file of `graspd run` that was cut off has no summary at its end, so none is looked for. Needs the
package `mcap` (extra `record`).
"""

from __future__ import annotations

import json
import struct
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO, Final

import zstandard
from mcap.exceptions import EndOfFile, McapError
from mcap.records import Channel, Message, Metadata
from mcap.stream_reader import CRCValidationError, StreamReader

from drivers.base import FINGERS, RecordingError
from drivers.recordings.csv_rows import open_recording

METADATA = "graspd"
"""Name of the metadata record that every file of graspd begins with."""
ASKED: Final = "asked"
"""Kind of the message that the controller has asked for a judgement."""
EXCHANGED: Final = "exchanged"
"""Kind of the message that a sensor is another one than before."""
SKIPPED: Final = "skipped"
"""Kind of the message that readings were left out before the next one."""
EVENTS: Final = frozenset({ASKED, EXCHANGED, SKIPPED})
"""Kinds of messages without content of their own, that matter to what is judged."""
RECORD_MAX_BYTES = 64 << 20
"""graspd's chunks have a megabyte; what says to be far longer is damaged."""

_DAMAGE = (
    *(McapError, CRCValidationError, struct.error, zstandard.ZstdError, UnicodeDecodeError),
    *(OverflowError, MemoryError),
)
"""What the library raises for bytes that are no MCAP, or that were cut off; the last two for a
length that nothing has."""


@dataclass(frozen=True, slots=True)
class RecordingHeader:
    """What a file says about the daemon that wrote it."""

    fingers: tuple[str, ...]
    """Rows of a reading."""
    joints: bool
    """Whether the hand had joint angles."""
    boot_id: str
    wall_minus_monotonic_ns: int
    """Log times are wall time; less this they are the daemon's monotonic time, ns."""
    texts: Mapping[str, str]
    """All that it says, as it stands there."""


@dataclass(frozen=True, slots=True)
class RecordedMessage:
    """One message of a file."""

    kind: str
    """First part of the topic, such as `tactile`."""
    at_ns: int
    """The daemon's monotonic time when it was recorded, ns."""
    payload: bytes


class McapRecording:
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
        self._topics: dict[int, str] = {}
        self.header = self._read_header()

    def _read_header(self) -> RecordingHeader:
        try:
            for record in self._records:
                if isinstance(record, Metadata) and record.name == METADATA:
                    return _header(record.metadata)
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
                    self._topics[record.id] = record.topic.partition(".")[0]
                elif isinstance(record, Message):
                    kind = self._topics.get(record.channel_id, "")
                    yield RecordedMessage(kind, record.log_time - offset_ns, record.data)
        except _DAMAGE:
            self.cut_off = True


def header_of(path: Path) -> RecordingHeader:
    """What a file says about itself. Raises `RecordingError`."""
    with open_recording(path) as stream:
        return McapRecording(path, stream).header


def _header(texts: Mapping[str, str]) -> RecordingHeader:
    fingers = tuple(json.loads(texts["fingers"]))
    if not fingers or not set(fingers) <= set(FINGERS):
        raise ValueError(f"no fingers of a hand: {fingers}")
    return RecordingHeader(
        fingers=fingers,
        joints=texts["joints"] == "true",
        boot_id=texts["boot_id"],
        wall_minus_monotonic_ns=int(texts["wall_minus_monotonic_ns"]),
        texts=dict(texts),
    )
