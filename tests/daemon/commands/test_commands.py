"""The commands as a user runs them: real processes, real files, real sockets."""

from __future__ import annotations

import json
import os
import re
import signal
import socket
import sys
from pathlib import Path

import pytest

from graspd.drivers.recordings.csv_player import DEMO_TABLE
from tests.daemon.processes import TIMEOUT_S, start
from tests.kit.inside import graspd
from tests.kit.programs import ran
from tests.kit.scenes import written

DEPLOY = Path(__file__).parents[3] / "deploy"


PALM = '[tactile]\ndriver = "palm"\n'


def test_run_names_the_process_that_has_the_port(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pid = os.getpid()
    monkeypatch.setattr("os.getpid", lambda: 1)  # this process counts as another one
    with (
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as udp,
        socket.create_server(("127.0.0.1", 0)) as tcp,
    ):
        udp.bind(("127.0.0.1", 0))
        endpoint = f"ipc://{tmp_path}/graspd"
        for source, publish in (
            (f"udp://127.0.0.1:{udp.getsockname()[1]}", endpoint),
            ("udp://127.0.0.1:0", f"tcp://127.0.0.1:{tcp.getsockname()[1]}"),
        ):
            text = f'[publish]\nendpoint = "{publish}"\n[session]\nkeep = false\n'
            scene = written(tmp_path, f'{PALM}source = "{source}"\n{text}')
            result = graspd("run", scene)
            assert result.returncode == 1, result.stderr
            assert f"Address already in use: PID {pid}, " in result.stderr


def loop_scene(folder: Path) -> Path:
    """A copy of deploy/clients/loop.toml that makes all its files in this folder."""
    pytest.importorskip("mcap", reason="needs the extra `record`")
    text = (DEPLOY / "clients/loop.toml").read_text().replace("/tmp/graspd-", f"{folder}/")
    scene = folder / "loop.toml"
    scene.write_text(text.replace("../../drivers/recordings/demo", str(DEMO_TABLE.parent)))
    return scene


@pytest.mark.slow
def test_the_example_controller_reports_outcomes_that_are_learned_and_recorded(
    tmp_path: Path,
) -> None:
    scene = loop_scene(tmp_path)
    code = (DEPLOY / "clients/python/try_outcomes.py").read_text()
    assert "/tmp/graspd-loop.ipc" in code
    with start("run", scene) as process:
        controller = ran(
            *(sys.executable, "-c", code.replace("/tmp/graspd-", f"{tmp_path}/")),
            env={**os.environ, "PYTHONPATH": str(DEPLOY / "clients/python")},
            typed="slipped\nwhat\nh\n",  # and then the input ends
        )
        process.send_signal(signal.SIGTERM)
        process.communicate(timeout=TIMEOUT_S)
    assert (controller.returncode, controller.stderr) == (0, "")
    assert re.search(r"^grasp \d+: (slip|stable), p_slip 0\.\d\d Risk\(", controller.stdout)
    assert "0 outcomes told. Did it hold? y/n told\n" in controller.stdout
    assert "1 outcomes told." in controller.stdout
    assert process.returncode == 0
    replayed = graspd("replay", *(tmp_path / "loop-record").glob("*.mcap"), "--json")
    summary = json.loads(replayed.stderr.splitlines()[-1])
    assert (summary["labelled"], summary["outcomes"]) == (2, 2)
