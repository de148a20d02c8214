"""The session's statistics between two starts of the daemon, with the sensors they belong to."""

from __future__ import annotations

import fcntl
import os
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import Final, Literal, Self

import msgspec

from daemon.process.files import read_regular, write_atomically
from models.session_statistics import SessionState

VERSION: Final = 1
MAX_BYTES = 1 << 20
"""A kept session has 7 kB."""


class SessionFileError(Exception):
    """The kept session cannot be read or written; one line says why."""


class KeptSession(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Content of the file."""

    version: Literal[1]
    fingers: tuple[str, ...]
    """Order of the fingers in the statistics."""
    serials: dict[str, str]
    """Serial number of each finger's sensor, as far as it was known."""
    saved_at: float
    """Wall-clock seconds since 1970, for people."""
    statistics: SessionState


class SessionFile:
    """One hand's file; whoever has it open has it alone."""

    def __init__(self, path: Path) -> None:
        """Take the file. Raises `SessionFileError` if it is in use or its folder is not there."""
        self.path = path
        lock = path.with_name(path.name + ".lock")
        try:
            flags = os.O_RDWR | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW
            self._lock: int | None = os.open(lock, flags, 0o644)
        except OSError as error:
            raise SessionFileError(f"{path}: cannot keep the session: {error.strerror}") from error
        try:
            fcntl.flock(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            self.close()
            raise SessionFileError(
                f"{path}: in use by another graspd, stop that one first"
            ) from error

    def close(self) -> None:
        """Let others have it. May be called more than once."""
        lock, self._lock = self._lock, None
        if lock is not None:
            os.close(lock)

    def __enter__(self) -> Self:
        """Nothing to do: the file is taken from the start."""
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Close."""
        self.close()

    def load(self) -> KeptSession | None:
        """What is kept; None if nothing is. Raises `SessionFileError` for what is not a session."""
        return load(self.path)

    def save(
        self, statistics: SessionState, fingers: Sequence[str], serials: Mapping[str, str]
    ) -> None:
        """Replace the file in one step. Raises `SessionFileError`."""
        kept = KeptSession(VERSION, tuple(fingers), dict(serials), time.time(), statistics)
        data = msgspec.json.format(msgspec.json.encode(kept), indent=1) + b"\n"
        try:
            write_atomically(self.path, data)
        except OSError as error:
            raise SessionFileError(
                f"{self.path}: cannot keep the session: {error.strerror}"
            ) from error

    def remove(self) -> bool:
        """Forget what is kept; False if nothing was. Raises `SessionFileError`."""
        try:
            self.path.unlink()
        except FileNotFoundError:
            return False
        except OSError as error:
            raise SessionFileError(f"{self.path}: cannot remove: {error.strerror}") from error
        return True


def load(path: Path) -> KeptSession | None:
    """What is kept at `path`, None if nothing is. Raises `SessionFileError`."""
    try:
        data = read_regular(path, MAX_BYTES)
    except FileNotFoundError:
        return None
    except OSError as error:
        raise SessionFileError(f"{path}: cannot read the session: {error.strerror}") from error
    try:
        return msgspec.json.decode(data, type=KeptSession)
    except (msgspec.DecodeError, UnicodeDecodeError) as error:
        raise SessionFileError(f"{path}: not a session: {error}") from error


def exchanged(before: Mapping[str, str], now: Mapping[str, str]) -> list[str]:
    """Fingers whose sensor is known to be another one than before."""
    return [finger for finger in now if before.get(finger, now[finger]) != now[finger]]


def statistics_of(kept: KeptSession, fingers: Sequence[str]) -> SessionState:
    """What is kept of these fingers. Raises `SessionFileError` if it is of others."""
    if kept.fingers != tuple(fingers):
        raise SessionFileError(
            f"the kept session is of the fingers {', '.join(kept.fingers)}, "
            f"the hand has {', '.join(fingers)}"
        )
    return kept.statistics
