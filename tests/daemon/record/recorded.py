"""A recorder in a folder, and the messages of the recordings that it writes."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, cast

from graspd.daemon.publish.messages import Status
from graspd.daemon.record.link_log import Tap
from graspd.daemon.record.mcap import RecordingHeader
from graspd.daemon.record.mcap_reader import McapReader
from graspd.daemon.record.recorder import MakeHeader, Recorder
from graspd.daemon.scene.scene import Record
from graspd.drivers.recordings.kinds import open_recording

BOOT = "0123456789abcdef" * 2
HEADER = RecordingHeader(
    fingers=("ff", "th"), joints=True, boot_id=BOOT, scene={}, model="any", model_sha256=""
)
NO_STATUS = cast(Status, None)
"""Argument of `on_status`, which a recorder ignores: it records what `send` gives it."""

IGNORED_FIELDS = frozenset(
    {"boot_id", "seq", "t", "t_mono_ns", "age_ms", "latency_us", "silence_ms"}
)
"""Fields of a verdict that depend on the run, not the readings; a replay repeats all others."""


def compared(verdict: dict[str, Any]) -> dict[str, Any]:
    """Return the fields of a verdict that a replay must repeat, without nulls."""
    said = {name: value for name, value in verdict.items() if name not in IGNORED_FIELDS}
    return dict(without_null(said))


def without_null(value: Any) -> Any:  # noqa: ANN401
    """Return a message as it is recorded: without nulls; a finger's null state is `unknown`."""
    if isinstance(value, dict):
        if isinstance(fingers := value.get("fingers"), dict):
            felt = {finger: state or "unknown" for finger, state in fingers.items()}
            value = value | {"fingers": felt}
        return {name: without_null(one) for name, one in value.items() if one is not None}
    return value


def files(folder: Path) -> list[Path]:
    """Return the recordings below a folder, oldest first."""
    return sorted((folder / "record").glob("*.mcap"))


def recorder(
    folder: Path,
    take_header: Callable[[], MakeHeader] = lambda: lambda: HEADER,
    *,
    tap: Tap | None = None,
    clock: Callable[[], int] = time.monotonic_ns,
    **options: Any,  # noqa: ANN401
) -> Recorder:
    """Return a recorder that writes below a folder; `options`: of section `record` of a scene."""
    wanted = Record(**{"directory": folder / "record", **options})
    return Recorder(wanted, "right", BOOT, take_header=take_header, tap=tap, clock=clock)


def messages(path: Path) -> list[tuple[str, dict[str, Any]]]:
    """Return kind and content of each message of a recording."""
    with open_recording(path) as stream:
        recording = McapReader(path, stream)
        return [(message.kind, json.loads(message.payload)) for message in recording]
