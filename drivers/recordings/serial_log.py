"""The link log of a serial line: its bytes with their times.

Each record is a frame of `graspd.drivers.spi.messages`, so a reader finds the next one after any
damage. Type 1: bytes from the device. Type 2: bytes to it. Type 3: the port was opened. The payload
is `t: u64` (monotonic ns) and the bytes.
"""

from __future__ import annotations

import logging
import struct
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Final

from graspd.drivers.base import Reading
from graspd.drivers.link import LinkState
from graspd.drivers.recordings.kinds import open_recording
from graspd.drivers.recordings.player import LinkLogDriver, within_limits
from graspd.drivers.spi.conversation import Conversation, LineEvent
from graspd.drivers.spi.messages import FrameCounters, FrameParser, encode_frame

PIECE_MAX_BYTES: Final = 960
"""Most bytes of one record; a frame has at most 1024. Longer reads take several records."""

CHUNK_BYTES: Final = 4096

_TIME: Final = struct.Struct("<Q")
_EVENTS: Final = frozenset(event.value for event in LineEvent)

_log = logging.getLogger(__name__)

Record = tuple[LineEvent, bytes]
"""An event on the line, and the bytes of one read or write."""


def encode_records(event: LineEvent, t_ns: int, data: bytes) -> bytes:
    """Return the records of one event on the line."""
    head = _TIME.pack(t_ns)
    starts = range(0, max(len(data), 1), PIECE_MAX_BYTES)
    return b"".join(
        encode_frame(event, head + data[start : start + PIECE_MAX_BYTES]) for start in starts
    )


def parse_records(parser: FrameParser, chunk: bytes) -> Iterator[tuple[int, Record]]:
    """Yield monotonic time, ns, and content of each record that `chunk` completes. Never raises."""
    for kind, payload in parser.feed(chunk):
        if kind in _EVENTS and len(payload) >= _TIME.size:
            (t_ns,) = _TIME.unpack_from(payload)
            yield t_ns, (LineEvent(kind), payload[_TIME.size :])


def _damaged(counters: FrameCounters) -> int:
    return counters.bad_cobs + counters.bad_crc + counters.too_long


class SerialLog(LinkLogDriver[Record]):
    """Play serial link logs through the driver's `Conversation`; nothing is sent."""

    stream: Conversation

    def __init__(
        self,
        paths: Sequence[Path],
        fingers: Sequence[str],
        sensors: Sequence[str] | None = None,
        *,
        speed: float | None = None,
    ) -> None:
        """`fingers`, `sensors`: as in `Conversation`. `speed`: factor of real time; None: as
        fast as possible."""
        super().__init__(paths, speed)
        self._fingers, self._sensors = fingers, sensors
        self.begin()

    def records(self, path: Path) -> Iterator[tuple[int, Record]]:
        parser, first_end = FrameParser(), 0
        with open_recording(path) as stream:
            while chunk := stream.read(CHUNK_BYTES):
                for t_ns, record in parse_records(parser, chunk):
                    yield within_limits(path, t_ns), record
                if not first_end and _damaged(parser.counters):
                    first_end = parser.counters.bytes
        if damaged := _damaged(parser.counters):
            total = damaged + parser.counters.frames
            text = "%s: %d of %d records were damaged; the first is before byte %d"
            _log.warning(text, path, damaged, total, first_end)

    def begin(self) -> None:
        self.stream = Conversation("link log", self._fingers, self._sensors)

    def feed(self, t_ns: int, record: Record) -> Sequence[Reading]:
        event, data = record
        conversation = self.stream
        if event is LineEvent.OPENED or conversation.link.state is LinkState.CLOSED:
            if conversation.link.state is not LinkState.WAITING:  # else a retry
                conversation.link.start(t_ns)
            conversation.opened(t_ns)
        if event is LineEvent.SENT:
            conversation.sent(data, t_ns)
            return ()
        if conversation.link.state is LinkState.WAITING:
            return ()
        return conversation.receive(data, t_ns)
