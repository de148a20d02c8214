"""The commands as a user runs them: real processes, real files, real sockets."""

from __future__ import annotations

import json
import os
import re
import signal
import socket
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from graspd.drivers.recordings.csv_player import DEMO_RECORDING, DEMO_TABLE
from tests.daemon.processes import TIMEOUT_S, start
from tests.kit.inside import graspd
from tests.kit.scenes import written

DEPLOY = Path(__file__).parents[3] / "deploy"


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["replay", "--speed", "nan"], "nan is not a number from 0.001 to 1e+06"),
        (["replay", "--publish", "tcp://1.2.3.4:5"], "not a loopback address"),
        (["replay", "--publish", "ipc://*"], "needs a path that subscribers can know"),
        (["replay", "--publish", "tcp://127.0.0.1:*"], "needs a port"),
        (["replay", "--max-slip-when-stable", "0.1", "--warm-up", "-1"], "risk.warm_up"),
        (["replay", str(DEMO_TABLE), "--max-slip-when-stable", "0.1"], "it needs --outcomes"),
        (["replay", str(DEMO_TABLE), str(DEMO_RECORDING)], "both grasp tables and streams"),
        (["twin", "spi", "--drop", "2"], "drop_probability is 2.0, must be in 0..1"),
        (["twin", "spi", "--dead", "th"], "'th' is not an electrode"),
        (["twin", "palm", "--one-byte-at-a-time"], "cannot show the fault one-byte-at-a-time"),
    ],
)
def test_a_wrong_command_line_is_exit_code_2(arguments: list[str], says: str) -> None:
    result = graspd(*arguments)
    assert result.returncode == 2
    assert says in result.stderr
    assert "Traceback" not in result.stderr


CAN, PALM = '[tactile]\ndriver = "can"\n', '[tactile]\ndriver = "palm"\n'


def checked(folder: Path, text: str) -> dict[str, Any]:
    """What `graspd check` tells programs of a scene that is right."""
    result = graspd("check", written(folder, text), "--json")
    assert result.returncode == 0, result.stderr
    document: dict[str, Any] = json.loads(result.stdout)
    return document


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


TWO = '[hand]\nname = "{}"\n[tactile]\ndriver = {}\n[publish]\nendpoint = "{}"\n'


@pytest.mark.parametrize(
    ("hand", "tactile", "endpoint", "shared"),
    [
        ("left", '"spi"\nport = "/dev/b"', "tcp://127.0.0.1:6001", []),
        (
            "right",
            '"spi"\nport = "/dev/b"',
            "tcp://127.0.0.1:6001",
            ["hand.name", "session.folder"],
        ),
        ("left", '"spi"\nport = "/dev/../dev/a"', "tcp://127.0.0.1:6001", ["tactile.port"]),
        ("left", '"can"', "tcp://[::ffff:127.0.0.1]:6000", ["endpoint"]),
    ],
)
def test_check_says_what_two_scenes_cannot_share(
    tmp_path: Path, hand: str, tactile: str, endpoint: str, shared: list[str]
) -> None:
    right = written(tmp_path, TWO.format("right", '"spi"\nport = "/dev/a"', "tcp://127.0.0.1:6000"))
    other = tmp_path / "other.toml"
    other.write_text(TWO.format(hand, tactile, endpoint))
    result = graspd("check", right, other)
    _, _, told = result.stderr.partition("cannot run together: the same ")
    assert re.findall(r"(?:^|, )([a-z.]+)", told) == shared
    assert result.returncode == 0


@pytest.mark.parametrize(
    ("source", "only_from", "warned"),
    [
        ("udp://0.0.0.0:9870", "", True),
        ("udp://[::]:9870", "", True),
        ("udp://0.0.0.0:9870", "10.0.0.2", False),
        ("udp://[::]:9870", "fd00::2", False),
        ("udp://127.0.0.1:9870", "", False),
        ("udp://10.0.0.1:9870", "", False),
    ],
)
def test_check_warns_of_udp_that_anybody_can_send_to(
    tmp_path: Path, source: str, only_from: str, warned: bool
) -> None:
    heard = f'source = "{source}"\n' + (f'only_from = "{only_from}"\n' if only_from else "")
    stream = f'[joints]\ndriver = "stream"\n{heard.replace(":98", ":99")}'
    told = checked(tmp_path, f"{PALM}{heard}{stream}")["warnings"]
    assert [warning[: warning.index(" ")] for warning in told] == ["[tactile]", "[joints]"] * warned
    assert all("name its sender with only_from" in warning for warning in told)


@pytest.mark.parametrize(
    ("tactile", "absent"),
    [
        ('driver = "spi"\nport = "{folder}/bridge"\n', "the port {folder}/bridge"),
        ('driver = "spi"\nport = "{folder}/there"\n', None),
        ('driver = "spi"\nport = "socket://localhost:1"\n', None),
        ('driver = "can"\nchannel = "can77"\n', "the CAN interface can77"),
        ('driver = "can"\ninterface = "virtual"\nchannel = "can77"\n', None),
    ],
)
def test_check_says_that_a_port_is_not_there_yet(
    tmp_path: Path, tactile: str, absent: str | None
) -> None:
    (tmp_path / "there").touch()
    told = checked(tmp_path, "[tactile]\n" + tactile.format(folder=tmp_path))["warnings"]
    said = "" if absent is None else f"{absent.format(folder=tmp_path)} is not there yet; "
    assert [warning.startswith(said) for warning in told] == [True] * (absent is not None)


def loop_scene(folder: Path) -> Path:
    """The scene to try the whole loop with, and all that it makes, in this folder."""
    pytest.importorskip("mcap", reason="needs the extra `record`")
    text = (DEPLOY / "clients/loop.toml").read_text().replace("/tmp/graspd-", f"{folder}/")
    scene = folder / "loop.toml"
    scene.write_text(text.replace("../../drivers/recordings/demo", str(DEMO_TABLE.parent)))
    return scene


@pytest.mark.slow
def test_the_whole_loop_asks_tells_learns_and_records(tmp_path: Path) -> None:
    scene = loop_scene(tmp_path)
    code = (DEPLOY / "clients/python/try_outcomes.py").read_text()
    assert "/tmp/graspd-loop.ipc" in code
    with start("run", scene) as process:
        controller = subprocess.run(
            [sys.executable, "-c", code.replace("/tmp/graspd-", f"{tmp_path}/")],
            env={**os.environ, "PYTHONPATH": str(DEPLOY / "clients/python")},
            input="slipped\nwhat\nh\n",  # and then the input ends
            capture_output=True,
            text=True,
            timeout=TIMEOUT_S,
            check=False,
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
