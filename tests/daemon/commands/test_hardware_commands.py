"""Daemon, twin and doctor as processes of their own, over the real transports."""

from __future__ import annotations

import json
import signal
import socket
import subprocess
import time
from pathlib import Path

import numpy as np
import pytest

from graspd.daemon.publish.messages import Tactile
from graspd.drivers.recordings.csv_player import DEMO_TABLE
from graspd.drivers.recordings.csv_rows import read_rows
from tests.bench.live import Subscriber
from tests.daemon.processes import GRASPD, TIMEOUT_S, start, wait_for
from tests.kit.messages import decode_tactile
from tests.kit.programs import ran
from tests.kit.scenes import written
from tests.ports import can_id, free_port, multicast_group

pytestmark = pytest.mark.slow

WANTED = 150
"""Readings to wait for, of the 200 rows of the recording."""

GROUP = multicast_group()
SCENES = {
    "spi": 'driver = "spi"\nport = "{folder}/bridge"',
    "can": 'driver = "can"\ninterface = "udp_multicast"\nchannel = "{group}"\n'
    'sequence = "electrodes"\narbitration_id = {id}',
    "palm": 'driver = "palm"\nsource = "udp://127.0.0.1:{port}"',
    "datagrams": 'driver = "datagrams"\nsource = "udp://127.0.0.1:{port}"',
}
TWINS: dict[str, list[str]] = {
    "spi": ["--path", "{folder}/bridge"],
    "can": ["--channel", "{group}", "--arbitration-id", "{id}"],
    "palm": ["--to", "udp://127.0.0.1:{port}"],
    "datagrams": ["--to", "udp://127.0.0.1:{port}"],
}
PORT = free_port(socket.SOCK_DGRAM)


def filled(text: str, folder: Path) -> str:
    """Return a text of `SCENES` or `TWINS` with its folder, port, bus and CAN id filled in."""
    return text.format(folder=folder, port=PORT, group=GROUP, id=can_id(GROUP))


def scene_for(kind: str, folder: Path) -> Path:
    return written(
        folder,
        f"[tactile]\n{filled(SCENES[kind], folder)}\n"
        f'[model]\nname = "cnn1"\n[publish]\nendpoint = "ipc://{folder}/graspd"\n'
        "tactile_hz = 10000\n",
    )


def twin(kind: str, folder: Path, *more: str) -> subprocess.Popen[str]:
    options = [filled(option, folder) for option in TWINS[kind]]
    return start("twin", kind, *options, *more)


def end(process: subprocess.Popen[str]) -> str:
    process.send_signal(signal.SIGTERM)
    output, errors = process.communicate(timeout=TIMEOUT_S)
    assert process.returncode == 0, errors
    return output


def heard(folder: Path, wanted: int) -> list[Tactile]:
    """The first `wanted` published readings without faults; fewer if they cease to come."""
    found: list[Tactile] = []
    with Subscriber(f"ipc://{folder}/graspd", topics=("tactile.",)) as subscriber:
        while len(found) < wanted and (message := subscriber.take(TIMEOUT_S)) is not None:
            reading = decode_tactile(message[1])
            if not np.any(reading.faults):
                found.append(reading)
    return found


@pytest.mark.parametrize("kind", TWINS)
def test_a_recording_sent_by_a_twin_is_published_unchanged(tmp_path: Path, kind: str) -> None:
    with start("run", scene_for(kind, tmp_path)) as daemon:
        wait_for(tmp_path / "graspd")
        with twin(kind, tmp_path, "--recording", str(DEMO_TABLE), "--loop") as hardware:
            readings = heard(tmp_path, WANTED)
            output = end(hardware)
        end(daemon)
    sound = [str(reading.counts) for reading in readings]
    assert json.loads(output)["injected"] == {}
    assert len(sound) == WANTED
    rows = {str(row.counts.tolist()) for row in read_rows(DEMO_TABLE, ("ff", "mf", "th"))}
    # A machine that stalls may lose sweeps, so each reading is looked up in all rows.
    assert set(sound) <= rows


@pytest.mark.parametrize("kind", ["spi", "can", "datagrams"])
def test_a_slow_twin_ends_soon_after_a_signal(tmp_path: Path, kind: str) -> None:
    with twin(kind, tmp_path, "--rate", "0.1") as hardware:
        assert hardware.stderr is not None
        hardware.stderr.readline()
        time.sleep(0.5)
        before_s = time.monotonic()
        end(hardware)
        assert time.monotonic() - before_s < 4.0


def test_the_doctor_finds_the_faults_that_a_twin_simulates(tmp_path: Path) -> None:
    scene = scene_for("spi", tmp_path)
    with twin("spi", tmp_path, "--dead", "th_24", "--unplugged", "mf") as hardware:
        people = ran(*GRASPD, "doctor", scene, "--listen", 2)
        program = ran(*GRASPD, "doctor", scene, "--listen", 2, "--json")
        end(hardware)
    assert people.returncode == program.returncode == 1
    report = json.loads(program.stdout)
    wrong = [finding["what"] for finding in report["findings"] if finding["level"] == "error"]
    assert any(what.startswith("mf: no electrode can be read") for what in wrong)
    assert "th_24 stuck at a rail" in wrong
    assert len(wrong) == 2
    assert report["readings"] > 50
    for what in wrong:
        assert what in people.stdout


def test_the_doctor_without_a_scene_looks_at_the_computer() -> None:
    result = ran(*GRASPD, "doctor", "--listen", 0.3, "--json")
    assert result.returncode in (0, 1)
    assert json.loads(result.stdout)["findings"]
