"""`graspd train` from its arguments to its files."""

from __future__ import annotations

import argparse
import hashlib
import json
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("torch", reason="the train extra is not installed")
pytest.importorskip("rich", reason="the train extra is not installed")

from models.contract import SessionInput
from models.runtime import TactileModel
from models.training import command, jobs
from models.training.datasets import Grasps
from models.training.export import ExportError
from tests.models.evaluation_samples import OBJECTS, write_sessions

SYSTEM = "svm-session"
GRASPS = 80
"""Of each of the three tables."""


def graspd_train(*arguments: str, system: str = SYSTEM) -> int:
    parser = argparse.ArgumentParser()
    command.add_arguments(parser)
    return command.run(parser.parse_args([system, *arguments]))


@pytest.fixture
def data(tmp_path: Path) -> Path:
    folder = tmp_path / "data"
    write_sessions(folder, GRASPS)
    return folder


def test_a_session_model_comes_with_all_that_the_daemon_and_its_user_need(
    data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out" / SYSTEM
    options = ["--data", str(data), "--out", str(out), "--folds", "2", "--seed", "3"]
    assert graspd_train(*options) == 0
    files = sorted(path.name for path in out.iterdir())
    assert files == [f"{SYSTEM}.json", f"{SYSTEM}.onnx", "trainings"]
    model = TactileModel(out / f"{SYSTEM}.onnx")
    card = json.loads((out / f"{SYSTEM}.json").read_text())
    assert card["contract"] == json.loads(model.contract.to_json())
    assert card["file"]["sha256"] == model.sha256
    assert card["command"] == f"graspd train {SYSTEM} --data DIR --seed 3 --folds 2"
    assert card["file"]["parity"]["grasps"] == 2 * GRASPS
    assert card["same_seed_same_margins"] is True
    assert list(card["protocols"]) == ["cv", "objects-whole", "session"]
    assert [m["protocol"] for m in card["contract"]["measured"]] == list(card["protocols"])
    assert [file["rows"] for file in card["contract"]["datasets"]] == [GRASPS, GRASPS]
    digest = hashlib.sha256((data / "palm_side.csv").read_bytes()).hexdigest()
    assert card["contract"]["datasets"][1]["sha256"] == digest
    assert card["data"]["not_published"] == ["palm_down", "palm_side", "palm_45"]
    assert set(card["protocols"]["objects-whole"]["objects"]) == set(OBJECTS)
    assert "running" in card["protocols"]["session"]["calibrated_by"]
    printed = capsys.readouterr()
    assert printed.out.startswith(f"{out / SYSTEM}.onnx: cv F1 ")
    assert printed.out.count("\n") == 1
    assert printed.err.splitlines() == [
        f"graspd train: warning: {name}.csv is not the published table; "
        "the figures are of this data only"
        for name in ("palm_down", "palm_side", "palm_45")
    ]


def test_the_contract_holds_the_statistics_that_the_session_starts_from(
    data: Path, tmp_path: Path
) -> None:
    options = ["--data", str(data), "--out", str(tmp_path), "--folds", "2", "--quiet"]
    assert graspd_train(*options) == 0
    session = TactileModel(tmp_path / f"{SYSTEM}.onnx").contract.input
    assert isinstance(session, SessionInput)
    tables = [
        np.loadtxt(data / f"{name}.csv", delimiter=",", skiprows=1, usecols=range(2, 74))
        for name in ("palm_down", "palm_side")
    ]
    means = [table.reshape(-1, 3, 24).mean(axis=2) for table in tables]
    # Feature 72 is the mean of the first finger.
    assert session.mean[72] == pytest.approx(np.concatenate(means)[:, 0].mean())
    within = np.mean([mean[:, 0].var() for mean in means])
    assert session.spread[72] == pytest.approx(np.sqrt(within))
    assert session.sharpness[0].grasps == 0.0
    sharpness = [step.temperature for step in session.sharpness]
    assert sharpness == sorted(sharpness, reverse=True)
    assert sharpness[-1] >= 1.0


def test_an_interrupted_training_goes_on_where_it_was(
    data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    options = ["--data", str(data), "--out", str(tmp_path / "out"), "--folds", "2", "--quiet"]
    ran: list[jobs.Job] = []
    run = jobs.run

    def counted(job: jobs.Job, grasps: Grasps) -> jobs.JobResult:
        if len(ran) == 4:
            raise KeyboardInterrupt
        ran.append(job)
        return run(job, grasps)

    monkeypatch.setattr(jobs, "run", counted)
    assert graspd_train(*options) == 130
    assert not (tmp_path / "out" / f"{SYSTEM}.onnx").exists()
    done, ran[:] = len(ran), []
    assert done == 4
    assert graspd_train(*options) == 0
    # Six folds in all, less the four that are kept, and one again to see that it is the same.
    assert len(ran) == 6 - 4 + 1


def test_the_same_seed_makes_the_same_file(data: Path, tmp_path: Path) -> None:
    for out in ("one", "two"):
        options = ["--data", str(data), "--out", str(tmp_path / out), "--folds", "2", "--quiet"]
        assert graspd_train(*options, system="svm") == 0
    for name in ("svm.onnx", "svm.json"):
        assert (tmp_path / "one" / name).read_bytes() == (tmp_path / "two" / name).read_bytes()


def test_a_model_of_the_later_session_needs_its_table(
    data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (data / "palm_45.csv").unlink()
    options = ["--data", str(data), "--out", str(tmp_path / "out")]
    assert graspd_train(*options, system="small-session") == 2
    missing = data / "palm_45.csv"
    assert capsys.readouterr().err == (
        f"graspd train: {missing}: is missing, small-session needs it\n"
    )


def test_bad_data_is_one_line_and_exit_code_2(
    data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = data / "palm_side.csv"
    path.write_text(path.read_text().replace("juice,1", "juice,maybe", 1))
    assert graspd_train("--data", str(data), "--out", str(tmp_path / "out")) == 2
    printed = capsys.readouterr()
    assert printed.err == f"graspd train: {path}, line 3, column slipped: 'maybe' is not 0 or 1\n"
    assert printed.out == ""
    assert not (tmp_path / "out").exists()


def test_too_few_grasps_for_the_folds_are_exit_code_2(
    data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    options = ["--data", str(data), "--out", str(tmp_path / "out"), "--folds", "25"]
    assert graspd_train(*options) == 2
    last = capsys.readouterr().err.splitlines()[-1]
    assert last == "graspd train: 25 folds need 25 objects, there are 20"


def test_an_output_folder_that_is_a_file_is_exit_code_2(
    data: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = data / "palm_45.csv"
    assert graspd_train("--data", str(data), "--out", str(out)) == 2
    assert capsys.readouterr().err.splitlines()[-1] == f"graspd train: {out}: File exists"


@pytest.mark.parametrize(
    ("option", "value"),
    [("--folds", "1"), ("--jobs", "0"), ("--seed", "-1"), ("--seed", "1e3"), ("--folds", "")],
)
def test_a_number_out_of_range_is_exit_code_2(
    option: str, value: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as caught:
        graspd_train("--data", "anywhere", f"{option}={value}")
    assert caught.value.code == 2
    assert f"argument {option}: '{value}' is not a whole number from" in capsys.readouterr().err


def test_ctrl_c_ends_cleanly_with_130(
    data: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    def interrupted(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(command, "make", interrupted)
    assert graspd_train("--data", str(data), "--out", str(tmp_path / "out")) == 130
    assert capsys.readouterr().err.splitlines()[-1] == (
        "graspd train: interrupted; the same command goes on from here"
    )


def test_a_failed_export_is_exit_code_1(
    data: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    def failing(*_: object) -> None:
        raise ExportError("the exported file differs")

    monkeypatch.setattr(command, "make", failing)
    assert graspd_train("--data", str(data), "--out", str(tmp_path / "out")) == 1
    assert capsys.readouterr().err.splitlines()[-1] == "graspd train: the exported file differs"
