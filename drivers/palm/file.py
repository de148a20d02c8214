"""A recording of palm packets: nothing but the packets, one after the other."""

from __future__ import annotations

import os
import stat
from pathlib import Path
from typing import BinaryIO

from drivers.base import RecordingError
from drivers.palm.packet import PALM_OF_LENGTH, PacketCounters, PalmParser

PACKETS_TRIED = 64
"""Packets by which the length is told."""


class PalmFile:
    """Gives the packets of a file in turn. The constructor raises `RecordingError`."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._file = _open(path)
        try:
            self.packet_bytes = self._find_length()
            """Length of each packet, by which most of the first ones make sense."""
        except (OSError, RecordingError):
            self._file.close()
            raise

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def next_packet(self) -> bytes:
        """The next packet, cut off if the file ends in it; empty at the end of the file.

        Raises `RecordingError`.
        """
        try:
            return self._file.read(self.packet_bytes)
        except OSError as error:
            raise RecordingError(self.path, f"cannot be read: {error.strerror}") from error

    def _find_length(self) -> int:
        head = self._file.read(PACKETS_TRIED * max(PALM_OF_LENGTH))
        self._file.seek(0)
        size = os.fstat(self._file.fileno()).st_size
        scores = {
            length: (_share_of_sense(head, length), size % length == 0) for length in PALM_OF_LENGTH
        }
        best = max(scores, key=lambda length: scores[length])
        if scores[best][0] < 0.5 or list(scores.values()).count(scores[best]) > 1:
            raise RecordingError(
                self.path, "this is not a file of palm packets of one known length"
            )
        return best


def _share_of_sense(head: bytes, length: int) -> float:
    """Share of the first packets that hold sensor data, if packets are so long."""
    counters = PacketCounters()
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
