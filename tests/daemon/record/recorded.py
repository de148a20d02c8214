"""A daemon that records while a controller tells it how its lifts ended, as processes."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, cast

import zmq

from graspd.daemon.publish.messages import Status, Verdict
from graspd.daemon.record.link_log import Tap
from graspd.daemon.record.mcap import RecordingHeader
from graspd.daemon.record.mcap_reader import McapReader
from graspd.daemon.record.recorder import MakeHeader, Recorder
from graspd.daemon.scene.scene import Record
from graspd.daemon.trust.lift_book import NAME_BYTES
from graspd.drivers.recordings.csv_player import DEMO_RECORDING
from graspd.drivers.recordings.kinds import open_recording
from tests.daemon.processes import TIMEOUT_S, start, wait_for
from tests.kit.messages import decode_verdict

BOOT = "0123456789abcdef" * 2
NAME = bytes([1]) * NAME_BYTES
"""Routing id of a peer that may tell outcomes."""
HEADER = RecordingHeader(
    fingers=("ff", "th"), joints=True, boot_id=BOOT, scene={}, model="any", model_sha256=""
)
NO_STATUS = cast(Status, None)
"""A recorder gets the status as a message."""

IGNORED_FIELDS = frozenset(
    {"boot_id", "seq", "t", "t_mono_ns", "age_ms", "latency_us", "silence_ms"}
)
"""Fields of a verdict that are of the run and not of the readings: a recording that is played again
gives all others bit for bit."""


def compared(verdict: dict[str, Any]) -> dict[str, Any]:
    """What a replay of a recorded verdict must say again."""
    said = {name: value for name, value in verdict.items() if name not in IGNORED_FIELDS}
    return dict(without_null(said))


def without_null(value: Any) -> Any:  # noqa: ANN401
    """A message as it is recorded, where null is left out, but for a finger that is not known."""
    if isinstance(value, dict):
        if isinstance(fingers := value.get("fingers"), dict):
            felt = {finger: state or "unknown" for finger, state in fingers.items()}
            value = value | {"fingers": felt}
        return {name: without_null(one) for name, one in value.items() if one is not None}
    return value


@dataclass
class Lab:
    """What was recorded, and what the controller saw and told."""

    folder: Path
    told: dict[int, str] = field(default_factory=dict)
    """How each lift ended, by grasp."""
    answers: list[dict[str, Any]] = field(default_factory=list)
    verdicts: list[Verdict] = field(default_factory=list)
    """As a subscriber got them."""

    @property
    def files(self) -> list[Path]:
        return files(self.folder)


def files(folder: Path) -> list[Path]:
    """The recordings, oldest first."""
    return sorted((folder / "record").glob("*.mcap"))


def recorder(
    folder: Path,
    take_header: Callable[[], MakeHeader] = lambda: lambda: HEADER,
    *,
    tap: Tap | None = None,
    clock: Callable[[], int] = time.monotonic_ns,
    **options: Any,  # noqa: ANN401
) -> Recorder:
    """A recorder in a folder."""
    wanted = Record(**{"directory": folder / "record", **options})
    return Recorder(wanted, "right", BOOT, take_header=take_header, tap=tap, clock=clock)


def scene(folder: Path, more: str = "", gate: str = "") -> Path:
    """A scene that plays the demo recording and records; no reading is too old for it."""
    path = folder / "scene.toml"
    path.write_text(
        f'[tactile]\ndriver = "replay"\nloop = true\nrecordings = ["{DEMO_RECORDING}"]\n'
        f'[publish]\nendpoint = "ipc://{folder}/graspd"\n[ask]\nendpoint = "ipc://{folder}/ask"\n'
        f'[record]\ndirectory = "record"\n{more}'
        f"[gate]\nmax_age_ms = 10000\n{gate}"
    )
    return path


def messages(path: Path) -> list[tuple[str, dict[str, Any]]]:
    """Kind and content of each message of a recording."""
    with open_recording(path) as stream:
        recording = McapReader(path, stream)
        return [(message.kind, json.loads(message.payload)) for message in recording]


def work(folder: Path, grasps: int, more: str = "") -> Lab:
    """Run until so many grasps were judged, telling of each but the first."""
    lab = Lab(folder)
    running = start("run", scene(folder, more))
    with running as daemon, zmq.Context() as context:
        wait_for(folder / "ask")
        with context.socket(zmq.SUB) as listener, context.socket(zmq.REQ) as controller:
            listener.connect(f"ipc://{folder}/graspd")
            listener.subscribe("verdict.")
            controller.routing_id = NAME
            controller.connect(f"ipc://{folder}/ask")
            controller.linger = 0
            _lift(lab, grasps, listener, controller)
        daemon.terminate()
        _, said = daemon.communicate(timeout=TIMEOUT_S)
    assert daemon.returncode == 0, said
    return lab


def _lift(
    lab: Lab, grasps: int, listener: zmq.Socket[bytes], controller: zmq.Socket[bytes]
) -> None:
    deadline_s = time.monotonic() + TIMEOUT_S
    seen: dict[int, Verdict] = {}
    may_tell = False
    while len(lab.told) < grasps - 1:
        assert time.monotonic() < deadline_s
        assert listener.poll(100_000)
        verdict = decode_verdict(listener.recv_multipart()[1])
        lab.verdicts.append(verdict)
        if verdict.judged and len(seen) < grasps:
            seen.setdefault(verdict.grasp, verdict)
        if not may_tell and is_offer(verdict):
            may_tell = is_offer(decode_verdict(answer_to(b"lift", controller)))
        if may_tell:
            _tell(lab, list(seen.values()), controller)


def _tell(lab: Lab, seen: list[Verdict], controller: zmq.Socket[bytes]) -> None:
    for number, verdict in enumerate(seen[1:], 2):
        if verdict.grasp not in lab.told:
            outcome = lab.told[verdict.grasp] = "slip" if number % 2 else "stable"
            told = f"outcome {verdict.boot_id} {verdict.grasp} {outcome}".encode()
            lab.answers.append(json.loads(answer_to(told, controller)))


def is_offer(verdict: Verdict) -> bool:
    """Whether a hand may lift on it unwatched: the peer that is answered so may tell outcomes."""
    return verdict.verdict == "stable"


def answer_to(text: bytes, controller: zmq.Socket[bytes]) -> bytes:
    """What graspd answers."""
    controller.send(text)
    assert controller.poll(100_000)
    return controller.recv()
