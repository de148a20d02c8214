"""Daemon, twin and doctor as processes of their own, over the real transports."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from daemon.publish.messages import Verdict, decode_verdict
from drivers.recordings.csv_player import DEMO_TABLE
from tests.daemon.processes import SUBSCRIBER, TIMEOUT_S, graspd, start, wait_for

WANTED = 150
"""Verdicts to wait for, of the 200 rows of the recording."""

SCENES = {
    "spi": 'driver = "spi"\nport = "{folder}/bridge"',
    "can": 'driver = "can"\ninterface = "udp_multicast"\nchannel = "239.74.163.2"\n'
    'sequence = "electrodes"',
    "palm": 'driver = "palm"\nsource = "udp://127.0.0.1:{port}"',
}
TWINS: dict[str, list[str]] = {
    "spi": ["--path", "{folder}/bridge"],
    "can": [],
    "palm": ["--to", "udp://127.0.0.1:{port}"],
}
PORT = 25911


MODEL = "cnn1"
"""Its verdict on a reading does not depend on what came before."""


EVERY = '[gate]\nmode = "every"\n'
"""The rows of a grasp table follow each other faster than any hand can grasp."""


def scene_for(kind: str, folder: Path, gate: str = EVERY) -> Path:
    scene = folder / "scene.toml"
    scene.write_text(
        f"[tactile]\n{SCENES[kind].format(folder=folder, port=PORT)}\n{gate}"
        f'[model]\nname = "{MODEL}"\n[publish]\nendpoint = "ipc://{folder}/graspd"\n'
    )
    return scene


def twin(kind: str, folder: Path, *more: str) -> subprocess.Popen[str]:
    options = [option.format(folder=folder, port=PORT) for option in TWINS[kind]]
    return start("twin", kind, *options, *more)


def end(process: subprocess.Popen[str]) -> str:
    process.send_signal(signal.SIGTERM)
    output, errors = process.communicate(timeout=TIMEOUT_S)
    assert process.returncode == 0, errors
    return output


def replayed() -> list[float | None]:
    result = graspd("replay", DEMO_TABLE, "--json", "--model", MODEL)
    return [json.loads(line)["p_slip"] for line in result.stdout.splitlines()]


def published(folder: Path, wanted: int) -> list[Verdict]:
    command = [sys.executable, "-c", SUBSCRIBER, f"ipc://{folder}/graspd", str(wanted)]
    result = subprocess.run(command, capture_output=True, check=True, timeout=TIMEOUT_S)
    return [decode_verdict(line) for line in result.stdout.splitlines()]


@pytest.mark.parametrize("kind", TWINS)
def test_a_recording_on_the_wire_gets_the_verdicts_of_its_replay(tmp_path: Path, kind: str) -> None:
    with start("run", scene_for(kind, tmp_path)) as daemon:
        wait_for(tmp_path / "graspd")
        with twin(kind, tmp_path, "--recording", str(DEMO_TABLE), "--loop") as hardware:
            verdicts = published(tmp_path, WANTED)
            output = end(hardware)
        end(daemon)
    judged = [verdict.p_slip for verdict in verdicts if verdict.valid]
    assert json.loads(output)["injected"] == {}
    assert len(judged) > WANTED * 0.8, [verdict.reasons for verdict in verdicts]
    expected = replayed()
    # A machine that stalls may lose sweeps, so each verdict is looked up in those of all rows. What
    # came before a row decides whether an electrode seems to jump, so a few may differ.
    others = [p_slip for p_slip in judged if p_slip not in set(expected)]
    assert len(others) <= 0.05 * len(judged)


@pytest.mark.parametrize("kind", TWINS)
def test_whole_grasps_on_the_wire_are_judged_once_each(tmp_path: Path, kind: str) -> None:
    with start("run", scene_for(kind, tmp_path, gate="")) as daemon:
        wait_for(tmp_path / "graspd")
        with twin(kind, tmp_path) as hardware:
            verdicts = published(tmp_path, 1100)  # at least two grasps of about four seconds
            end(hardware)
        end(daemon)
    judged = [verdict.grasp for verdict in verdicts if verdict.judged]
    assert {1, 2} <= set(judged)
    first = verdicts[[verdict.judged for verdict in verdicts].index(True)]
    assert first.gate == "judged"
    assert first.contact == ["ff", "mf", "th"]
    for verdict in verdicts:
        assert not verdict.valid or verdict.gate == "judged"
    before = [verdict for verdict in verdicts if verdict.seq < first.seq]
    assert {verdict.verdict for verdict in before} == {"unknown"}
    assert "no-contact" in {reason for verdict in before for reason in verdict.reasons}


def test_an_unplugged_finger_is_unknown_at_the_subscriber(tmp_path: Path) -> None:
    with start("run", scene_for("spi", tmp_path)) as daemon:
        wait_for(tmp_path / "graspd")
        with twin("spi", tmp_path, "--unplugged", "mf") as hardware:
            verdicts = list(published(tmp_path, 60))
            end(hardware)
        end(daemon)
    assert {verdict.verdict for verdict in verdicts} == {"unknown"}
    assert "sensor-missing" in {reason for verdict in verdicts for reason in verdict.reasons}


def test_a_bridge_that_goes_away_gives_unknown_and_comes_back(tmp_path: Path) -> None:
    with start("run", scene_for("spi", tmp_path)) as daemon:
        wait_for(tmp_path / "graspd")
        for _ in range(2):
            recording = ["--recording", str(DEMO_TABLE), "--loop"]
            with twin("spi", tmp_path, *recording) as hardware:
                deadline_s = time.monotonic() + 20
                while not any(verdict.valid for verdict in published(tmp_path, 10)):
                    assert time.monotonic() < deadline_s
                end(hardware)
            gone = published(tmp_path, 10)
            assert [verdict.verdict for verdict in gone[-5:]] == ["unknown"] * 5
            assert gone[-1].reasons == ["stale"]
        end(daemon)


def test_run_prints_verdicts(tmp_path: Path) -> None:
    scene = scene_for("spi", tmp_path)
    with twin("spi", tmp_path, "--recording", str(DEMO_TABLE), "--loop") as hardware:
        with start("run", "--print", scene) as daemon:
            assert daemon.stdout is not None
            lines = [daemon.stdout.readline() for _ in range(30)]
            end(daemon)
        end(hardware)
    assert any("p_slip" in line for line in lines), lines


def test_the_doctor_finds_what_the_twin_broke(tmp_path: Path) -> None:
    scene = scene_for("spi", tmp_path)
    with twin("spi", tmp_path, "--dead", "th_24", "--unplugged", "mf") as hardware:
        people = graspd("doctor", scene, "--listen", 2)
        program = graspd("doctor", scene, "--listen", 2, "--json")
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


def test_the_doctor_says_that_a_port_is_not_there(tmp_path: Path) -> None:
    result = graspd("doctor", scene_for("spi", tmp_path), "--listen", 0.3)
    assert result.returncode == 1
    assert "no reading in 0.3 s" in result.stdout
    assert str(tmp_path / "bridge") in result.stdout


def test_the_doctor_without_a_scene_looks_at_the_computer() -> None:
    result = graspd("doctor", "--listen", 0.3, "--json")
    assert result.returncode in (0, 1)
    assert json.loads(result.stdout)["findings"]


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["twin"], "required"),
        (["twin", "spi", "--drop", "2"], "drop_probability is 2.0, must be in 0..1"),
        (["twin", "spi", "--dead", "th"], "'th' is no electrode"),
        (["twin", "palm", "--to", "nowhere"], "nowhere"),
        (["twin", "palm", "--one-byte-at-a-time"], "datagrams are not sent byte by byte"),
        (["twin", "joints", "--unplugged", "mf"], "the joint stream has no electrodes"),
        (["twin", "spi", "--recording", "absent.csv"], "absent.csv"),
        (["doctor", "absent.toml"], "absent.toml: cannot read the scene"),
    ],
)
def test_a_wrong_command_line_is_exit_code_2(arguments: list[str], says: str) -> None:
    result = graspd(*arguments)
    assert result.returncode == 2, result
    assert says in result.stderr
    assert "Traceback" not in result.stderr
