"""A file of palm packets, nothing but one after the other, played as a driver in real time."""

from __future__ import annotations

import functools
import os
import stat
import time
from collections.abc import Callable, Generator, Sequence
from pathlib import Path
from typing import BinaryIO, Final

from drivers.base import Fact, Reading, RecordingError
from drivers.palm.packet import CYCLE_NS, PALM_OF_LENGTH, PalmCounters, PalmParser
from drivers.palm.rounds import ROUND_NS
from drivers.palm.stream import PalmStream
from drivers.recordings.player import RecordedDriver, Timeline

PACKETS_TRIED: Final = 64
"""Packets by which the length is told."""
PACKETS_AT_ONCE: Final = 256
"""Packets taken at once at most, when the loop was away."""


class PalmFileDriver(RecordedDriver[bytes]):
    """Gives what a `PalmStream` makes of the packets of a file, one a millisecond.

    `t_ns` of a reading is when its last packet was due, so that a late reading is an old one.
    `fingers`, `calibration` and `heed_finger_bits`: as those of a `PalmStream`.

    The constructor raises `ValueError` for an argument out of range. `open` raises
    `RecordingError` for a file that holds no packets and `CalibrationError` for a calibration with
    mistakes. `read_ready` raises `RecordingError`.
    """

    name = "palm"
    period_ns: int | None = ROUND_NS

    def __init__(
        self,
        path: Path,
        fingers: Sequence[str] = ("ff", "mf", "th"),
        *,
        calibration: Path | None = None,
        heed_finger_bits: bool = True,
        clock: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        super().__init__([path], Timeline(1.0, clock))
        self._calibration = calibration
        self._make_stream = functools.partial(
            PalmStream, fingers, heed_finger_bits=heed_finger_bits
        )
        self._stream = self._make_stream()

    @property
    def counters(self) -> PalmCounters:
        """Counters since `open`."""
        return self._stream.counters

    def describe(self) -> dict[str, Fact]:
        """Which file is played."""
        return {"source": Fact(str(self.paths[0]))}

    def open(self) -> None:
        """Read the calibration, tell the packets' length, then start over."""
        self.close()
        self._stream = self._make_stream(calibration=self._calibration)
        with _open(self.paths[0]) as file:
            length = _packet_bytes(self.paths[0], file)
        self.timeline.start(_packets(self.paths[0], length))

    def read_ready(self) -> Sequence[Reading]:
        """Readings of the packets that are due, oldest first."""
        readings: list[Reading] = []
        for _ in range(PACKETS_AT_ONCE):
            taken = self.timeline.take()
            if taken is None:
                break
            at_ns, data, _ = taken
            readings.extend(self._stream.receive(data, self.timeline.played_ns(at_ns)) or ())
        return readings


def _packets(path: Path, length: int) -> Generator[tuple[int, bytes], None, None]:
    """Packets and their times, ns since the first; the last is cut off if the file ends in it."""
    at_ns = 0
    with _open(path) as file:
        try:
            while data := file.read(length):
                yield at_ns, data
                at_ns += CYCLE_NS
        except OSError as error:
            raise RecordingError(path, f"cannot be read: {error.strerror}") from error


def _packet_bytes(path: Path, file: BinaryIO) -> int:
    """Length of each packet, by which most of the first ones make sense."""
    head = file.read(PACKETS_TRIED * max(PALM_OF_LENGTH))
    size = os.fstat(file.fileno()).st_size
    scores = {
        length: (_share_of_sense(head, length), size % length == 0) for length in PALM_OF_LENGTH
    }
    best = max(scores, key=lambda length: scores[length])
    if scores[best][0] < 0.5 or list(scores.values()).count(scores[best]) > 1:
        raise RecordingError(path, "this is not a file of palm packets of one known length")
    return best


def _share_of_sense(head: bytes, length: int) -> float:
    """Share of the first packets that hold sensor data, if packets are so long."""
    counters = PalmCounters()
    parser = PalmParser(counters)
    starts = range(0, min(len(head), PACKETS_TRIED * length) - length + 1, length)
    for start in starts:
        parser.parse(head[start : start + length])
    return counters.packets / max(len(starts), 1)


def _open(path: Path) -> BinaryIO:
    try:
        if stat.S_ISREG(path.stat().st_mode):  # opening a pipe would wait for its writer
            return path.open("rb")
    except OSError as error:
        raise RecordingError(path, f"cannot be opened: {error.strerror}") from error
    raise RecordingError(path, "is not a file")
