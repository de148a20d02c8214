"""Write the files of recordings (MCAP), and make room for them. Needs the extra `record`."""

from __future__ import annotations

import contextlib
import os
import re
from collections.abc import Iterator, Mapping
from functools import partial
from itertools import count
from pathlib import Path
from typing import Any, Final, Self

import msgspec
from mcap.writer import Writer

from graspd.biotac import FINGERS
from graspd.daemon.record.topics import schemas
from graspd.daemon.scene.scene import Record
from graspd.models.session_statistics import SessionState

MODE: Final = 0o640
"""File mode of recordings; not readable for all users, as they show what a hand did."""
ROTATE_BYTES: Final = 256_000_000
"""Size at which new files begin, bytes, or a quarter of the size kept if that is less. Such files
are small enough to copy and open."""
FILES_MAX: Final = 1000
"""Most recordings of a hand, so that a folder can be listed: six weeks of hours."""
METADATA: Final = "graspd"
"""Name of the metadata record at the start of each file of graspd."""

_STAMP: Final = r"\d{8}T\d{6}Z-[0-9a-f]{8}-\d{4,}"
_TEXTS: Final = ("boot_id", "model", "model_sha256", "trust")
"""Fields written as text, or as base64 if they are bytes; all others are JSON."""


class RecordingHeader(msgspec.Struct, frozen=True, kw_only=True):
    """Description of the run, with the state of session and learning at the start of the file."""

    fingers: tuple[str, ...]
    """Fingers in the order of a reading's rows."""
    joints: bool
    """True if the hand had joint angles."""
    boot_id: str
    scene: dict[str, dict[str, Any]]
    """Sections `hand`, `model`, `gate`, `session`, `learn` and `risk`."""
    model: str
    model_sha256: str
    file: int = 0
    """Number of the file in the run; a failure of the disk skips one number."""
    wall_minus_monotonic_ns: int = 0
    """Wall time less the daemon's monotonic time, ns."""
    grasps: int = 0
    """Number of the run's last grasp before the file."""
    session: SessionState | None = None
    """Statistics of the session, a held grasp included; None: the model has no session."""
    trust: bytes = b""
    """State of learning, from `graspd.daemon.trust.trust.encode`; empty without learning."""

    def texts(self) -> dict[str, str]:
        """Return the fields as texts, for a metadata record of MCAP."""
        return {
            name: value if name in _TEXTS else msgspec.json.encode(value).decode()
            for name, value in msgspec.to_builtins(self).items()
        }

    @classmethod
    def of(cls, texts: Mapping[str, str]) -> Self:
        """Return the header in `texts`. Raises `ValueError`, as for a missing required field."""
        known = texts.keys() & cls.__struct_fields__
        fields: dict[str, Any] = {name: texts[name] for name in known}
        for name in known.difference(_TEXTS):
            fields[name] = msgspec.json.decode(fields[name])
        header = msgspec.convert(fields, cls)
        if not header.fingers or not set(header.fingers) <= set(FINGERS):
            raise ValueError(f"no fingers of a hand: {header.fingers}")
        return header


class RecordingFile:
    """File of any bytes, such as a link log, that is being written; base of `McapWriter`.

    Methods raise `OSError` if the disk fails, except `abandon` and `remove`.
    """

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


class McapWriter(RecordingFile):
    """Writer of one MCAP file."""

    def __init__(self, path: Path, header: RecordingHeader) -> None:
        """Create the file, which must not exist, and write `header`."""
        super().__init__(path)
        self._offset_ns = header.wall_minus_monotonic_ns
        self._last_ns = -1
        """Log time of the last message, ns."""
        self._writer = Writer(self._stream)
        self._channels: dict[bytes, tuple[int, Iterator[int]]] = {}
        """Number of the channel and numbers of its next messages, by topic."""
        try:
            self._writer.start(profile="", library="graspd")
            self._writer.add_metadata(METADATA, header.texts())
            self.flush()
        except OSError:
            self.remove()
            raise

    def write(self, topic: bytes, payload: bytes, at_ns: int) -> None:
        """Write a message (JSON) of `topic`. `at_ns`: its monotonic time.

        Each log time is later than the last one, so that the order can be restored.
        """
        if topic not in self._channels:
            self._channels[topic] = self._register(topic.decode()), count()
        channel, numbers = self._channels[topic]
        self._last_ns = log_ns = max(at_ns + self._offset_ns, self._last_ns + 1)
        self._writer.add_message(channel, log_ns, payload, log_ns, next(numbers))

    def _register(self, topic: str) -> int:
        described = schemas().get(topic.partition(".")[0])
        schema = 0
        if described is not None:
            schema = self._writer.register_schema(described[0], "jsonschema", described[1])
        return self._writer.register_channel(topic, "json", schema)

    def flush(self) -> int:
        self._writer.flush()
        return super().flush()

    def close(self) -> None:
        try:
            self._writer.finish()
        except OSError:
            self.abandon()
            raise
        super().close()


def make_room(options: Record, hand: str, stamp: str) -> int:
    """Delete the hand's oldest recordings until the file with `stamp` fits; return their number.

    `stamp`: time, run and number, as in the names of files. The link log of a recording is deleted
    with it. Raises `OSError`.
    """
    options.folder.mkdir(parents=True, exist_ok=True)
    recordings = _recordings(options.folder, hand)
    total_bytes = rotate_bytes(options) + sum(size for _, size in recordings.values())
    removed = 0
    while recordings and (len(recordings) >= FILES_MAX or total_bytes > options.keep_mb * 1e6):
        paths, size = recordings.pop(min(recordings, key=partial(_place, stamp)))
        for path in paths:
            path.unlink(missing_ok=True)
        total_bytes -= size
        removed += 1
    return removed


def rotate_bytes(options: Record) -> float:
    """Return the size of files at which new ones begin, bytes."""
    return min(ROTATE_BYTES, options.keep_mb * 1e6 / 4)


def _place(newest: str, stamp: str) -> tuple[bool, int, bool, str]:
    """Return the place of a recording among those before `newest`; the oldest has the least.

    The files of a run are the newest, by number. Others with a later time are the oldest: since
    then the clock was set back.
    """
    _, run, number = stamp.split("-")
    is_own = run == newest.split("-")[1]
    return is_own, int(number) if is_own else 0, stamp < newest, stamp


def _recordings(folder: Path, hand: str) -> dict[str, tuple[list[Path], int]]:
    """Return paths and total size, bytes, of each recording, by the stamp in its name."""
    pattern = re.compile(rf"{re.escape(hand)}-({_STAMP})\.(mcap|can\.log|serial)")
    recordings: dict[str, tuple[list[Path], int]] = {}
    for path in folder.iterdir():
        match = pattern.fullmatch(path.name)
        if match is None:
            continue
        with contextlib.suppress(FileNotFoundError):
            paths, size = recordings.get(match[1], ([], 0))
            recordings[match[1]] = ([*paths, path], size + path.stat().st_size)
    return recordings
