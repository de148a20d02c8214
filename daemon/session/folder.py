"""The kept sessions of a hand: a folder with a file per combination of fingers, model, sensors."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from operator import attrgetter
from pathlib import Path
from typing import Final, Self

from graspd.daemon.process.files import require_linux, sync_folder
from graspd.daemon.session.file import KeptSession, SessionFileError, load, write

KEPT_MAX: Final = 5
"""Most sessions that are kept, not counting a running one that is still empty. Empty sessions are
deleted first, then the one that was used longest ago."""
DAMAGED_MAX: Final = 16
"""Most unreadable files that are kept; the oldest is deleted."""
LOCK: Final = "lock"
"""Name of the file that is locked."""
ENDING: Final = ".session"
"""Ending of a session file's name, after its number."""
NUMBER: Final = re.compile(r"[1-9][0-9]{0,8}")
"""Pattern of a session file's number; files with other names do not belong to graspd."""

Found = dict[int, KeptSession | SessionFileError]
"""Content of each file, or the error in reading it, by file number, the last used first."""


class SessionFolder:
    """One hand's folder, locked while it is open. Only files that it loaded or saved are replaced.

    The files are numbered in the order in which their sessions were last used.
    """

    def __init__(self, path: Path) -> None:
        """`path`: the folder. Nothing is locked or read yet: see `lock` and `load`."""
        self.path = path
        self._kept: dict[int, KeptSession] = {}
        """Sessions that were loaded or saved, by the number of their file."""
        self._damaged: list[int] = []
        """Numbers of the files that cannot be read, the newest first."""
        self._running: int | None = None
        """Number of the file of the session that runs; None: not saved yet."""
        self._lock: int | None = None

    def lock(self) -> None:
        """Make and lock the folder, once.

        Raises `SessionFileError` if it is in use, or cannot be made or locked, and `SceneError`
        where there is no Linux.
        """
        if self._lock is not None:
            return
        require_linux("to keep a session")
        import fcntl

        try:
            if not self.path.is_dir():
                self.path.mkdir()
                sync_folder(self.path.parent)
            flags = os.O_RDWR | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW
            self._lock = os.open(self.path / LOCK, flags, 0o644)
        except OSError as error:
            raise _not_kept(self.path, error) from error
        try:
            fcntl.flock(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            self.close()
            if not isinstance(error, BlockingIOError):
                raise _not_kept(self.path, error) from error
            raise SessionFileError(
                f"{self.path}: in use by another graspd, stop that one first"
            ) from error
        for part in self.path.glob(f"*{ENDING}.{'[0-9a-f]' * 8}"):
            with suppress(OSError):  # delete the file of a daemon that was killed while it wrote
                part.unlink()

    def close(self) -> None:
        """Unlock the folder. May be called more than once."""
        lock, self._lock = self._lock, None
        if lock is not None:
            os.close(lock)

    def __enter__(self) -> Self:
        self.lock()
        return self

    def __exit__(self, *_details: object) -> None:
        self.close()

    @contextmanager
    def if_there(self) -> Iterator[Self]:
        """Lock the folder within the block; one that is not there is not made. Raises as `lock`."""
        require_linux("to keep a session")
        if os.path.isdir(self.path):
            self.lock()
        try:
            yield self
        finally:
            self.close()

    def load(self) -> Found:
        """Return the result of `look`; `save` may replace its files. Raises `SessionFileError`."""
        found = look(self.path)
        self._kept = {n: kept for n, kept in found.items() if isinstance(kept, KeptSession)}
        self._damaged = [number for number in found if number not in self._kept]
        self._running = None
        return found

    def save(self, sessions: Sequence[KeptSession]) -> None:
        """Replace the loaded sessions by these: the one that runs, then the last used first.

        As many of the others are saved as `KEPT_MAX` allows. Raises `SessionFileError`,
        after which the sessions on the disk are whole.
        """
        if self._lock is None:
            self._lock_late()
        running, *others = sessions
        others = sorted(others, key=attrgetter("is_empty"))[: KEPT_MAX - (not running.is_empty)]
        try:
            stay: set[int] = set()
            for each in reversed(others):
                same = (n for n, kept in self._kept.items() if kept == each and n not in stay)
                number = next(same, None)
                if number is None:
                    number = self._free()
                    self._write(number, each)
                    self._running = None  # the running session's file needs a higher number
                elif number == self._running:
                    self._running = None
                stay.add(number)
            if self._running is None:
                self._running = self._free()
            self._write(self._running, running)
            gone = [number for number in self._kept if number not in {*stay, self._running}]
            for number in gone + self._damaged[DAMAGED_MAX:]:
                _path(self.path, number).unlink(missing_ok=True)
                self._kept.pop(number, None)
            del self._damaged[DAMAGED_MAX:]
        except OSError as error:
            raise _not_kept(self.path, error) from error

    def replace(self, number: int, kept: KeptSession) -> None:
        """Replace the file `number`; its place in the order stays. Raises `SessionFileError`."""
        self.lock()
        try:
            self._write(number, kept)
        except OSError as error:
            raise _not_kept(self.path, error) from error

    def remove(self) -> bool:
        """Delete all kept sessions; return False if there were none. Raises `SessionFileError`."""
        numbers = _numbers(self.path)
        try:
            for number in numbers:
                _path(self.path, number).unlink(missing_ok=True)
        except OSError as error:
            raise SessionFileError(f"{self.path}: cannot remove: {error.strerror}") from error
        return bool(numbers)

    def _lock_late(self) -> None:
        """Lock the loaded folder. Raises `SessionFileError` if it is in use or has changed."""
        loaded = self._kept, self._damaged
        self.lock()
        try:
            self.load()
            if (self._kept, self._damaged) != loaded:
                raise SessionFileError(f"{self.path}: changed since the start, start graspd again")
        except SessionFileError:
            self._kept, self._damaged = loaded
            self.close()
            raise

    def _write(self, number: int, kept: KeptSession) -> None:
        write(_path(self.path, number), kept)
        self._kept[number] = kept

    def _free(self) -> int:
        return max(_numbers(self.path), default=0) + 1


def look(folder: Path) -> Found:
    """Return the content of each session file in a folder, or the error in reading it; {} without
    a folder. Raises `SessionFileError` if the folder itself cannot be read."""
    found: Found = {}
    for number in _numbers(folder):
        try:
            found[number] = load(_path(folder, number))
        except SessionFileError as error:
            found[number] = error
    return found


def _numbers(folder: Path) -> list[int]:
    """Return the numbers of the files, the highest first. Raises `SessionFileError`."""
    try:
        files = [name for name in os.listdir(folder) if name.endswith(ENDING)]
    except FileNotFoundError:
        return []
    except OSError as error:
        raise SessionFileError(f"{folder}: cannot read the session: {error.strerror}") from error
    names = [name.removesuffix(ENDING) for name in files]
    return sorted((int(name) for name in names if NUMBER.fullmatch(name)), reverse=True)


def _path(folder: Path, number: int) -> Path:
    return folder / f"{number}{ENDING}"


def _not_kept(folder: Path, error: OSError) -> SessionFileError:
    return SessionFileError(f"{folder}: cannot keep the session: {error.strerror}")
