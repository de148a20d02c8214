"""`graspd replay` as a user runs it: real processes, real files, real sockets."""

from __future__ import annotations

import csv
import json
import re
import signal
import subprocess
import sys
from functools import cache
from itertools import pairwise
from operator import and_
from pathlib import Path
from typing import Any

import jsonschema
import pytest

from graspd.daemon.publish.messages import schema
from graspd.drivers.recordings.csv_player import DEMO_DAY, DEMO_RECORDING, DEMO_TABLE
from graspd.drivers.recordings.csv_rows import read_rows
from graspd.models import zoo
from graspd.models.runtime import TactileModel
from tests.clients.building import sleep_at_will
from tests.daemon.processes import SUBSCRIBER, TIMEOUT_S, start, wait_for
from tests.kit import inside
from tests.kit.messages import decode_verdict

graspd = cache(inside.graspd)
"""Run a command; the same command on the same files runs once."""
DEMO_LINE = re.compile(
    r"(?P<grasps>\S+) +(?P<stable>\d+) +(?P<slips>\d+) +(?:\d+ %|-) +\d+ %"
    r" +(?P<own_stable>\d+) +(?P<own_slips>\d+) +(?:\d+ %|-) +(?P<kept>\d+) %"
)


def test_the_demo_compares_graspd_with_the_published_network_under_drift() -> None:
    demo, program = graspd("replay"), graspd("replay", "--json")
    assert demo.returncode == program.returncode == 0, demo.stderr
    text = demo.stdout
    lines = [match.groupdict() for match in map(DEMO_LINE.fullmatch, text.splitlines()) if match]
    *blocks, whole = lines
    for name in ("stable", "slips", "own_stable", "own_slips"):
        assert sum(int(block[name]) for block in blocks) == int(whole[name])
    # The day begins as the training was, and ends where the published method is a coin.
    assert int(blocks[0]["slips"]) <= 0.15 * int(blocks[0]["stable"])
    assert all(int(block["slips"]) >= 0.4 * int(block["stable"]) for block in blocks[-5:])
    # The bound of the rule, 0.05 N + 5, and nothing bought by silence.
    stable, slips = int(whole["own_stable"]), int(whole["own_slips"])
    assert slips <= 0.05 * stable + 5.0
    assert max(int(block["kept"]) for block in blocks) > 50
    # The verdicts are those that programs get.
    verdicts = [decode_verdict(line.encode()) for line in program.stdout.splitlines()]
    with DEMO_DAY.open(newline="") as file:
        slipped = [row["slipped"] == "1" for row in csv.DictReader(file)]
    said = [verdict.verdict == "stable" for verdict in verdicts]
    assert (stable, slips) == (sum(said), sum(map(and_, said, slipped)))
    # The three figures, counted here from the messages and the table.
    held = slipped.count(False)
    unknown = sum(verdict.verdict == "unknown" for verdict in verdicts)
    assert f"`stable` that slipped  {slips} of {stable} (" in text
    assert f"good lifts kept        {stable - slips} of {held} (" in text
    assert f"unknown, grasp again   {unknown} of 300, published 0" in text


def test_the_demos_published_method_is_the_network_cnn1_alone() -> None:
    model, rows = TactileModel(zoo.find("cnn1")), list(read_rows(DEMO_DAY, ("ff", "mf", "th")))
    stable = []
    for row in rows:
        model.inputs.build(row.counts, model.input)
        stable.append(model.run()[1] < 0.5)
    slips = sum(
        said and bool(row.annotation.slipped) for said, row in zip(stable, rows, strict=True)
    )
    (whole,) = [
        match for line in graspd("replay").stdout.splitlines()
        if (match := DEMO_LINE.fullmatch(line)) and match["grasps"] == "all"
    ]  # fmt: skip
    assert (int(whole["stable"]), int(whole["slips"])) == (sum(stable), slips)


def summary_of(*arguments: object) -> dict[str, Any]:
    result = graspd("replay", *arguments, "--json")
    assert result.returncode == 0, result.stderr
    summary: dict[str, Any] = json.loads(result.stderr.splitlines()[-1])
    return summary


def test_outcomes_reported_in_a_replay_improve_the_verdicts() -> None:
    told, silent = summary_of(DEMO_DAY, "--outcomes"), summary_of(DEMO_DAY)
    assert silent["outcomes"] == 0
    assert told["outcomes"] == 300 - told["reasons"].get("never-seen", 0)
    assert told["scores"]["f1"] > silent["scores"]["f1"] + 0.1
    assert told["stable"]["slips_among_stable"] < 0.6 * silent["stable"]["slips_among_stable"]


def test_a_replay_prints_each_verdict_before_learning_its_outcome() -> None:
    result = graspd("replay", DEMO_DAY, "--outcomes", "--json")
    outcomes = [json.loads(line)["outcomes"] for line in result.stdout.splitlines()]
    assert outcomes[:2] == [0, 1]
    assert {later - former for former, later in pairwise(outcomes)} == {0, 1}  # 0: never seen


def test_a_replayed_table_keeps_the_risk_limit_and_reports_it() -> None:
    risk = ("--outcomes", "--max-slip-when-stable", "0.05")
    every, lifted = summary_of(DEMO_DAY, *risk), summary_of(DEMO_DAY, *risk, "--only-lifted")
    silent = summary_of(DEMO_DAY)
    for summary in (every, lifted):
        report = summary["risk"]
        assert report["target"] == 0.05
        assert report["lifts"] == summary["verdicts"]["stable"] > 0
        assert report["slips"] <= report["bound"]
        assert report["bound"] == pytest.approx(0.05 * report["lifts"] + 5.0, abs=0.005)
        assert report["slips"] / report["lifts"] == summary["stable"]["slips_among_stable"]
        assert summary["reasons"]["unproven"] > 0
        assert silent["verdicts"]["stable"] > summary["verdicts"]["stable"]
    # Supervised are the warm-up, some of the rest, and what is stable: not every lift.
    assert lifted["outcomes"] < 0.7 * every["outcomes"]
    bare = summary_of(DEMO_DAY, *risk, "--only-lifted", "--warm-up", "0", "--explore", "0")
    assert bare["outcomes"] == bare["verdicts"]["stable"] < lifted["outcomes"]
    assert bare["reasons"].get("unproven") is None


def test_a_too_long_recording_name_is_refused_with_code_2() -> None:
    refused = graspd("replay", "a" * 300)
    assert (refused.returncode, refused.stderr[-21:]) == (2, ": file name too long\n")


def test_option_outcomes_refuses_a_stream_with_an_unreadable_outcome(tmp_path: Path) -> None:
    header, row, *_ = DEMO_RECORDING.read_text().splitlines()
    place = header.split(",").index("slipped")
    cells = row.split(",")
    cells[place] = "dropped"
    path = tmp_path / "stream.csv"
    path.write_text(f"{header}\n{','.join(cells)}\n")
    refused = graspd("replay", path, "--outcomes")
    assert refused.returncode == 2
    assert "line 2, column slipped: 'dropped' is not an outcome" in refused.stderr


def test_a_streams_outcome_is_reported_once_after_its_grasp() -> None:
    result = graspd("replay", DEMO_RECORDING, "--outcomes", "--json")
    verdicts = [decode_verdict(line.encode()) for line in result.stdout.splitlines()]
    summary = json.loads(result.stderr)
    judged = {verdict.grasp for verdict in verdicts if verdict.valid}
    assert summary["outcomes"] == len(judged)
    # While a grasp is held nothing more is known, however often it is judged.
    for grasp in judged:
        assert len({v.outcomes for v in verdicts if v.grasp == grasp and v.judged}) == 1


def test_a_renamed_part_of_a_training_table_is_recognised(bts3_dir: Path, tmp_path: Path) -> None:
    table = tmp_path / "friday.csv"
    lines = (bts3_dir / "palm_45.csv").read_text().splitlines(keepends=True)
    table.write_text("".join([lines[0], *lines[-40:]]))
    warning = "the model was trained on 40 of 40 grasps of friday.csv"
    assert graspd("replay", table).stdout.splitlines()[1].startswith(warning)
    verbose = graspd("replay", table, "--verbose").stdout
    assert verbose.index(warning) < verbose.index("40 verdicts in")
    assert summary_of(table)["trained_on"] == ["friday.csv"]
    (other := tmp_path / "b" / table.name).parent.mkdir()
    other.write_text("".join(lines[:10]))
    both = f"{warning}, 9 of 9 grasps of friday.csv"
    assert graspd("replay", table, other).stdout.splitlines()[1].startswith(both)
    assert summary_of(DEMO_TABLE)["trained_on"] == []


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


@pytest.mark.parametrize(
    ("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)], ids=["INT", "TERM"]
)
def test_a_signal_ends_a_replay_with_its_summary(
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


def test_a_replay_outlasts_a_sleep_of_the_computer(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    slept = sleep_at_will(tmp_path, monkeypatch)
    with start("replay", "--speed", 2, "--json", DEMO_TABLE) as process:
        assert process.stdout is not None
        lines = [process.stdout.readline()]
        slept.touch()
        lines += process.stdout
        assert process.wait(TIMEOUT_S) == 0
    grasps = {json.loads(line)["grasp"] for line in lines}
    assert grasps == set(range(1, DEMO_TABLE.read_text().count("\n")))


def test_a_malformed_count_is_repaired_and_strict_refuses_it(tmp_path: Path) -> None:
    recording = tmp_path / "grasps.csv"
    header, first, *rest = DEMO_TABLE.read_text().splitlines()
    label, number, _, *cells = first.split(",")
    recording.write_text("\n".join([header, ",".join((label, number, "4096", *cells)), *rest, ""]))
    told = json.loads(graspd("replay", recording, "--json").stdout.partition("\n")[0])
    assert (told["valid"], told["repaired"]) == (True, ["ff_1"])
    strict = graspd("replay", recording, "--strict", "--json")
    assert strict.returncode == 2
    assert f"{recording}, line 2, column ff_biotac_1: " in strict.stderr.splitlines()[-1]
