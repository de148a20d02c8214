"""The files of a recording, one after the other, named by hand and time, the oldest removed."""

from __future__ import annotations

import contextlib
import json
import os
import re
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO, Final

import msgspec
from mcap.writer import Writer

from daemon.publish.messages import WIRE_VERSION, schema
from daemon.record.mcap import METADATA
from drivers.base import JointReading

MODE: Final = 0o640
"""Of files: what a hand grasped is nobody else's business."""
_MESSAGE_OF_KIND: Final = {
    "verdict": "Verdict",
    "gate": "GateMessage",
    "tactile": "Tactile",
    "outcome": "OutcomeMessage",
    "status": "Status",
    "joints": "Joints",
}
_STAMP: Final = r"\d{8}T\d{6}Z-[0-9a-f]{8}-\d{4,}"


class Joints(msgspec.Struct, frozen=True, kw_only=True):
    """Joint angles as they came, on topic `joints.<hand>`; in recordings only."""

    v: int = WIRE_VERSION
    seq: int
    t_mono_ns: int
    """Monotonic time, ns, of the reading's last byte."""
    names: tuple[str, ...]
    position_rad: list[float | None]
    """By name, rad; null where a joint has no valid angle."""

    @classmethod
    def of(cls, reading: JointReading) -> Joints:
        """The message of a reading."""
        angles = [None if angle != angle else angle for angle in reading.position_rad.tolist()]
        return cls(
            seq=reading.seq, t_mono_ns=reading.t_ns, names=reading.names, position_rad=angles
        )


def schemas() -> dict[str, bytes]:
    """JSON Schema of each kind of message that a recording has, as an object at the top."""
    definitions = schema()["$defs"] | msgspec.json.schema_components([Joints])[1]
    found: dict[str, bytes] = {}
    for kind, name in _MESSAGE_OF_KIND.items():
        whole: dict[str, Any] = {**definitions[name], "$defs": definitions}
        found[kind] = json.dumps(whole).encode()
    return found


class MessageFile:
    """One MCAP file being written. All methods raise `OSError` when there is no room."""

    def __init__(self, path: Path, header: Mapping[str, str], offset_ns: int) -> None:
        """Make the file; log times are monotonic times plus `offset_ns`."""
        self._path = path
        self._stream = create(path)
        self._offset_ns = offset_ns
        self._writer = Writer(self._stream)
        self._schemas = schemas()
        self._channels: dict[bytes, int] = {}
        self._numbers: dict[int, int] = {}
        try:
            self._writer.start(profile="", library="graspd")
            texts = {**header, "wall_minus_monotonic_ns": str(offset_ns)}
            self._writer.add_metadata(METADATA, texts)
            self.flush()
        except OSError:
            self.remove()
            raise

    def write(self, topic: bytes, payload: bytes, at_ns: int) -> None:
        """Take one message of monotonic time `at_ns`, ns."""
        channel = self._channels.get(topic)
        if channel is None:
            channel = self._channels[topic] = self._register(topic.decode())
            self._numbers[channel] = 0
        log_ns = max(at_ns + self._offset_ns, 0)
        self._writer.add_message(channel, log_ns, payload, log_ns, self._numbers[channel])
        self._numbers[channel] += 1

    def _register(self, topic: str) -> int:
        kind = topic.partition(".")[0]
        described = self._schemas.get(kind)
        known = 0
        if described is not None:
            name = f"graspd.{_MESSAGE_OF_KIND[kind]}"
            known = self._writer.register_schema(name, "jsonschema", described)
        return self._writer.register_channel(topic, "json", known)

    def flush(self) -> int:
        """End the chunk at hand, and have the disk keep it; the file's size then, bytes."""
        self._writer.flush()
        os.fdatasync(self._stream.fileno())
        return self._stream.tell()

    def close(self) -> None:
        """Write the summary and close."""
        try:
            self._writer.finish()
            self.flush()
        finally:
            self.abandon()

    def abandon(self) -> None:
        """Close as it is."""
        with contextlib.suppress(OSError):  # what is buffered finds no room either
            self._stream.close()

    def remove(self) -> None:
        """Close, and remove the file: there is nothing in it."""
        self.abandon()
        with contextlib.suppress(OSError):
            self._path.unlink()


@dataclass(frozen=True, slots=True)
class Shelf:
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
