"""Keep the session between two starts of the daemon, in a file that is always complete."""

from __future__ import annotations

import fcntl
import glob
import hashlib
import logging
import os
import string
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final, NamedTuple, Self

import msgspec

from graspd.daemon.process.files import read_regular, write_atomically
from graspd.daemon.trust.trust import TrustState, encode
from graspd.drivers.base import COUNT_MAX
from graspd.models.session_statistics import SessionState

if TYPE_CHECKING:
    from graspd.daemon.judge.calibration import SessionCalibration

log = logging.getLogger("graspd")

MAX_BYTES: Final = 8 << 20
"""Largest file, bytes; a session has 7 kB, learning from outcomes up to 330 kB."""
ASIDE: Final = "aside-"
"""Begin of the ending of a file that is put aside; a hexadecimal digit follows."""
OTHERS_MAX: Final = 4
"""Most sessions of other fingers, models or sensors that are kept."""


class SessionFileError(Exception):
    """The kept session cannot be read or written."""


class KeptSession(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Content of a session file."""

    fingers: tuple[str, ...]
    """Fingers in the order of the statistics."""
    serials: dict[str, str]
    """Known serial numbers of the sensors, by finger."""
    saved_at: Annotated[float, msgspec.Meta(ge=0.0, le=1e11)]
    """Time of saving, seconds since 1970, for people."""
    statistics: SessionState | None
    """Statistics of a session model; None if no model needed any."""
    trust: bytes | None = None
    """State of learning, from `graspd.daemon.trust.trust.encode`; None without learning."""
    rest: tuple[Annotated[float, msgspec.Meta(ge=0.0, le=COUNT_MAX)], ...] | None = None
    """Resting count of each electrode, finger by finger; 0: not known."""
    model: str = ""
    """Digest of the model that `trust` is of; empty: not known."""
    others: Annotated[tuple[KeptSession, ...], msgspec.Meta(max_length=OTHERS_MAX)] = ()
    """Sessions of other fingers, models or sensors, newest first; these have no others."""


class SavedState(NamedTuple):
    """Decoded content of the session file."""

    serials: dict[str, str]
    statistics: SessionState | None = None
    trust: TrustState | None = None
    rest: tuple[float, ...] | None = None
    others: tuple[KeptSession, ...] = ()

    @property
    def is_empty(self) -> bool:
        """True if it has neither a grasp nor an outcome."""
        no_grasps = self.statistics is None or not self.statistics.grasps
        return no_grasps and (self.trust is None or not self.trust.learner.outcomes)


class _Sealed(msgspec.Struct, frozen=True, forbid_unknown_fields=True, tag_field="version", tag=2):
    """A session file."""

    sha256: str
    """SHA-256 of the text of `kept`."""
    kept: msgspec.Raw


class SessionFile:
    """One hand's file, locked while it is open."""

    def __init__(self, path: Path) -> None:
        """Nothing is locked yet: see `lock`."""
        self.path = path
        self._is_ours = False
        """True if the file is as it was loaded or saved; any other is put aside, not replaced."""
        self._lock: int | None = None

    def lock(self) -> None:
        """Lock the file, once. Raises `SessionFileError` if it is in use or has no folder."""
        if self._lock is not None:
            return
        path = self.path
        lock = path.with_name(path.name + ".lock")
        try:
            flags = os.O_RDWR | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW
            self._lock = os.open(lock, flags, 0o644)
        except OSError as error:
            raise SessionFileError(f"{path}: cannot keep the session: {error.strerror}") from error
        try:
            fcntl.flock(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            self.close()
            raise SessionFileError(
                f"{path}: in use by another graspd, stop that one first"
            ) from error
        for part in path.parent.glob(f"{glob.escape(path.name)}.{'[0-9a-f]' * 8}"):
            with suppress(OSError):  # left by a daemon that was killed while it wrote
                part.unlink()

    def close(self) -> None:
        """Unlock the file. May be called more than once."""
        lock, self._lock = self._lock, None
        if lock is not None:
            os.close(lock)

    def __enter__(self) -> Self:
        self.lock()
        return self

    def __exit__(self, *_details: object) -> None:
        self.close()

    def load(self) -> KeptSession | None:
        """Return the kept session: see the function `load`."""
        kept = load(self.path)
        self._is_ours = self._lock is not None  # else another graspd may write it
        return kept

    def save(self, kept: KeptSession) -> None:
        """Replace the file in one step. Raises `SessionFileError`."""
        self.lock()
        content = msgspec.json.encode(kept)
        sealed = _Sealed(hashlib.sha256(content).hexdigest(), msgspec.Raw(content))
        try:
            if not self._is_ours:
                with suppress(FileNotFoundError):
                    os.replace(self.path, self._aside())
            self._is_ours = True
            write_atomically(self.path, msgspec.json.encode(sealed) + b"\n")
        except OSError as error:
            raise SessionFileError(
                f"{self.path}: cannot keep the session: {error.strerror}"
            ) from error

    def _aside(self) -> Path:
        """Return a free path to put a file aside, or that of the oldest file put aside."""
        paths = [Path(f"{self.path}.{ASIDE}{digit}") for digit in string.hexdigits[:16]]
        free = (path for path in paths if not path.exists())
        return next(free, None) or min(paths, key=lambda path: path.stat().st_mtime)

    def remove(self) -> bool:
        """Delete all that was kept; return False if that is nothing. Raises `SessionFileError`."""
        aside = self.path.parent.glob(f"{glob.escape(self.path.name)}.{ASIDE}?")
        paths = [path for path in (*aside, self.path) if path.exists()]
        try:
            for path in paths:
                path.unlink()
        except OSError as error:
            raise SessionFileError(f"{self.path}: cannot remove: {error.strerror}") from error
        return bool(paths)


def kept_now(
    statistics: SessionState | None,
    fingers: Sequence[str],
    serials: Mapping[str, str],
    trust: TrustState | None = None,
    rest: tuple[float, ...] | None = None,
    others: tuple[KeptSession, ...] = (),
) -> KeptSession:
    """Return the content of a session file that is saved now; `KeptSession` has the meanings."""
    learned, model = (None, "") if trust is None else (encode(trust), trust.model)
    now = time.time()
    return KeptSession(tuple(fingers), dict(serials), now, statistics, learned, rest, model, others)


def load(path: Path) -> KeptSession | None:
    """Return the session in a file; None: no file. Raises `SessionFileError`."""
    try:
        data = read_regular(path, MAX_BYTES)
    except FileNotFoundError:
        return None
    except OSError as error:
        raise SessionFileError(f"{path}: cannot read the session: {error.strerror}") from error
    try:
        content = msgspec.json.decode(data, type=_Sealed)
        if hashlib.sha256(content.kept).hexdigest() != content.sha256:
            raise SessionFileError(f"{path}: not a session: its checksum is wrong")
        return msgspec.json.decode(content.kept, type=KeptSession)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise SessionFileError(f"{path}: not a session: {error}") from error


def restore(path: Path, fingers: Sequence[str], session: SessionCalibration) -> None:
    """Let `session` go on from the file. Raises `SessionFileError` if that is not possible."""
    kept = load(path)
    if kept is None:
        raise SessionFileError(f"{path}: cannot read the session: No such file or directory")
    restore_kept(kept, fingers, session)


def restore_kept(kept: KeptSession, fingers: Sequence[str], session: SessionCalibration) -> None:
    """Let `session` go on from a kept one. Raises `SessionFileError` if that is not possible."""
    of_fingers(kept, fingers)
    if kept.statistics is None:
        raise SessionFileError("the kept session is of a model that needs no statistics")
    try:
        session.restore(kept.statistics)
    except ValueError as error:
        raise SessionFileError(f"the kept session {error}") from error


def of_fingers(kept: KeptSession, fingers: Sequence[str]) -> None:
    """Raise `SessionFileError` if the session is of other fingers."""
    if kept.fingers != tuple(fingers):
        raise SessionFileError(
            f"the kept session is of the fingers {', '.join(kept.fingers)}, "
            f"the hand has {', '.join(fingers)}"
        )
