"""The file of one kept session, with a checksum; an incomplete or damaged one is refused."""

from __future__ import annotations

import hashlib
import time
import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final

import msgspec
from msgspec.structs import replace

from graspd.biotac import COUNT_MAX
from graspd.daemon.process.files import read_regular, write_atomically
from graspd.daemon.trust.trust import TrustState, of_this_format
from graspd.models.session_statistics import SessionState

if TYPE_CHECKING:
    from graspd.models.judge.session import SessionCalibration

MAX_BYTES: Final = 2 << 20
"""Largest content, bytes; a session has 5 kB, learning from outcomes up to 620 kB."""
DIGEST_BYTES: Final = 32


class SessionFileError(Exception):
    """A kept session cannot be read or written, or is of other fingers or another model."""


class KeptSession(
    msgspec.Struct, frozen=True, forbid_unknown_fields=True, tag_field="version", tag=3
):
    """A session, and what outcomes taught in it."""

    statistics: SessionState | None
    """Statistics of a session model; None: the model needs none."""
    fingers: tuple[str, ...]
    """Fingers in the order of the statistics."""
    serials: dict[str, str]
    """Known serial numbers of the sensors, by finger."""
    trust: TrustState | None = None
    """State of learning and risk; None: of neither."""
    rest: tuple[Annotated[float, msgspec.Meta(ge=0.0, le=COUNT_MAX)], ...] | None = None
    """Resting count of each electrode, finger by finger; 0: not known. None: none is known."""
    saved_at: Annotated[float, msgspec.Meta(ge=0.0, le=1e11)] = 0.0
    """Time of saving, seconds since 1970, for people; 0: not saved."""

    @property
    def model(self) -> str:
        """SHA-256 of the model to which `trust` belongs; empty: not known."""
        return "" if self.trust is None else self.trust.model

    @property
    def grasps(self) -> int:
        """Number of grasps in the statistics."""
        return 0 if self.statistics is None else self.statistics.grasps

    @property
    def is_empty(self) -> bool:
        """True if the session has neither a grasp nor an outcome with its sensors."""
        trust = self.trust
        # Without learning only the warm-up counts: `slips` includes those with earlier sensors.
        taught = trust is not None and (trust.learner.outcomes or trust.risk.proven)
        return not (self.grasps or taught)


def load(path: Path) -> KeptSession:
    """Return the session in a file. Raises `SessionFileError`."""
    try:
        data = read_regular(path, MAX_BYTES)
    except OSError as error:
        raise SessionFileError(f"{path}: cannot read the session: {error.strerror}") from error
    digest, content = data[:DIGEST_BYTES], data[DIGEST_BYTES:]
    if hashlib.sha256(content).digest() != digest:
        raise SessionFileError(f"{path}: not a session: its checksum is wrong")
    try:
        plain = zlib.decompressobj().decompress(content, MAX_BYTES)
        kept = msgspec.msgpack.decode(plain, type=KeptSession)
        return kept if kept.trust is None else replace(kept, trust=of_this_format(kept.trust))
    except (msgspec.ValidationError, ValueError) as error:  # whole, for its checksum is right
        raise SessionFileError(f"{path}: of another version of graspd: {error}") from error
    except (zlib.error, msgspec.DecodeError, RecursionError) as error:
        raise SessionFileError(f"{path}: not a session: {error}") from error


def write(path: Path, kept: KeptSession) -> None:
    """Write `kept`, with the present time, in place of a file, in one step. Raises `OSError`."""
    stamped = replace(kept, saved_at=time.time())
    content = zlib.compress(msgspec.msgpack.encode(stamped), 1)
    write_atomically(path, hashlib.sha256(content).digest() + content)


def restore(path: Path, fingers: Sequence[str], session: SessionCalibration) -> None:
    """Let `session` continue from the file. Raises `SessionFileError` if the file cannot be read,
    or is of other fingers or another model."""
    restore_kept(load(path), fingers, session)


def restore_kept(kept: KeptSession, fingers: Sequence[str], session: SessionCalibration) -> None:
    """Let `session` continue from a kept one. Raises `SessionFileError` if that is of other
    fingers or another model."""
    of_fingers(kept, fingers)
    if kept.statistics is None:
        raise SessionFileError("the kept session is of a model that needs no statistics")
    try:
        session.restore(kept.statistics)
    except ValueError as error:
        raise SessionFileError(f"the kept session {error}") from error


def of_fingers(kept: KeptSession, fingers: Sequence[str]) -> None:
    """Raise `SessionFileError` if the session is for other fingers or another order."""
    if kept.fingers != tuple(fingers):
        raise SessionFileError(
            f"the kept session is of the fingers {', '.join(kept.fingers)}, "
            f"the hand has {', '.join(fingers)}"
        )
