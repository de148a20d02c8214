"""`graspd train` from its arguments to its files."""

from __future__ import annotations

import argparse
import hashlib
import json
from pathlib import Path

import pytest

pytest.importorskip("torch", reason="the train extra is not installed")
pytest.importorskip("rich", reason="the train extra is not installed")

from models.runtime import TactileModel
from models.training import command
from models.training.export import ExportError
from tests.models.training_samples import separable_counts, write_table


def graspd_train(*arguments: str) -> int:
    parser = argparse.ArgumentParser()
    command.add_arguments(parser)
    return command.run(parser.parse_args(["cnn1", *arguments]))


@pytest.fixture
def data(tmp_path: Path) -> Path:
    folder = tmp_path / "data"
    folder.mkdir()
    for seed, name in enumerate(("palm_down", "palm_side", "palm_45")):
        write_table(folder / f"{name}.csv", *separable_counts(24, seed))
    return folder


def test_a_short_training_makes_a_model_that_the_daemon_loads(
    data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out" / "cnn1"
    options = ["--data", str(data), "--out", str(out), "--folds", "2", "--epochs", "1"]
    assert graspd_train(*options, "--seed", "3") == 0
    assert sorted(path.name for path in out.iterdir()) == ["cnn1.json", "cnn1.onnx"]
    model = TactileModel(out / "cnn1.onnx")
    card = json.loads((out / "cnn1.json").read_text())
    assert card["contract"] == json.loads(model.contract.to_json())
    assert card["file"]["sha256"] == model.sha256
    assert card["command"] == "graspd train cnn1 --data DIR --seed 3 --folds 2 --epochs 1"
    assert card["file"]["parity"]["grasps"] == 48
    assert card["new_session"]["scores"]["grasps"] == 24
    assert len(card["cross_validation"]["folds"]) == 2
    assert [file["rows"] for file in card["contract"]["datasets"]] == [24, 24]
    digest = hashlib.sha256((data / "palm_side.csv").read_bytes()).hexdigest()
    assert card["contract"]["datasets"][1]["sha256"] == digest
    assert card["data"]["not_published"] == ["palm_down", "palm_side"]
    printed = capsys.readouterr()
    assert printed.out.startswith(f"{out / 'cnn1.onnx'}: F1 ")
    assert printed.out.count("\n") == 1
    assert printed.err.splitlines() == [
        f"graspd train: warning: {name}.csv is not the published table; "
        "the figures are of this data only"
        for name in ("palm_down", "palm_side", "palm_45")
    ]


def test_bad_data_is_one_line_and_exit_code_2(
    data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = data / "palm_side.csv"
    path.write_text(path.read_text().replace("ball,1", "ball,maybe", 1))
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
    assert last == "graspd train: 25 folds need 25 grasps of each class, one has 24"


def test_an_output_folder_that_is_a_file_is_exit_code_2(
    data: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = data / "palm_45.csv"
    assert graspd_train("--data", str(data), "--out", str(out)) == 2
    assert capsys.readouterr().err.splitlines()[-1] == f"graspd train: {out}: File exists"


@pytest.mark.parametrize(
    ("option", "value"),
    [("--folds", "1"), ("--epochs", "0"), ("--seed", "-1"), ("--seed", "1e3"), ("--folds", "")],
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
    assert capsys.readouterr().err.splitlines()[-1] == "graspd train: interrupted"


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
