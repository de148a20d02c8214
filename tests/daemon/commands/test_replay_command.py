"""`graspd replay` as a user runs it: real processes, real files, real sockets."""

from __future__ import annotations

import csv
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import jsonschema
import pytest

from daemon.publish.messages import decode_verdict, schema
from drivers.recordings.csv_player import DEMO_RECORDING, DEMO_TABLE
from tests.clients.building import sleep_at_will
from tests.daemon.processes import GRASPD, SUBSCRIBER, TIMEOUT_S, graspd, start, wait_for


def demo_rows() -> list[dict[str, str]]:
    with DEMO_TABLE.open(newline="") as file:
        return list(csv.DictReader(file))


def test_replay_without_arguments_judges_each_grasp_of_the_demo_recording_once() -> None:
    people, program = graspd("replay"), graspd("replay", "--json")
    assert people.returncode == program.returncode == 0, people.stderr
    verdicts = [decode_verdict(line.encode()) for line in program.stdout.splitlines()]
    with DEMO_RECORDING.open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert len(verdicts) == len(rows)
    first = {v.grasp: v for v in reversed(verdicts) if v.judged}
    assert sorted(first) == list(range(1, 13))
    assert all(v.gate == "judged" for v in verdicts if v.valid)
    summary = json.loads(program.stderr)
    assert summary["gated"]["grasps"] == 12
    assert summary["labelled"] == 12
    assert sum(summary["verdicts"].values()) == 12
    lines = people.stdout.splitlines()
    assert "12 grasps, 12 judged" in lines[lines.index("") + 1]
    assert any("  judged   " in line and "p_slip" in line for line in lines)


def test_replay_says_so_when_streams_and_tables_are_mixed() -> None:
    result = graspd("replay", DEMO_TABLE, DEMO_RECORDING)
    assert result.returncode == 2
    assert "both grasp tables and streams" in result.stderr
    assert graspd("replay", DEMO_RECORDING, "--gate", "every", "--json").returncode == 0


def test_a_grasp_table_is_judged_row_by_row() -> None:
    result = graspd("replay", DEMO_TABLE)
    assert result.returncode == 0, result.stderr
    lines = result.stdout.splitlines()
    blank = lines.index("")
    verdicts, summary = lines[:blank], lines[blank + 1 :]
    assert len(verdicts) == len(demo_rows())
    assert summary[0].startswith(f"{len(verdicts)} verdicts in ")
    assert any("recorded outcomes (slip positive): accuracy" in line for line in summary)
    assert any(line.startswith("without session calibration: ") for line in summary)
    assert summary[-1].startswith("reading to verdict: p50 ")
    assert all("synthetic" in line for line in verdicts)


def test_replay_json_gives_one_valid_verdict_per_real_grasp(bts3_dir: Path) -> None:
    result = graspd("replay", bts3_dir / "palm_down.csv", "--json", "--model", "cnn1")
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
    header, *rows = DEMO_TABLE.read_text().splitlines(keepends=True)
    short, long = tmp_path / "short.csv", tmp_path / "long.csv"
    short.write_text(header + "".join(rows))
    long.write_text(header + "".join(rows) * 50)  # 10,000 grasps, 3.7 MB
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


def test_a_replay_in_which_the_computer_sleeps_goes_on_to_its_end(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    slept = sleep_at_will(tmp_path, monkeypatch)
    with start("replay", "--speed", 2, "--json", DEMO_TABLE) as process:
        assert process.stdout is not None
        first = process.stdout.readline()
        slept.touch()
        rest, _ = process.communicate(timeout=TIMEOUT_S)
    assert process.returncode == 0
    assert len([first, *rest.splitlines()]) == len(demo_rows())


def replace_cell(text: str) -> str:
    header, first, *rest = DEMO_TABLE.read_text().splitlines()
    cells = first.split(",")
    cells[2] = text
    return "\n".join([header, ",".join(cells), *rest]) + "\n"


@pytest.mark.parametrize(
    "text", ["nan", "-1", "4096", "1e9", "text", "", "2602.5", "inf", "0x10", "1_000"]
)
def test_a_value_that_is_no_count_is_repaired_and_said(tmp_path: Path, text: str) -> None:
    recording = tmp_path / "grasps.csv"
    recording.write_text(replace_cell(text))
    result = graspd("replay", recording, "--json")
    assert result.returncode == 0, result.stderr
    first, second, *_ = (json.loads(line) for line in result.stdout.splitlines())
    assert (first["valid"], first["repaired"]) == (True, ["ff_1"])
    assert "ff_1" not in second["repaired"]
    strict = graspd("replay", recording, "--strict", "--json")
    assert strict.returncode == 2
    assert f"{recording}, line 2, column ff_biotac_1: " in strict.stderr.splitlines()[-1]


def bad_recordings() -> dict[str, tuple[bytes | None, str]]:
    content = DEMO_TABLE.read_bytes()
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
    ("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)], ids=["INT", "TERM"]
)
def test_a_signal_ends_the_waiting_for_a_subscriber(
    tmp_path: Path, number: signal.Signals, code: int
) -> None:
    publish = ["--publish", f"ipc://{tmp_path}/graspd", "--wait", 3600]
    with start("replay", "--json", *publish) as process:
        wait_for(tmp_path / "graspd")
        start_s = time.monotonic()
        process.send_signal(number)
        output, errors = process.communicate(timeout=TIMEOUT_S)
    assert process.returncode == code
    assert time.monotonic() - start_s < 10
    assert output == ""
    assert json.loads(errors)["verdicts"] == {"stable": 0, "slip": 0, "unknown": 0}
    assert list(tmp_path.iterdir()) == []


def test_a_file_at_the_place_of_the_socket_is_not_touched(tmp_path: Path) -> None:
    (tmp_path / "notes").write_text("kept")
    result = graspd("replay", "--publish", f"ipc://{tmp_path}/notes")
    assert result.returncode == 1
    says = f"cannot publish on ipc://{tmp_path}/notes: {tmp_path}/notes is there and is no socket"
    assert result.stderr == f"graspd: {says}\n"
    assert (tmp_path / "notes").read_text() == "kept"
    assert [path.name for path in tmp_path.iterdir()] == ["notes"]
