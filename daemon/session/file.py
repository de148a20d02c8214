"""Keep the session between two starts of the daemon, in a file that is always complete."""

from __future__ import annotations

import fcntl
import glob
import hashlib
import logging
import os
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

MAX_BYTES: Final = 2 << 20
"""Largest file, bytes; a session has 7 kB, learning from outcomes up to 330 kB."""
DIGITS: Final = 12
"""Hexadecimal digits of the serial numbers' digest in a file name."""
OTHERS_MAX: Final = 4
"""Most sessions of other sensors that are kept."""


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


class SavedState(NamedTuple):
    """Decoded content of the session file."""

    serials: dict[str, str]
    statistics: SessionState | None = None
    trust: TrustState | None = None
    rest: tuple[float, ...] | None = None

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
        """Lock the file. Raises `SessionFileError` if it is in use or has no folder."""
        self.path = path
        self._newest_is_whole = False
        """True if the file is complete; only then does it replace the former one."""
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
        for written in (glob.escape(path.name), _beside_any(path)):
            for part in path.parent.glob(f"{written}.{'[0-9a-f]' * 8}"):
                with suppress(OSError):  # left by a daemon that was killed while it wrote
                    part.unlink()

    def close(self) -> None:
        """Unlock the file. May be called more than once."""
        lock, self._lock = self._lock, None
        if lock is not None:
            os.close(lock)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_details: object) -> None:
        self.close()

    def load(self) -> KeptSession | None:
        """Return the kept session: see the function `load`."""
        self._newest_is_whole = False
        newest = _newest_whole(self.path)
        if newest is None:
            return None
        kept, path = newest
        self._newest_is_whole = path == self.path
        return kept

    def save(self, kept: KeptSession) -> None:
        """Replace the file in one step; keep the former one. Raises `SessionFileError`."""
        former = former_of(self.path) if self._newest_is_whole else None
        self._newest_is_whole = False
        _write(self.path, kept, former)
        self._newest_is_whole = True

    def put_aside(self, kept: KeptSession) -> None:
        """Write the session of other sensors to a file of its own beside this one.

        The newest `OTHERS_MAX` of these files are kept. Raises `SessionFileError`.
        """
        _write(_beside(self.path, kept.serials), kept, None)
        newest = list(others(self.path))[:OTHERS_MAX]
        for path in set(self.path.parent.glob(_beside_any(self.path))) - set(newest):
            self._remove(path)

    def remove(self) -> bool:
        """Delete the session; return False if there was none. Raises `SessionFileError`."""
        # The former file goes first: an interruption must not bring it back.
        return bool(self.remove_former() + self._remove(self.path))

    def remove_former(self) -> bool:
        """Delete the former session and those of other sensors; return False if none was there.

        Raises `SessionFileError`.
        """
        paths = [former_of(self.path), *self.path.parent.glob(_beside_any(self.path))]
        return bool(sum([self._remove(path) for path in paths]))

    def _remove(self, path: Path) -> bool:
        try:
            path.unlink()
        except FileNotFoundError:
            return False
        except OSError as error:
            raise SessionFileError(f"{path}: cannot remove: {error.strerror}") from error
        return True


def former_of(path: Path) -> Path:
    """Return the path of the former session of `path`."""
    return path.with_name(path.name + ".former")


def kept_now(
    statistics: SessionState | None,
    fingers: Sequence[str],
    serials: Mapping[str, str],
    trust: TrustState | None = None,
    rest: tuple[float, ...] | None = None,
) -> KeptSession:
    """Return the content of a session file that is saved now; `KeptSession` has the meanings."""
    learned = None if trust is None else encode(trust)
    return KeptSession(tuple(fingers), dict(serials), time.time(), statistics, learned, rest)


def others(path: Path) -> dict[Path, KeptSession]:
    """Return the sessions of other sensors beside `path`, newest first."""
    sessions = {}
    for each in path.parent.glob(_beside_any(path)):
        try:
            kept = read(each)
        except SessionFileError as error:
            log.warning("%s; it counts for nothing", error)
            continue
        if kept is not None:
            sessions[each] = kept
    newest = sorted(sessions, key=lambda each: sessions[each].saved_at, reverse=True)
    return {each: sessions[each] for each in newest}


def _beside(path: Path, serials: Mapping[str, str]) -> Path:
    digest = hashlib.sha256(msgspec.json.encode(sorted(serials.items()))).hexdigest()
    return path.with_name(f"{path.name}.of-{digest[:DIGITS]}")


def _beside_any(path: Path) -> str:
    """Return a pattern for files of other sensors; unfinished files do not match."""
    return f"{glob.escape(path.name)}.of-{'[0-9a-f]' * DIGITS}"


def _write(path: Path, kept: KeptSession, former: Path | None) -> None:
    content = msgspec.json.encode(kept)
    sealed = _Sealed(hashlib.sha256(content).hexdigest(), msgspec.Raw(content))
    try:
        write_atomically(path, msgspec.json.encode(sealed) + b"\n", former=former)
    except OSError as error:
        raise SessionFileError(f"{path}: cannot keep the session: {error.strerror}") from error


def load(path: Path) -> KeptSession | None:
    """Return the session at `path`, or the former one if that is damaged; None: no file.

    Raises `SessionFileError` if both are damaged.
    """
    newest = _newest_whole(path)
    return None if newest is None else newest[0]


def _newest_whole(path: Path) -> tuple[KeptSession, Path] | None:
    """Return the newest undamaged session, and its file. Raises `SessionFileError`."""
    problem: SessionFileError | None = None
    for each in (path, former_of(path)):
        try:
            kept = read(each)
        except SessionFileError as error:
            problem = problem or error
            continue
        if kept is not None:
            if each != path:
                why = problem or f"{path}: is not there"
                log.warning("%s; what was kept before it goes on", why)
            return kept, each
    if problem is not None:
        raise problem
    return None


def read(path: Path) -> KeptSession | None:
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
