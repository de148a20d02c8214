"""`graspd train` from its arguments to its files."""

from __future__ import annotations

import dataclasses
import gzip
import hashlib
import io
import json
import re
from pathlib import Path
from subprocess import CompletedProcess

import pytest

pytest.importorskip("torch", reason="needs the extra `train`")

from graspd.models.contract import Dataset, SessionInput
from graspd.models.runtime import TactileModel
from graspd.models.training.data.datasets import Grasps
from graspd.models.training.making import make_model
from graspd.models.training.making.export import ExportError
from graspd.models.training.making.plan import TrainingPlan
from graspd.models.training.systems.registry import SYSTEMS
from tests.kit.inside import graspd
from tests.kit.tables import write_table
from tests.models.training.samples import (
    OBJECTS,
    separable_counts,
    table,
    write,
    write_sessions,
)

SYSTEM = "svm-session"
GRASPS = 80
"""Number of grasps of each of the three tables."""


def train(*arguments: object, system: str = SYSTEM) -> CompletedProcess[str]:
    return graspd("train", system, *arguments)


def last_error(done: CompletedProcess[str]) -> str:
    """Return the last line of standard error of a command that has ended with exit code 2."""
    assert done.returncode == 2
    return done.stderr.splitlines()[-1]


def smallest() -> Grasps:
    """Return 20 grasps of two objects, ten of each, of which five slipped."""
    counts, slipped = separable_counts(20)
    objects = tuple("ball" if grasp < 10 else "box" for grasp in range(20))
    return Grasps(counts, slipped, objects, (Dataset("lab", "", 20),))


@pytest.fixture
def data(tmp_path: Path) -> Path:
    folder = tmp_path / "data"
    write_sessions(folder, GRASPS)
    return folder


def test_a_session_model_comes_with_its_card(data: Path, tmp_path: Path) -> None:
    out = tmp_path / "out" / SYSTEM
    done = train("--data", data, "--out", out, "--folds", "2", "--seed", "3")
    assert done.returncode == 0
    files = sorted(path.name for path in out.iterdir())
    assert files == [f"{SYSTEM}.json", f"{SYSTEM}.onnx", "trainings"]
    model = TactileModel(out / f"{SYSTEM}.onnx")
    card = json.loads((out / f"{SYSTEM}.json").read_text())
    assert card["contract"] == json.loads(model.contract.to_json())
    assert card["file"]["sha256"] == model.sha256
    assert card["command"] == f"graspd train {SYSTEM} --data DIR --seed 3 --folds 2"
    assert card["file"]["parity"]["grasps"] == 2 * GRASPS
    assert card["same_seed_same_margins"] is True
    assert list(card["protocols"]) == ["cv", "objects-whole", "session", "days"]
    assert [m["protocol"] for m in card["contract"]["measured"]] == list(card["protocols"])
    digest = hashlib.sha256((data / "palm_side.csv").read_bytes()).hexdigest()
    assert card["contract"]["datasets"][1]["sha256"] == digest
    assert set(card["protocols"]["objects-whole"]["objects"]) == set(OBJECTS)
    assert "running" in card["protocols"]["session"]["calibrated_by"]
    days = card["protocols"]["days"]["days"]
    assert {"A palm_45", "B palm_side", "C palm_down", "A and C", "all"} < set(days)
    assert days["all"]["every"]["grasps"] == 5 * GRASPS
    assert done.stdout.startswith(f"{out / SYSTEM}.onnx: cv F1 ")
    assert done.stderr.count("is not the published table; the figures are of this data only") == 3
    session = model.contract.input
    assert isinstance(session, SessionInput)
    sharpness = [step.temperature for step in session.sharpness]
    assert sharpness == sorted(sharpness, reverse=True)
    assert sharpness[-1] >= 1.0


def test_an_own_table_is_used_beside_the_published(data: Path, tmp_path: Path) -> None:
    write(tmp_path / "lab 1.csv", table("lab 1", 60, 3))
    options = "--data", data, "--own", tmp_path / "lab 1.csv", "--folds", "2"
    done = train(*options, "--out", tmp_path / "out", system="svm")
    assert done.returncode == 0
    card = json.loads((tmp_path / "out" / "svm-lab-1.json").read_text())
    assert card["command"] == "graspd train svm --data DIR --own 'lab 1.csv' --seed 0 --folds 2"
    rows = [(file["name"], file["rows"]) for file in card["contract"]["datasets"]]
    assert rows == [("palm_down", GRASPS), ("palm_side", GRASPS), ("lab 1", 60)]
    # Of the 220 grasps of the objects that were left out, 50 are the fewest to tell an accuracy.
    coverages = [step["coverage"] for step in card["contract"]["confidence"]]
    assert coverages[0] == 1.0
    assert all(coverage >= 50 / 220 for coverage in coverages)
    judged = {name: set(figures["palms"]) for name, figures in card["protocols"].items()}
    assert judged == {
        "cv": {"palm_down", "palm_side", "lab 1"},
        "objects-whole": {"palm_down", "palm_side", "lab 1"},
        "session": {"palm_45"},
        "days": {"palm_down", "palm_side", "palm_45"},
    }
    assert "lab 1" in card["data"]["not_published"]
    assert "lab 1.csv is not" not in done.stderr


def test_the_smallest_own_table_makes_a_model(tmp_path: Path) -> None:
    write(tmp_path / "lab.csv", smallest())
    done = train("--own", tmp_path / "lab.csv", "--out", tmp_path)
    assert done.returncode == 0
    assert "graspd train: takes 2 folds: 10 folds need" in done.stderr
    contract = TactileModel(tmp_path / f"{SYSTEM}-lab.onnx").contract
    assert contract.name == f"{SYSTEM}-lab"
    assert [(file.name, file.rows) for file in contract.datasets] == [("lab", 20)]
    assert contract.confidence == ()  # 20 grasps say nothing of how sure one may be
    card = json.loads((tmp_path / f"{SYSTEM}-lab.json").read_text())
    assert list(card["protocols"]) == ["cv", "objects"]
    assert card["calibrated_by"] == "objects"
    assert card["broken"]["grasps"] > 0
    assert (card["data"]["repository"], card["data"]["cite"]) == (None, [])
    assert any("on another day" in point for point in card["weak_points"])
    assert "graspd train: warning: 20 grasps are few" in done.stderr


def test_packed_and_piped_tables_are_trained_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write(tmp_path / "friday.csv", table("lab", 60, 0))
    write(tmp_path / "monday.csv", table("lab", 40, 1))
    packed = tmp_path / "friday.csv.gz"
    packed.write_bytes(gzip.compress((tmp_path / "friday.csv").read_bytes()))
    piped = io.TextIOWrapper(io.BytesIO((tmp_path / "monday.csv").read_bytes()))
    monkeypatch.setattr("sys.stdin", piped)
    monkeypatch.chdir(tmp_path)
    done = train("--own", packed, "--own", "-", "--only", "cv", "--folds", "2", system="svm")
    assert done.returncode == 0, done.stderr
    path = Path("runs", "svm-friday-standard-input", "svm-friday-standard-input.json")
    card = json.loads(path.read_text())
    rows = [(file["name"], file["rows"]) for file in card["contract"]["datasets"]]
    assert rows == [("friday", 60), ("standard input", 40)]
    assert "--own friday.csv.gz --own - " in card["command"]


def test_a_plans_table_without_grasps_is_refused() -> None:
    system = dataclasses.replace(SYSTEMS["svm"], tables=("lab", "monday"))
    with pytest.raises(ValueError, match="no grasps of the table 'monday'"):
        TrainingPlan(system, folds=2, seed=0).chosen(smallest())


def test_one_object_is_measured_by_cv_in_fewer_folds(tmp_path: Path) -> None:
    """Nine of them slipped, so ten folds are too many."""
    counts, slipped = separable_counts(20)
    slipped[1] = False
    write_table(tmp_path / "lab.csv", counts, slipped)
    words = "--own", tmp_path / "lab.csv", "--out", tmp_path / "out", "--only", "cv"
    assert last_error(train(*words, "--folds", "10")).endswith("(see --folds and --only)")
    assert "graspd train: takes 9 folds: 10 folds need" in train(*words).stderr
    card = json.loads((tmp_path / "out" / f"{SYSTEM}-lab.json").read_text())
    assert "--folds 9" in card["command"]
    assert card["never_seen"]["held_out_object"] is None
    assert card["calibrated_by"] == "cv"


def test_folds_lacking_a_label_or_a_tables_objects_are_refused(data: Path, tmp_path: Path) -> None:
    made, own, out = smallest(), tmp_path / "lab.csv", ("--out", tmp_path / "out")
    write_table(own, *separable_counts(GRASPS))
    last = last_error(train("--data", data, "--own", own, "--folds", "2", *out))
    assert "leaves out all objects of lab, by whose other grasps" in last
    assert "put the tables of a session together" in last
    objects = tuple("ball" if slip else "box" for slip in made.slipped)
    write(own, dataclasses.replace(made, objects=objects))
    last = last_error(train("--own", own, "--folds", "2", *out))
    assert re.match(r"graspd train: objects, fold 0, has 0 grasps that \w+ to train on", last)


def warnings(done: CompletedProcess[str]) -> list[str]:
    """The warnings of a training that was interrupted."""
    assert done.returncode == 130
    start = "graspd train: warning: "
    lines = done.stderr.splitlines()
    return [line.removeprefix(start) for line in lines if line.startswith(start)]


def test_limits_of_a_model_are_named_before_it_is_trained(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupted(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(make_model, "make_model", interrupted)
    write(tmp_path / "lab.csv", smallest())
    options = "--folds", "2", "--out", tmp_path / "out"
    small = train("--own", tmp_path / "lab.csv", "--only", "cv", *options, system="svm")
    for wanted, sentence in zip(
        (
            "20 grasps are few",
            "svm is not calibrated by the session",
            "one table is one day",
            "of 2 objects little is learned about others",
            "only 10 grasps slipped",
            "only 10 grasps stayed",
            "with --only cv nothing else is measured",
        ),
        warnings(small),
        strict=True,
    ):
        assert sentence.startswith(wanted)
    for day in range(2):
        write(tmp_path / f"day{day}.csv", table("lab", 120, day))
    enough = "--own", tmp_path / "day0.csv", "--own", tmp_path / "day1.csv"
    assert warnings(train(*enough, *options)) == []


def test_training_with_a_name_prints_the_scenes_model_path(tmp_path: Path) -> None:
    write(tmp_path / "lab.csv", smallest())
    path = tmp_path / "out" / "cups.onnx"
    options = "--own", tmp_path / "lab.csv", "--out", path.parent, "--folds", "2", "--only", "cv"
    done = train(*options, "--as", "table", "--name", "cups")
    assert done.stdout.startswith(f"{path}: cv F1 ")
    assert done.stderr.splitlines()[-1] == (
        f'graspd train: for a scene, below [model]: path = "{path}"'
    )
    assert TactileModel(path).contract.name == "cups"
    command = json.loads(path.with_suffix(".json").read_text())["command"]
    assert command == (
        f"graspd train {SYSTEM} --own lab.csv --as table --seed 0 --folds 2 --only cv --name cups"
    )


def test_a_system_of_fingers_that_a_table_lacks_is_refused(tmp_path: Path) -> None:
    counts, slipped = separable_counts(30)
    write_table(tmp_path / "two.csv", counts[:, [0, 2]], slipped, fingers=("ff", "th"))
    refused = train("--data", tmp_path / "two.csv", system="small-session")
    assert refused.returncode == 2
    assert "small-session judges ff, mf, th, the grasps have ff, th" in refused.stderr
    assert "small-session-ff-th" in refused.stderr


def test_impossible_trainings_are_refused_with_exit_code_2(data: Path, tmp_path: Path) -> None:
    missing, own, some = data / "palm_45.csv", tmp_path / "lab.csv", ("--data", data)
    write_table(own, *separable_counts(GRASPS))
    missing.unlink()
    for system, arguments, message in (
        ("small-session", some, f"{missing}: is missing, small-session needs it"),
        (SYSTEM, (), "needs --data DIR, --own FILE, or both"),
        (SYSTEM, ("--own", own, "--only", "cv", "--out", own), f"{own}: File exists"),
        (SYSTEM, ("--own", own, "--folds", "2"), "2 folds need 2 objects, there are 1 (see"),
        (SYSTEM, (*some, "--name", "svm"), "graspd ships a model"),
        (SYSTEM, (*some, "--name", "a/b"), "is not a name"),
        (SYSTEM, (*some, "--name", "x.onnx"), "is not a name"),
        (SYSTEM, (*some, "--folds=1"), "argument --folds: '1' is not a whole number from"),
        (SYSTEM, (*some, "--seed=-1"), "argument --seed: '-1' is not a whole number from"),
    ):
        done = train("--out", tmp_path / "out", *arguments, system=system)
        assert message in last_error(done)
        assert done.stdout == ""
    assert not (tmp_path / "out").exists()


def test_a_failed_export_is_exit_code_1(
    data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def failing(*_: object) -> None:
        raise ExportError("the exported file differs")

    monkeypatch.setattr(make_model, "make_model", failing)
    done = train("--data", data, "--out", tmp_path / "out")
    assert done.returncode == 1
    assert done.stderr.endswith("graspd train: the exported file differs\n")
