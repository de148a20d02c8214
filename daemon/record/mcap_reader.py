"""Read the MCAP files of recordings, in the order of log time. Needs the extra `record`.

Other tools may have sorted, cut or repacked a file. Its messages may stand in any order, and the
metadata of graspd anywhere or nowhere.
"""

from __future__ import annotations

import heapq
import shutil
import struct
import zlib
from array import array
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from tempfile import TemporaryFile
from typing import BinaryIO, Final, NamedTuple, Self

import lz4.frame
import msgspec
import numpy as np
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import EndOfFile, McapError, UnsupportedCompressionError
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, Message, Metadata
from mcap.stream_reader import MAGIC_SIZE, CRCValidationError, StreamReader

from graspd.biotac import Finger
from graspd.daemon.record.mcap import METADATA, RecordingHeader
from graspd.daemon.record.topics import MALFORMED, Topic
from graspd.drivers.base import RecordingError
from graspd.drivers.recordings.kinds import PAGE, is_packed, open_recording

RECORD_MAX_BYTES: Final = 64 << 20
"""Largest record, bytes; a longer one is damaged."""
CHUNK_MAX_BYTES: Final = 8 << 20
"""Largest unpacked chunk, bytes; graspd writes 1 MB, other tools 4 MB."""
LOOSE_MAX_BYTES: Final = 1 << 20
"""Size at which consecutive messages outside of chunks become a new part, bytes."""
OPEN_MAX_BYTES: Final = 128 << 20
"""Most unpacked bytes of parts that are open at once, because their times overlap. A file with one
part for each topic needs a tenth of it."""
PARTS_MAX: Final = 100_000
"""Most parts of a file; an hour has 4,400, one for each flush."""
RATIO_MAX: Final = 100
"""Largest ratio of unpacked to packed bytes; a recorded hold has 12, zeros have 36."""
SEVERAL: Final = "is of several recordings put together: replay each alone"

_DAMAGE = (
    *(McapError, CRCValidationError, struct.error, zstandard.ZstdError, UnicodeDecodeError),
    *(OverflowError, MemoryError, OSError),
)
"""Exceptions for a damaged file; huge lengths cause `OverflowError` and `MemoryError`."""
_MESSAGE: Final = struct.Struct("<HIQQ")
"""Channel, number, log time and publish time, before the content of a message."""


class RecordedMessage(NamedTuple):
    """One message of a recording."""

    kind: str
    """First part of the topic: a value of `Topic`, or any other text."""
    at_ns: int
    """Time when it was recorded, on the monotonic clock of the recording daemon, ns."""
    payload: bytes
    """Content, JSON."""


@dataclass(slots=True)
class _Part:
    """Messages that stand together: a chunk, or messages outside of chunks."""

    begin_ns: int
    """Log time of the oldest message, ns."""
    place: int
    """First byte of the content in the file."""
    length: int
    compression: str = ""
    unpacked_bytes: int = 0
    """Size of a chunk once unpacked."""
    crc: int = 0
    """CRC-32 of the unpacked content; 0: not known."""

    @classmethod
    def of(cls, chunk: Chunk, end: int) -> Self:
        """Return the part of a chunk whose record ends at byte `end`."""
        return cls(
            begin_ns=chunk.message_start_time,
            place=end - len(chunk.data),
            length=len(chunk.data),
            compression=chunk.compression,
            unpacked_bytes=chunk.uncompressed_size,
            crc=chunk.uncompressed_crc,
        )


class _Content:
    """The messages of an unpacked part, oldest first."""

    def __init__(self, content: bytes, kinds: dict[int, str]) -> None:
        """`kinds`: first parts of the topics by channel; those in the content are added."""
        self._content, self._kinds = content, kinds
        places, times_ns = array("q"), array("Q")
        stream = ReadDataStream(BytesIO(content))
        while stream.count < len(content):
            kind, length = stream.read1(), stream.read8()
            if kind == Opcode.CHANNEL:
                _note(Channel.read(stream), kinds)
                continue
            if kind == Opcode.MESSAGE:
                places.extend((stream.count, length))
                times_ns.append(_MESSAGE.unpack_from(content, stream.count)[2])
            stream.read(length)
        self.size = len(content)
        self._places, self._times_ns = places, times_ns
        order = np.argsort(np.frombuffer(times_ns, dtype=np.uint64), kind="stable")
        self._order: Iterator[int] = iter(array("q", order.tobytes()))
        self._next = next(self._order, None)

    @property
    def next_ns(self) -> int | None:
        """Log time of the next message, ns; None: there is none."""
        return None if self._next is None else self._times_ns[self._next]

    def take(self, offset_ns: int) -> RecordedMessage:
        """Return the next message; `offset_ns`: log time less monotonic time."""
        number = self._next or 0
        self._next = next(self._order, None)
        place, length = self._places[2 * number : 2 * number + 2]
        channel, _, log_ns, _ = _MESSAGE.unpack_from(self._content, place)
        if channel not in self._kinds:
            raise McapError("a message is of a channel that is not known")
        payload = self._content[place + _MESSAGE.size : place + length]
        return RecordedMessage(self._kinds[channel], log_ns - offset_ns, payload)


class McapReader:
    """Reader of one file: `header` is read at once; iterate over the reader once for messages.

    Messages come in the order of their log time; those of one time in the order of the file. The
    iteration ends where the file is damaged. It raises `RecordingError` if the file unpacks to
    more than any recording of graspd, or is of several recordings.
    """

    def __init__(self, path: Path, stream: BinaryIO) -> None:
        """`stream`: the opened file. Raises `RecordingError` if graspd did not write it."""
        self.path, self._stream = path, stream
        self._parts: list[_Part] = []
        self._loose_end = 0
        """First byte after the last message outside of chunks."""
        self._spare_bytes = CHUNK_MAX_BYTES
        """Number of bytes that may still be unpacked."""
        self._kinds: dict[int, str] = {}
        self._damage: Exception | None = None
        self._scan = self._find_parts()
        header = next(self._scan, None)
        self.header: RecordingHeader = header or self._header_of_messages()

    @property
    def cut_off(self) -> bool:
        """True if the part read so far ends where the file is truncated or damaged."""
        return self._damage is not None

    def __iter__(self) -> Iterator[RecordedMessage]:
        for other in self._scan:
            if other != self.header:
                raise RecordingError(self.path, SEVERAL)
        yield from self._messages(self.header.wall_minus_monotonic_ns)

    def _find_parts(self) -> Iterator[RecordingHeader]:
        """Read the file once, and note where its messages are; yield each header in it."""
        begin, stream = 0, self._stream
        reader = StreamReader(
            stream, emit_chunks=True, validate_crcs=True, record_size_limit=RECORD_MAX_BYTES
        )
        try:
            for record in reader.records:
                end = stream.tell()
                if isinstance(record, Metadata) and record.name == METADATA:
                    yield self._header_in(record)
                elif isinstance(record, Channel):
                    _note(record, self._kinds)
                elif isinstance(record, Chunk):
                    self._parts.append(_Part.of(record, end))
                elif isinstance(record, Message):
                    self._add_loose(record.log_time, begin, end)
                if len(self._parts) > PARTS_MAX:
                    raise RecordingError(self.path, f"has more than {PARTS_MAX} chunks")
                begin = end
        except _DAMAGE as error:
            self._damage = error

    def _header_in(self, record: Metadata) -> RecordingHeader:
        try:
            return RecordingHeader.of(record.metadata)
        except MALFORMED as error:
            raise RecordingError(self.path, "is an MCAP file of another graspd") from error

    def _add_loose(self, log_ns: int, begin: int, end: int) -> None:
        """Add a message outside of chunks, whose record is from `begin` to `end`."""
        last = self._parts[-1] if begin == self._loose_end else None
        self._loose_end = end
        if last is None or last.length >= LOOSE_MAX_BYTES:
            self._parts.append(_Part(log_ns, begin, end - begin, unpacked_bytes=end - begin))
            return
        last.begin_ns = min(last.begin_ns, log_ns)
        last.length = last.unpacked_bytes = end - last.place

    def _header_of_messages(self) -> RecordingHeader:
        """Return the header that the messages imply. Raises `RecordingError`."""
        damage, implied = self._damage, _Implied()
        for message in self._messages(0):
            implied.take(message)
        self._spare_bytes = CHUNK_MAX_BYTES
        if implied.fingers:
            return implied.header()
        if isinstance(damage, EndOfFile) and self._stream.tell() <= MAGIC_SIZE:
            raise RecordingError(self.path, "is empty: nothing was recorded") from damage
        if damage is not None:
            problem = "is damaged or cut off: nothing in it can be read"
            raise RecordingError(self.path, problem) from damage
        problem = f"is an MCAP file, but not one of graspd's; {PAGE} lists what graspd reads"
        raise RecordingError(self.path, problem)

    def _messages(self, offset_ns: int) -> Iterator[RecordedMessage]:
        """Yield the messages of all parts; `offset_ns`: log time less monotonic time."""
        parts = sorted(self._parts, key=lambda part: (part.begin_ns, part.place), reverse=True)
        with self._in_order_of(parts):
            yield from self._merged(parts, offset_ns)

    @contextmanager
    def _in_order_of(self, parts: Sequence[_Part]) -> Iterator[None]:
        """Unpack a compressed file into a temporary one if its parts must be read out of order.
        Each step back in a compressed stream would otherwise begin at its start."""
        places = [part.place for part in reversed(parts)]
        if places == sorted(places) or not is_packed(self.path):
            yield
            return
        packed = self._stream
        with TemporaryFile() as self._stream:
            packed.seek(0)
            with suppress(OSError):  # damage was noted before
                shutil.copyfileobj(packed, self._stream)
            yield
        self._stream = packed

    def _merged(self, parts: list[_Part], offset_ns: int) -> Iterator[RecordedMessage]:
        """Yield the messages of `parts`, by time. `parts`: the oldest last; the list is emptied."""
        opened: list[tuple[int, int, _Content]] = []
        now_ns = 0
        try:
            while parts or opened:
                if parts and (not opened or (parts[-1].begin_ns, parts[-1].place) < opened[0][:2]):
                    self._open(parts.pop(), opened)
                    continue
                log_ns, place, content = opened[0]
                if log_ns < now_ns:
                    raise McapError("a chunk has messages from before its own time")
                now_ns = log_ns
                yield content.take(offset_ns)
                next_ns = content.next_ns
                if next_ns is None:
                    heapq.heappop(opened)
                else:
                    heapq.heapreplace(opened, (next_ns, place, content))
        except _DAMAGE as error:
            self._damage = error

    def _open(self, part: _Part, opened: list[tuple[int, int, _Content]]) -> None:
        """Unpack a part onto the heap `opened`. Raises `RecordingError` if too much is open."""
        content = _Content(self._unpacked(part), self._kinds)
        if content.next_ns is not None:
            heapq.heappush(opened, (content.next_ns, part.place, content))
        if sum(each.size for _, _, each in opened) > OPEN_MAX_BYTES:
            raise RecordingError(
                self.path, "is too far from the order of time: `mcap sort` puts it in order"
            )

    def _unpacked(self, part: _Part) -> bytes:
        self._spare_bytes += RATIO_MAX * part.length
        room = min(self._spare_bytes, CHUNK_MAX_BYTES)
        self._stream.seek(part.place)
        packed = self._stream.read(part.length)
        content = _unpack(part.compression, packed, room + 1)
        if content is None or len(content) > room or part.unpacked_bytes > CHUNK_MAX_BYTES:
            raise RecordingError(
                self.path,
                "unpacks to more than any recording of graspd: a chunk of "
                f"{part.length} bytes to more than {room}",
            )
        if len(content) != part.unpacked_bytes:
            raise McapError("a chunk is not as long as it says")
        if part.crc not in (0, zlib.crc32(content)):
            raise McapError("a chunk is not what it was")
        self._spare_bytes -= len(content)
        return content


class _Made(msgspec.Struct):
    """Fields of a `tactile` message from which the header is made."""

    boot_id: str
    t_mono_ns: int
    fingers: tuple[Finger, ...]


class _Judge(msgspec.Struct):
    """Fields of a `verdict` message from which the header is made."""

    model: str
    model_sha: str


@dataclass(slots=True)
class _Implied:
    """Header of a recording that lacks one, computed from its messages."""

    fingers: tuple[Finger, ...] = ()
    joints: bool = False
    boot_id: str = ""
    offset_ns: int = 0
    """Smallest difference of log time and the time of a reading, ns."""
    model: tuple[str, str] = ("", "")

    def take(self, message: RecordedMessage) -> None:
        """Take in a message whose `at_ns` is the log time. A malformed one is ignored."""
        try:
            if message.kind == Topic.TACTILE:
                made = msgspec.json.decode(message.payload, type=_Made)
                offset_ns = message.at_ns - made.t_mono_ns
                self.offset_ns = min(offset_ns, self.offset_ns) if self.fingers else offset_ns
                self.fingers, self.boot_id = made.fingers, made.boot_id
            elif message.kind == Topic.VERDICT and not self.model[0]:
                judge = msgspec.json.decode(message.payload, type=_Judge)
                self.model = judge.model, judge.model_sha
        except MALFORMED:
            return
        self.joints = self.joints or message.kind == Topic.JOINTS

    def header(self) -> RecordingHeader:
        """Return a header without a scene."""
        model, digest = self.model
        return RecordingHeader(
            fingers=self.fingers,
            joints=self.joints,
            boot_id=self.boot_id,
            scene={},
            model=model,
            model_sha256=digest,
            wall_minus_monotonic_ns=self.offset_ns,
        )


def _note(channel: Channel, kinds: dict[int, str]) -> None:
    kinds[channel.id] = channel.topic.partition(".")[0]


def _unpack(compression: str, content: bytes, max_bytes: int) -> bytes | None:
    """Return up to `max_bytes` of an unpacked chunk; None if zstd needs over `CHUNK_MAX_BYTES`."""
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
