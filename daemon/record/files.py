"""Files of a recording: names, retention, writing."""

from __future__ import annotations

import contextlib
import os
import re
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Final

MODE: Final = 0o640
"""File mode of recordings; not readable for all users, as they show what a hand did."""
_STAMP: Final = r"\d{8}T\d{6}Z-[0-9a-f]{8}-\d{4,}"


@dataclass(frozen=True, slots=True)
class Retention:
    """Name the files of one run; delete the oldest files of the hand."""

    directory: Path
    hand: str
    boot_id: str
    keep_files: int
    """Most recordings of the hand; a link log belongs to its recording."""
    keep_bytes: int
    """Largest size of all files of the hand, bytes."""

    def path(self, file: int, ending: str) -> Path:
        """Return the path of the run's file number `file`; names sort by time."""
        stamp = time.strftime("%Y%m%dT%H%M%SZ", time.gmtime())
        return self.directory / f"{self.hand}-{stamp}-{self.boot_id[:8]}-{file:04}{ending}"

    def make_room(self, expected_bytes: int) -> int:
        """Delete the oldest recordings until `expected_bytes` fit; return their number.

        Raises `OSError`.
        """
        self.directory.mkdir(parents=True, exist_ok=True)
        recordings = self._recordings()
        total = expected_bytes + sum(size for _, size in recordings.values())
        removed = 0
        while recordings and (len(recordings) >= self.keep_files or total > self.keep_bytes):
            paths, size = recordings.pop(min(recordings))
            for path in paths:
                path.unlink(missing_ok=True)
            total -= size
            removed += 1
        return removed

    def _recordings(self) -> dict[str, tuple[list[Path], int]]:
        """Return paths and total size of each recording, by the stamp in its name."""
        pattern = re.compile(rf"{re.escape(self.hand)}-({_STAMP})\.(mcap|can\.log|serial)")
        recordings: dict[str, tuple[list[Path], int]] = {}
        for path in self.directory.iterdir():
            match = pattern.fullmatch(path.name)
            if match is None:
                continue
            with contextlib.suppress(FileNotFoundError):
                paths, size = recordings.get(match[1], ([], 0))
                recordings[match[1]] = ([*paths, path], size + path.stat().st_size)
        return recordings


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
