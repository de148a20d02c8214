"""Recorded serial bytes through the decoder of the bridge."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

from drivers.base import Reading
from drivers.link import LinkState
from drivers.recordings.csv_rows import open_recording
from drivers.recordings.serial_file import RawParser, RawRecord, Way
from drivers.spi.driver import SpiBridgeDriver
from drivers.spi.messages import Ping, decode, frame_parser

CHUNK_BYTES = 65_536


class SerialCapture(SpiBridgeDriver):
    """The driver of the bridge, fed by hand: it opens no port and its clock is that of the file.

    What the daemon asked the bridge then is in the file, so nothing is asked now.
    """

    def __init__(self, fingers: Sequence[str], sensors: Sequence[str] | None = None) -> None:
        """As `SpiBridgeDriver`. Raises `ValueError`."""
        self._now_ns = 0
        super().__init__("capture", fingers, sensors=sensors, clock=self._now)
        self._sent = frame_parser()

    def _now(self) -> int:
        return self._now_ns

    def begin(self) -> None:
        """Forget all that came."""
        self.open()
        self._sent = frame_parser()

    def close(self) -> None:
        """Nothing is open."""
        self._link.close()

    def _connect(self) -> None:
        self._forget_session()
        self._link.greeting()

    def _ping(self) -> None:
        pass

    def _send(self, data: bytes) -> bool:
        return bool(data)

    def feed(self, t_ns: int, record: object) -> Sequence[Reading]:
        """The readings that one record completes."""
        if not isinstance(record, RawRecord):
            return ()
        self._now_ns = t_ns
        if record.way is Way.OPENED:
            self._connect()
        elif record.way is Way.SENT:
            self._note_sent(record.data, t_ns)
        elif self._link.state is not LinkState.WAITING:
            readings = self._take(record.data, t_ns)
            self._idle_ns = t_ns
            return readings
        return ()

    def _note_sent(self, data: bytes, t_ns: int) -> None:
        for kind, payload in self._sent.feed(data):
            message = decode(kind, payload)
            if isinstance(message, Ping):
                self._pings[message.nonce] = t_ns


def records_of(path: Path) -> Iterator[tuple[int, RawRecord]]:
    """Times, ns, and records of a file; what is damaged is passed over. Raises `RecordingError`."""
    parser = RawParser()
    with open_recording(path) as stream:
        while chunk := stream.read(CHUNK_BYTES):
            for record in parser.feed(chunk):
                yield record.t_ns, record
