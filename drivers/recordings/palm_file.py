"""Play a file of palm packets without times: the palm made one each millisecond."""

from __future__ import annotations

import functools
import os
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import BinaryIO, Final

from graspd.drivers.base import Reading, RecordingError
from graspd.drivers.palm.packet import CYCLE_NS, PALM_OF_LENGTH, PalmCounters, parse_packet
from graspd.drivers.palm.stream import PalmStream
from graspd.drivers.recordings.csv_rows import open_recording
from graspd.drivers.recordings.player import LinkLogDriver

PACKETS_TRIED: Final = 64
"""Number of packets by which the packet length of a file is found."""
SENSE_MIN: Final = 0.5
"""Smallest share of them that must hold sensor data."""


class PalmFile(LinkLogDriver[bytes]):
    """Play packets through the driver's `PalmStream`, in real time."""

    stream: PalmStream

    def __init__(
        self,
        path: Path,
        fingers: Sequence[str] = ("ff", "mf", "th"),
        *,
        calibration: Path | None = None,
        heed_finger_bits: bool = True,
        clock: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        """Take the arguments of `PalmStream`; `begin` reads the file."""
        super().__init__([path], 1.0, clock)
        self._calibration = calibration
        self._make_stream = functools.partial(
            PalmStream, fingers, heed_finger_bits=heed_finger_bits
        )
        self.stream = self._make_stream()

    def records(self, path: Path) -> Iterator[tuple[int, bytes]]:
        """Yield time, ns since the first, and packet. Raises `RecordingError` at once."""
        with open_recording(path) as file:
            length = _packet_bytes(path, file)
        return _packets(path, length)

    def begin(self) -> None:
        """Start with a new stream. Raises `CalibrationError`."""
        self.stream = self._make_stream(calibration=self._calibration)

    def feed(self, t_ns: int, record: bytes) -> Sequence[Reading]:
        return self.stream.receive(record, t_ns) or ()


def _packets(path: Path, length: int) -> Iterator[tuple[int, bytes]]:
    at_ns = 0
    with open_recording(path) as file:
        while packet := file.read(length):
            yield at_ns, packet
            at_ns += CYCLE_NS


def _packet_bytes(path: Path, file: BinaryIO) -> int:
    """Return the packet length with which most of the first packets hold sensor data."""
    head = file.read(PACKETS_TRIED * max(PALM_OF_LENGTH))
    size = os.fstat(file.fileno()).st_size
    scores = {
        length: (_share_of_sense(head, length), size % length == 0) for length in PALM_OF_LENGTH
    }
    best = max(scores, key=lambda length: scores[length])
    if scores[best][0] < SENSE_MIN or list(scores.values()).count(scores[best]) > 1:
        raise RecordingError(path, "this is not a file of palm packets of one known length")
    return best


def _share_of_sense(head: bytes, length: int) -> float:
    """Return the share of packets in `head` that hold sensor data, with this length."""
    counters = PalmCounters()
    starts = range(0, min(len(head), PACKETS_TRIED * length) - length + 1, length)
    for start in starts:
        parse_packet(head[start : start + length], counters)
    return counters.packets / max(len(starts), 1)
