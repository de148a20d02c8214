"""The commands as a user runs them: real processes, real files, real sockets."""

from __future__ import annotations

import csv
import functools
import hashlib
import http.server
import json
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jsonschema
import pytest

from daemon.judge.verdict import decode_verdict, schema
from drivers.replay import DEMO_RECORDING
from models.bts3 import TABLES
from tests.daemon.processes import GRASPD, SUBSCRIBER, TIMEOUT_S, graspd, start, wait_for


def demo_rows() -> list[dict[str, str]]:
    with DEMO_RECORDING.open(newline="") as file:
        return list(csv.DictReader(file))


def test_replay_without_arguments_judges_the_demo_recording() -> None:
    result = graspd("replay")
    assert result.returncode == 0, result.stderr
    *verdicts, blank, counts, scores, latency = result.stdout.splitlines()
    assert len(verdicts) == len(demo_rows())
    assert blank == ""
    assert counts.startswith(f"{len(verdicts)} verdicts in ")
    assert "recorded outcomes (slip positive): accuracy" in scores
    assert latency.startswith("reading to verdict: p50 ")
    assert all("synthetic" in line for line in verdicts)


def test_replay_json_gives_one_valid_verdict_per_real_grasp(bts3_dir: Path) -> None:
    result = graspd("replay", bts3_dir / "palm_down.csv", "--json")
    assert result.returncode == 0, result.stderr
    lines = result.stdout.splitlines()
    assert len(lines) == 1276
    validator = jsonschema.Draft202012Validator(schema() | {"anyOf": [{"$ref": "#/$defs/Verdict"}]})
    for number, line in enumerate(lines):
        content = json.loads(line)
        validator.validate(content)
        assert content["seq"] == number
        assert content["grasp"] == number + 1
    summary = json.loads(result.stderr)
    assert sum(summary["verdicts"].values()) == 1276
    assert summary["labelled"] == 1276
    # The published network reaches 94 on grasps it has not seen; these it has seen.
    assert summary["scores"]["f1"] > 0.94


def test_a_subscriber_in_another_process_gets_every_paced_verdict(
    bts3_dir: Path, tmp_path: Path
) -> None:
    endpoint = f"ipc://{tmp_path}/graspd"
    command = [sys.executable, "-c", SUBSCRIBER, endpoint, "1276"]
    received = tmp_path / "received"
    with received.open("w") as file, subprocess.Popen(command, stdout=file) as subscriber:
        result = graspd(
            "replay",
            bts3_dir / "palm_down.csv",
            *("--json", "--speed", 4, "--publish", endpoint, "--wait", 20),
        )
        subscriber.wait(TIMEOUT_S)
    assert result.returncode == 0, result.stderr
    assert received.read_text() == result.stdout
    assert len(result.stdout.splitlines()) == 1276
    assert list(tmp_path.iterdir()) == [received]


def test_replay_fails_when_nobody_subscribes(tmp_path: Path) -> None:
    result = graspd("replay", "--publish", f"ipc://{tmp_path}/graspd", "--wait", 0.1)
    assert result.returncode == 1
    assert result.stderr.startswith("graspd: nobody subscribed to ipc://")


def peak_memory_kib(recording: Path) -> int:
    """Peak resident memory of a replay, from the kernel's own account."""
    process = subprocess.Popen(
        [*GRASPD, "replay", str(recording), "--json"],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    _, status, usage = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    assert process.returncode == 0
    return usage.ru_maxrss


def test_memory_does_not_grow_with_the_length_of_the_file(tmp_path: Path) -> None:
    header, *rows = DEMO_RECORDING.read_text().splitlines(keepends=True)
    short, long = tmp_path / "short.csv", tmp_path / "long.csv"
    short.write_text(header + "".join(rows))
    long.write_text(header + "".join(rows) * 100)  # 20,000 grasps, 7.5 MB
    assert peak_memory_kib(long) - peak_memory_kib(short) < 2048


@pytest.mark.parametrize(
    ("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)], ids=["INT", "TERM"]
)
def test_a_signal_ends_a_replay_with_its_summary_and_nothing_left(
    tmp_path: Path, number: signal.Signals, code: int
) -> None:
    endpoint = f"ipc://{tmp_path}/graspd"
    with start("replay", "--loop", "--speed", 1, "--json", "--publish", endpoint) as process:
        assert process.stdout is not None
        first = process.stdout.readline() if number is signal.SIGINT else ""
        wait_for(tmp_path / "graspd")
        process.send_signal(number)
        _, errors = process.communicate(timeout=TIMEOUT_S)
    assert process.returncode == code
    assert json.loads(errors)["verdicts"]
    if first:
        decode_verdict(first.encode())
    assert list(tmp_path.iterdir()) == []


def test_run_publishes_until_it_is_told_to_stop(tmp_path: Path) -> None:
    scene = tmp_path / "scene.toml"
    endpoint = f"ipc://{tmp_path}/graspd"
    scene.write_text(
        f'[tactile]\ndriver = "replay"\nloop = true\nrecordings = ["{DEMO_RECORDING}"]\n'
        f'[publish]\nendpoint = "{endpoint}"\n'
    )
    with start("run", scene) as process:
        command = [sys.executable, "-c", SUBSCRIBER, endpoint, "20"]
        received = subprocess.run(command, capture_output=True, check=True, timeout=TIMEOUT_S)
        process.send_signal(signal.SIGTERM)
        process.communicate(timeout=TIMEOUT_S)
    verdicts = [decode_verdict(line) for line in received.stdout.splitlines()]
    assert [verdict.seq - verdicts[0].seq for verdict in verdicts] == list(range(20))
    assert process.returncode == 0
    assert sorted(path.name for path in tmp_path.iterdir()) == ["scene.toml"]


def test_run_says_in_one_line_why_it_cannot_start(tmp_path: Path) -> None:
    scene = tmp_path / "scene.toml"
    scene.write_text('[tactile]\ndriver = "replay"\nrecordings = ["absent.csv"]\n[hnad]\n')
    result = graspd("run", scene)
    assert result.returncode == 2
    assert result.stderr == f"graspd: {scene}: hnad: no such key; did you mean hand?\n"


FAULTS = {
    "off_from = 3": "stale",
    "stuck_from = 3": "frozen",
    "garbage_probability = 1.0": "not-a-count",
    "wrong_counts = 4000": "saturated",
    "slow_every = 50": "stale",
    "delayed_s = 0.5": "stale",
    "intermittent_probability = 0.97": "stale",
}


@pytest.mark.parametrize("fault", FAULTS)
def test_a_sensor_that_fails_ends_in_unknown_at_the_subscriber(tmp_path: Path, fault: str) -> None:
    scene = tmp_path / "scene.toml"
    endpoint = f"ipc://{tmp_path}/graspd"
    scene.write_text(
        f'[tactile]\ndriver = "replay"\nloop = true\nrecordings = ["{DEMO_RECORDING}"]\n'
        f'[tactile.faults]\n{fault}\n[publish]\nendpoint = "{endpoint}"\n'
    )
    with start("run", scene) as process:
        command = [sys.executable, "-c", SUBSCRIBER, endpoint, "12"]
        received = subprocess.run(command, capture_output=True, check=True, timeout=TIMEOUT_S)
        process.send_signal(signal.SIGTERM)
        process.communicate(timeout=TIMEOUT_S)
    verdicts = [decode_verdict(line) for line in received.stdout.splitlines()]
    assert len(verdicts) == 12
    assert FAULTS[fault] in {reason for verdict in verdicts for reason in verdict.reasons}
    if not fault.startswith(("slow", "intermittent")):
        assert {verdict.verdict for verdict in verdicts[4:]} == {"unknown"}


def replace_cell(text: str) -> str:
    header, first, *rest = DEMO_RECORDING.read_text().splitlines()
    cells = first.split(",")
    cells[2] = text
    return "\n".join([header, ",".join(cells), *rest]) + "\n"


@pytest.mark.parametrize(
    "text", ["nan", "-1", "4096", "1e9", "text", "", "2602.5", "inf", "0x10", "1_000"]
)
def test_a_value_that_is_no_count_makes_that_grasp_unknown(tmp_path: Path, text: str) -> None:
    recording = tmp_path / "grasps.csv"
    recording.write_text(replace_cell(text))
    result = graspd("replay", recording, "--json")
    assert result.returncode == 0, result.stderr
    first, second, *_ = (json.loads(line) for line in result.stdout.splitlines())
    assert (first["verdict"], first["reasons"]) == ("unknown", ["not-a-count"])
    assert second["reasons"] == []
    strict = graspd("replay", recording, "--strict", "--json")
    assert strict.returncode == 2
    assert f"{recording}, line 2, column ff_biotac_1: " in strict.stderr.splitlines()[-1]


def bad_recordings() -> dict[str, tuple[bytes | None, str]]:
    content = DEMO_RECORDING.read_bytes()
    header, first, *rest = content.splitlines(keepends=True)
    without = header.replace(b",mf_biotac_7,", b",") + first.replace(b",", b"", 1)
    short = b"".join([header, first, first.rsplit(b",", 1)[0] + b"\n", *rest])
    return {
        "absent": (None, "no such file"),
        "empty": (b"", "empty"),
        "binary": (bytes(range(256)) * 100, ""),
        "header without one electrode": (without, "mf_biotac_7"),
        "row of 71 values": (short, "line 3"),
        "truncated": (content[: len(content) // 2], "line "),
    }


@pytest.mark.parametrize("name", bad_recordings())
def test_a_bad_recording_is_one_clear_line(tmp_path: Path, name: str) -> None:
    content, says = bad_recordings()[name]
    recording = tmp_path / "bad.csv"
    if content is not None:
        recording.write_bytes(content)
    result = graspd("replay", recording)
    assert result.returncode == 2
    (message,) = result.stderr.splitlines()
    assert message.startswith(f"graspd: {recording}")
    assert says in message


def test_the_end_of_the_reader_ends_the_replay_quietly() -> None:
    with start("replay") as process:
        assert process.stdout is not None
        process.stdout.readline()
        process.stdout.close()
        process.wait(TIMEOUT_S)
        assert process.stderr is not None
        assert process.stderr.read() == ""
    assert process.returncode == 0


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["replay", "--model", "nonsense"], "no model 'nonsense' in the zoo"),
        (["replay", "--model", "absent.onnx"], "absent.onnx: cannot read the model"),
        (["replay", "--model", __file__ + ".onnx"], "cannot read the model"),
        (["replay", "--speed", "0"], "0 is not a positive number"),
        (["replay", "--speed", "nan"], "nan is not a positive number"),
        (["replay", "--publish", "tcp://1.2.3.4:5"], "not a loopback address"),
        (["run", "absent.toml"], "absent.toml: cannot read the scene"),
        (["nonsense"], "invalid choice"),
        ([], "required"),
    ],
)
def test_a_wrong_command_line_is_exit_code_2(arguments: list[str], says: str) -> None:
    result = graspd(*arguments)
    assert result.returncode == 2
    assert says in result.stderr
    assert "Traceback" not in result.stderr


def test_check_says_what_is_in_and_what_is_left_out() -> None:
    scene = Path(__file__).parents[2] / "deploy" / "scenes" / "demo.toml"
    people = graspd("check", scene)
    assert people.returncode == 0, people.stderr
    assert "fine" in people.stdout
    content = json.loads(graspd("check", scene, "--json").stdout)
    assert "synthetic_grasps.csv" in content["in"]["tactile"]
    assert "cnn1" in content["in"]["model"]
    assert "rf, lf" in content["left_out"]["fingers"]
    assert "joints" in content["left_out"]


def test_check_finds_a_recording_that_is_not_there(tmp_path: Path) -> None:
    scene = tmp_path / "scene.toml"
    scene.write_text('[tactile]\ndriver = "replay"\nrecordings = ["absent.csv"]\n')
    result = graspd("check", scene)
    assert result.returncode == 2
    assert "absent.csv" in result.stderr


def test_check_refuses_a_hand_that_the_model_does_not_know(tmp_path: Path) -> None:
    scene = tmp_path / "scene.toml"
    scene.write_text(
        f'[hand]\nfingers = ["ff", "th"]\n[tactile]\ndriver = "replay"\n'
        f'recordings = ["{DEMO_RECORDING}"]\n'
    )
    result = graspd("check", scene)
    assert result.returncode == 2
    assert "judges the fingers ff, mf, th in this order, the hand has ff, th" in result.stderr


class QuietHandler(http.server.SimpleHTTPRequestHandler):
    def log_message(self, format: str, *args: Any) -> None:  # noqa: A002, ANN401 - its signature
        pass


@pytest.fixture
def mirror(tmp_path: Path) -> Iterator[tuple[Path, str]]:
    """A folder served over HTTP on the loopback address."""
    folder = tmp_path / "mirror"
    folder.mkdir()
    handler = functools.partial(QuietHandler, directory=str(folder))
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        yield folder, f"http://127.0.0.1:{server.server_port}"
        server.shutdown()
        thread.join()


def test_data_is_fetched_and_checked(
    bts3_dir: Path, mirror: tuple[Path, str], tmp_path: Path
) -> None:
    folder, address = mirror
    for table in TABLES:
        (folder / table.upstream_name).write_bytes((bts3_dir / f"{table.name}.csv").read_bytes())
    result = graspd("data", "--to", tmp_path / "data", "--url", address)
    assert result.returncode == 0, result.stderr
    for table in TABLES:
        content = (tmp_path / "data" / f"{table.name}.csv").read_bytes()
        assert hashlib.sha256(content).hexdigest() == table.sha256
    again = graspd("data", "--to", tmp_path / "data", "--url", "http://127.0.0.1:9")
    assert again.returncode == 0
    assert again.stdout.count("is there") == 3


def test_data_from_a_folder_is_checked(bts3_dir: Path, tmp_path: Path) -> None:
    assert graspd("data", "--to", tmp_path, "--from", bts3_dir).returncode == 0
    assert sorted(path.name for path in tmp_path.iterdir()) == [
        "palm_45.csv",
        "palm_down.csv",
        "palm_side.csv",
    ]


def test_data_that_was_changed_is_refused(mirror: tuple[Path, str], tmp_path: Path) -> None:
    folder, address = mirror
    (folder / TABLES[0].upstream_name).write_text("object,slipped\n")
    result = graspd("data", "--to", tmp_path / "data", "--url", address)
    assert result.returncode == 1
    assert "SHA-256 differs" in result.stderr
    assert list((tmp_path / "data").iterdir()) == []


def test_data_that_is_not_there_is_said(mirror: tuple[Path, str], tmp_path: Path) -> None:
    result = graspd("data", "--to", tmp_path / "data", "--url", mirror[1])
    assert result.returncode == 1
    assert "404" in result.stderr
    result = graspd("data", "--to", tmp_path / "data", "--from", tmp_path)
    assert result.returncode == 1
    assert "has neither" in result.stderr


def test_the_schema_is_printed() -> None:
    assert json.loads(graspd("schema").stdout) == schema()
