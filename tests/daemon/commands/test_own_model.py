"""A lab with grasps of its own: table, training, the model by its file in a scene, verdicts."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from graspd.models.runtime import read
from tests.kit.inside import graspd
from tests.models.training.samples import table, write


@pytest.mark.slow
def test_a_table_becomes_a_model_that_a_scene_names(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for package in ("torch", "rich"):
        pytest.importorskip(package, reason="needs the extra `train`")
    monkeypatch.chdir(tmp_path)
    write(tmp_path / "monday.csv", table("monday", 60, 1))

    trained = graspd("train", "svm", "--own", "monday.csv", "--folds", 2, "--only", "cv")
    assert trained.returncode == 0, trained.stderr
    *warnings, last = trained.stderr.splitlines()
    assert any("not calibrated by the session" in line for line in warnings)
    line = last.removeprefix("graspd train: for a scene, below [model]: ")
    model = tmp_path / "runs" / "svm-monday" / "svm-monday.onnx"
    assert line == f'path = "{model}"'

    scene = tmp_path / "right.toml"
    scene.write_text(
        f'[tactile]\ndriver = "replay"\nrecordings = ["monday.csv"]\n[model]\n{line}\n'
    )
    checked = graspd("check", scene)
    assert checked.returncode == 0, checked.stderr
    sha256 = read(model).sha256
    assert f"svm-monday ({sha256[:12]})" in checked.stdout

    replayed = graspd("replay", "monday.csv", "--model", model, "--json")
    assert replayed.returncode == 0, replayed.stderr
    verdicts = [json.loads(line) for line in replayed.stdout.splitlines()]
    assert len(verdicts) == 60
    assert {verdict["model_sha"] for verdict in verdicts} == {sha256[:12]}
    assert {"stable", "slip"} <= {verdict["verdict"] for verdict in verdicts}
