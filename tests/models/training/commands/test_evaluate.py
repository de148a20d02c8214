"""`graspd evaluate` from its arguments to its files."""

from __future__ import annotations

import dataclasses
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pandas as pd
import pytest

pytest.importorskip("torch", reason="needs the extra `train`")

from graspd.daemon.process.streams import guarded
from graspd.models.training.commands.common import exit_code
from graspd.models.training.evaluating import frame
from tests.kit.inside import graspd, refused
from tests.kit.tables import write_table
from tests.models.training.samples import (
    OBJECTS,
    separable_counts,
    table,
    write,
    write_sessions,
)

ROOT = Path(__file__).parents[4]


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("data")
    write_sessions(folder, 160)
    return folder


def kept(out: Path) -> int:
    """Number of trainings that are kept in a folder for results."""
    return len(list((out / "jobs").rglob("output.pkl")))


def test_an_own_table_alone_is_evaluated_and_its_results_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    own, out = tmp_path / "monday.csv", tmp_path / "out"
    objects = tuple(OBJECTS[grasp % 4] for grasp in range(80))
    write(own, dataclasses.replace(table("monday", 80, 0), objects=objects))
    words = "evaluate", "svm-session", "--own", own, "--out", out, "--seeds", "2", "--json"
    done = graspd(*words)
    assert done.stderr == (
        "graspd evaluate: takes 4 folds: 10 folds need 10 objects, there are 4\n"
    )
    figures = json.loads(done.stdout)
    assert [(one["protocol"], one["seed"], one["fold"]) for one in figures] == [
        (protocol, seed, fold)
        for protocol in ("cv", "objects")
        for seed in range(2)
        for fold in range(4)
    ]
    assert {one["system"] for one in figures} == {"svm-session"}
    assert all(0.5 < one["f1"] <= 1.0 for one in figures if one["protocol"] == "cv")
    assert kept(out) == 2 * 2 * 4
    monkeypatch.setattr(frame, "judged", None)
    assert json.loads(graspd(*words).stdout) == figures


def test_fridays_grasps_are_judged_by_mondays_model(tmp_path: Path) -> None:
    monday, friday = tmp_path / "monday.csv", tmp_path / "friday.csv"
    write(monday, table("monday", 80, 0))
    write(friday, table("friday", 60, 1))
    options = "--train", monday, "--test", friday
    done = graspd("evaluate", "svm-session", *options)
    assert done.stderr == ""
    assert done.stdout.startswith("friday by svm-session of monday: ")
    (figures,) = json.loads(graspd("evaluate", "svm-session", *options, "--json").stdout)
    # The grasps are separable, and a tenth of the labels is wrong.
    assert figures["f1"] > 0.8
    assert (figures["all"], figures["trained_on"]) == (60, 0)


def test_judging_copied_training_grasps_prints_a_warning(tmp_path: Path) -> None:
    monday, copy, out = tmp_path / "monday.csv", tmp_path / "copy.csv", tmp_path / "out"
    write(monday, table("monday", 80, 0))
    lines = monday.read_text().splitlines(keepends=True)
    write(copy, table("copy", 40, 1))
    with copy.open("a") as file:
        file.writelines(lines[1:13])
    trained = graspd(
        "train", "svm", "--own", monday, "--only", "cv", "--folds", "2", "--name", "m", "--out", out
    )
    assert trained.returncode == 0
    for words, name in (
        (("--model", out / "m.onnx"), "m"),
        (("svm", "--train", monday), "svm of monday"),
    ):
        done = graspd("evaluate", *words, "--test", copy)
        assert done.stderr == (
            f"graspd evaluate: warning: {name} was trained on 12 of 52 grasps of copy: "
            "it judges others worse\n"
        )
        assert done.stdout.startswith(f"copy by {name}: ")


def test_a_quick_run_writes_verdicts_and_results_table(data: Path, tmp_path: Path) -> None:
    out, table = tmp_path / "out", tmp_path / "tables" / "RESULTS.md"
    options = "--data", data, "--out", out, "--table", table, "--quick"
    done = graspd("evaluate", "svm-session", *options)
    assert done.returncode == 0
    protocols = ("cv", "unknown", "objects", "objects-whole", "session", "days")
    rows = pd.read_parquet(out / "verdicts")
    assert set(rows["protocol"]) == set(protocols)
    # Unknown has one split, days have two of each of four.
    assert kept(out) == 4 * 2 + 1 + 8
    text = table.read_text()
    assert "graspd evaluate svm-session --data DIR --out DIR --quick --table FILE" in text
    assert "mean nothing" in text
    assert str(tmp_path) not in text
    assert [line.split()[:2] for line in done.stdout.splitlines()] == [
        ["svm-session", protocol] for protocol in protocols
    ]
    assert "svm-session session (n50): F1 " in done.stdout
    assert "palm_45.csv is not the published table" in done.stderr
    assert "graspd evaluate: 17 trainings, 1 at once: about 2 s of processor time" in done.stderr


def test_the_list_as_json_has_the_tables_cells() -> None:
    head, _, *rows = graspd("evaluate", "--list").stdout.splitlines()
    titles = head.strip("| ").split(" | ")
    cells = [dict(zip(titles, row.strip("| ").split(" | "), strict=True)) for row in rows]
    assert json.loads(graspd("evaluate", "--list", "--json").stdout) == cells


def test_wrong_input_is_one_line_and_exit_code_2(data: Path, tmp_path: Path) -> None:
    own = tmp_path / "own.csv"
    write(own, table("own", 20, 0))
    for words, message in (
        (["svn", "--data", data], "no system 'svn': there are cnn0, "),
        (["svm", "--data", "nowhere"], "nowhere: no such folder"),
        (["svm"], "needs --data DIR, --own FILE, or both"),
        (["svm", "--train", own, "--test", own, "--own", own], "--own does not go with"),
        (["--train", own, "--test", own, "--model", "svm"], "--train and --model exclude"),
        (["--train", own], "--test needs --train or --model, and each of these needs"),
        (["svm", "--model", "svm", "--test", own], "svm goes with --train: --model is trained"),
        (["--train", own, "--test", own], "--out does not go with --test"),
        (["--train", own, "--test", own, "--jobs", "1"], "--jobs does not go with --test"),
        (["svm", "--data", data, "--as", "table"], "--as is for tables of --own: there is none"),
        (["svm", "--data", data, "--dask", "tcp://a:1", "--jobs", "2"], "--jobs is of this"),
    ):
        done = graspd("evaluate", "--out", tmp_path / "out", *words)
        assert done.returncode == 2
        assert done.stderr.startswith(f"graspd evaluate: {message}")
        assert done.stderr.count("\n") == 1
        assert done.stdout == ""
    assert not (tmp_path / "out").exists()


def test_a_table_of_one_object_beside_published_ones_is_refused(data: Path, tmp_path: Path) -> None:
    own, out = tmp_path / "own.csv", tmp_path / "out"
    write_table(own, *separable_counts(40, 9))
    words = "--data", data, "--own", own, "--protocol", "objects", "--seeds", "1", "--out", out
    said = refused("evaluate", "svm-session", *words).splitlines()[-1]
    assert "leaves out all objects of own, by whose other grasps a session model" in said
    assert not out.exists()


def test_a_full_standard_output_is_not_blamed_on_the_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    def prints() -> int:
        return sys.stdout.write("." * 10_000)

    with Path("/dev/full").open("w") as full:
        monkeypatch.setattr(sys, "stdout", full)
        assert guarded(lambda: exit_code("evaluate", tmp_path, prints)) == 1
    said = capfd.readouterr().err
    assert said == "graspd: cannot write to standard output: No space left on device\n"


def test_an_unreachable_dask_scheduler_is_exit_code_2(
    data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    distributed = pytest.importorskip("distributed", reason="needs the extra `cluster`")

    def no_answer(*_: object, **__: object) -> None:
        raise OSError("Timed out")  # a real client would leave a thread running

    monkeypatch.setattr(distributed, "Client", no_answer)
    options = "--data", data, "--out", tmp_path, "--dask", "tcp://127.0.0.1:9"
    done = graspd("evaluate", "svm", "--quick", *options)
    assert done.returncode == 2
    assert "graspd evaluate: no Dask scheduler at tcp://127.0.0.1:9" in done.stderr
    monkeypatch.setitem(sys.modules, "distributed", None)
    assert "-m pip install '.[cluster]'" in graspd("evaluate", "svm", *options).stderr


def test_ctrl_c_ends_processes_and_keeps_finished_trainings(data: Path, tmp_path: Path) -> None:
    command = [sys.executable, "-m", "graspd", "evaluate", "mlp", "--protocol", "cv"]
    options = ["--data", str(data), "--out", str(tmp_path), "--jobs", "2", "--seeds", "30"]
    process = subprocess.Popen(
        [*command, *options],
        cwd=ROOT,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
        env=os.environ | {"OMP_NUM_THREADS": "1"},
    )
    try:
        # Each process imports torch first: minutes on a busy computer.
        deadline_s = time.monotonic() + 600.0
        while kept(tmp_path) < 2:
            assert time.monotonic() < deadline_s
            time.sleep(0.02)
        os.killpg(process.pid, signal.SIGINT)  # as a terminal does: to the workers, too
        _, errors = process.communicate(timeout=200.0)
    finally:
        process.kill()
        process.wait()
    assert process.returncode == 130
    lines = [line for line in errors.splitlines() if "published" not in line]
    # A thread of joblib that was about to hand out a job may complain before.
    assert lines[-1] == "graspd evaluate: interrupted; the same command continues from here"
    assert 2 <= kept(tmp_path) < 300
