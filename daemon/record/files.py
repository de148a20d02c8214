"""Names of the files of a recording, and how many of them are kept."""

from __future__ import annotations

import contextlib
import os
import re
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO, Final

MODE: Final = 0o640
"""Of files: what a hand grasped is nobody else's business."""
_STAMP: Final = r"\d{8}T\d{6}Z-[0-9a-f]{8}-\d{4,}"


@dataclass(frozen=True, slots=True)
class Retention:
    """Where the files of one hand stand, and how many may."""

    directory: Path
    hand: str
    boot_id: str
    keep_files: int
    keep_bytes: int
    wall_clock: Callable[[], int] = time.time_ns

    def name(self, number: int) -> Path:
        """Path of the next file, without its ending; sorts by time. `number` counts from 0."""
        stamp = time.strftime("%Y%m%dT%H%M%SZ", time.gmtime(self.wall_clock() // 1_000_000_000))
        return self.directory / f"{self.hand}-{stamp}-{self.boot_id[:8]}-{number:04}"

    def make_room(self, expected_bytes: int) -> int:
        """Remove the oldest recordings, until one more may come; how many. Raises `OSError`."""
        self.directory.mkdir(parents=True, exist_ok=True)
        found = self._recordings()
        total = sum(size for _, size in found.values())
        removed = 0
        for stem in sorted(found):
            few = len(found) - removed < self.keep_files
            if few and total + expected_bytes <= self.keep_bytes:
                break
            paths, size = found[stem]
            for path in paths:
                path.unlink(missing_ok=True)
            total -= size
            removed += 1
        return removed

    def _recordings(self) -> dict[str, tuple[list[Path], int]]:
        """Files and their size by time: the name without hand and ending."""
        pattern = re.compile(rf"{re.escape(self.hand)}-({_STAMP})\.(mcap|can\.log|serial)")
        found: dict[str, tuple[list[Path], int]] = {}
        for path in self.directory.iterdir():
            match = pattern.fullmatch(path.name)
            if match is None:
                continue
            with contextlib.suppress(FileNotFoundError):
                paths, size = found.get(match[1], ([], 0))
                found[match[1]] = ([*paths, path], size + path.stat().st_size)
        return found


def create(path: Path) -> BinaryIO:
    """A new file to write; raises `OSError` if it cannot be made, or is there."""
    flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC | os.O_NOFOLLOW
    return open(os.open(path, flags, MODE), "wb")
