"""An unknown model is tried in a process of its own, which may be slow or grow."""

from __future__ import annotations

import shutil
import subprocess
from collections import deque
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from graspd.models import trial, zoo
from graspd.models.contract import ModelError
from graspd.models.runtime import TactileModel


@pytest.fixture(autouse=True)
def nothing_is_known(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(trial, "passed", deque())
    monkeypatch.setattr(trial, "TRIAL_S", 200.0)  # a busy computer starts a process slowly


@pytest.fixture
def processes(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Paths of the models that were tried."""
    tried: list[str] = []
    run = subprocess.run

    def noted(command: list[str], **options: Any) -> subprocess.CompletedProcess[bytes]:  # noqa: ANN401
        tried.append(command[3])
        return run(command, **options)

    monkeypatch.setattr(subprocess, "run", noted)
    return tried


def copy(folder: Path, name: str = "mlp") -> Path:
    return Path(shutil.copy(zoo.find(name), folder / "mine.onnx"))


def test_a_model_of_the_zoo_is_known(processes: list[str]) -> None:
    assert trial.load(zoo.find("mlp")).contract.name == "mlp"
    assert processes == []


def test_a_model_that_is_not_is_tried_once(tmp_path: Path, processes: list[str]) -> None:
    path = copy(tmp_path)
    for _ in range(2):
        assert trial.load(path).run() == TactileModel(zoo.find("mlp")).run()
    assert processes == [str(path)]
    path.write_bytes(path.read_bytes() + b"\x10\x0a")  # the version of the format once more
    trial.load(path)
    assert len(processes) == 2


@pytest.mark.parametrize("load", [trial.load, TactileModel])
def test_a_damaged_model_of_the_zoo_is_refused(
    load: Callable[[Path], TactileModel], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path, card = (Path(shutil.copy(zoo.ZOO / f"mlp.{kind}", tmp_path)) for kind in ("onnx", "json"))
    link = tmp_path / "link.onnx"
    link.symlink_to(path)
    monkeypatch.setattr(zoo, "ZOO", tmp_path)
    assert load(path).run() == load(link).run()
    path.write_bytes(damaged(path.read_bytes()))
    for name in (path, link):
        with pytest.raises(ModelError, match=r"mlp\.json: is the card of another .*install graspd"):
            load(name)
    card.unlink()
    with pytest.raises(ModelError, match=r"mlp\.json: cannot read the card"):
        load(path)


@pytest.mark.parametrize("load", [trial.load, TactileModel])
def test_a_damaged_model_is_refused_by_its_card(
    load: Callable[[Path], TactileModel], tmp_path: Path
) -> None:
    path, card = copy(tmp_path), tmp_path / "mine.json"
    shutil.copy(zoo.ZOO / "mlp.json", card)
    assert load(path).contract.name == "mlp"
    path.write_bytes(damaged(path.read_bytes()))
    with pytest.raises(ModelError, match=r"mine\.json: is the card of another .*remove mine.json"):
        load(path)
    card.unlink()
    assert load(path).contract.name == "mlp"  # nothing knows better


def damaged(content: bytes) -> bytes:
    """With one bit of a weight flipped."""
    place = len(content) // 4
    return content[:place] + bytes([content[place] ^ 0x40]) + content[place + 1 :]


def test_a_model_with_another_operator_is_refused(tmp_path: Path) -> None:
    onnx = pytest.importorskip("onnx", reason="needs the extra `train`")
    model, path = onnx.load(zoo.find("mlp")), tmp_path / "loop.onnx"
    model.graph.node.add().op_type = "Loop"
    path.write_bytes(model.SerializeToString())
    for load in (trial.load, TactileModel):
        with pytest.raises(ModelError, match="no model may use: 'Loop'"):
            load(path)


def giant(folder: Path, side: int) -> Path:
    """A zoo model that also multiplies matrices of `side` rows for minutes."""
    onnx = pytest.importorskip("onnx", reason="needs the extra `train`")
    model, path, node_of = onnx.load(zoo.find("mlp")), folder / "giant.onnx", onnx.helper.make_node
    graph = model.graph
    next(node for node in graph.node if "probability" in node.output).output[0] = "sound"
    for name, shape in (("wide", (2, side)), ("row", (1, side)), ("two", (side, 2))):
        weights = onnx.numpy_helper.from_array(np.zeros(shape, np.float32), name)
        graph.initializer.append(weights)
    graph.initializer.append(onnx.numpy_helper.from_array(np.array([side, 1]), "column"))
    graph.node.append(node_of("MatMul", ["sound", "wide"], ["line"]))
    graph.node.append(node_of("Reshape", ["line", "column"], ["upright"]))
    products = [("upright", "row", "m0")]
    products += [(f"m{number}", f"m{number}", f"m{number + 1}") for number in range(40)]
    products += [("row", "m40", "last"), ("last", "two", "nothing")]
    graph.node.extend(node_of("MatMul", [one, other], [name]) for one, other, name in products)
    graph.node.append(node_of("Add", ["sound", "nothing"], ["probability"]))
    onnx.save_model(model, path)
    return path


def test_one_that_takes_too_long_or_much_memory_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(ModelError, match=r"Failed to allocate|no answer within|takes more than"):
        trial.load(giant(tmp_path, side=20_000))
    monkeypatch.setattr(trial, "TRIAL_S", 3.0)
    with pytest.raises(ModelError, match="takes too long: no answer within 3 s"):
        trial.load(giant(tmp_path, side=5000))
