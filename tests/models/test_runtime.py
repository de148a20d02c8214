"""Loading a model: a wrong file is refused in one line, one from outside the zoo is tried first."""

from __future__ import annotations

import os
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

CNN1 = zoo.find("cnn1")


def test_two_probabilities_sum_to_one_and_depend_on_the_input() -> None:
    model = TactileModel(CNN1)
    random = np.random.default_rng(0)
    answers = []
    for _ in range(5):
        model.input[...] = random.normal(size=model.input.shape)
        answers.append(model.run())
        assert sum(answers[-1]) == pytest.approx(1.0, abs=1e-6)
    assert len(set(answers)) == 5
    model.input[...] = 0.0
    assert model.run() == model.run()


@pytest.mark.parametrize(
    "make",
    [
        lambda path: path.with_name("other.onnx").touch(),
        lambda path: path.mkdir(),
        os.mkfifo,
        lambda path: path.touch(),
        lambda path: path.write_text("not a model"),
        lambda path: path.write_bytes(CNN1.read_bytes()[:-1000]),
    ],
    ids=["missing", "directory", "fifo", "empty", "text", "truncated"],
)
def test_other_files_than_models_are_refused_in_one_line(
    tmp_path: Path, make: Callable[[Path], object]
) -> None:
    path = tmp_path / "model.onnx"
    make(path)
    with pytest.raises(ModelError) as error:
        TactileModel(path)
    assert str(error.value).startswith(f"{path}: ")
    assert len(str(error.value).splitlines()) == 1


def test_a_path_that_no_file_can_have_is_refused() -> None:
    with pytest.raises(ModelError, match="cannot read the model"):
        TactileModel(Path("a\0b.onnx"))


@pytest.mark.parametrize(
    ("stated", "wrongly", "says"),
    [
        ('"layout":"D1"', '"layout":"D3"', r"its contract says \(4, 7, 3\)"),
        ("filled-image", "min-max", "asks for an image that is not known: 'min-max'"),
    ],
)
def test_a_model_that_contradicts_its_contract_is_refused(
    tmp_path: Path, stated: str, wrongly: str, says: str
) -> None:
    onnx = pytest.importorskip("onnx", reason="needs the extra `train`")
    model = onnx.load(CNN1)
    entry = model.metadata_props[0]
    assert stated in entry.value
    entry.value = entry.value.replace(stated, wrongly)
    onnx.save(model, tmp_path / "model.onnx")
    with pytest.raises(ModelError, match=says):
        TactileModel(tmp_path / "model.onnx")


def test_a_model_with_another_input_or_no_contract_is_refused(tmp_path: Path) -> None:
    onnx = pytest.importorskip("onnx", reason="needs the extra `train`")
    model, path = onnx.load(CNN1), tmp_path / "model.onnx"
    renamed = onnx.compose.add_prefix(model, "another_")
    onnx.save(renamed, path)
    with pytest.raises(ModelError, match=r"has inputs \['another_tactile_image'\]"):
        TactileModel(path)
    del model.metadata_props[:]
    onnx.save(model, path)
    with pytest.raises(ModelError, match="has no contract"):
        TactileModel(path)


@pytest.fixture(autouse=True)
def nothing_is_known(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(trial, "passed", deque())
    monkeypatch.setattr(trial, "WAIT_S", 200.0)  # a busy computer starts a process slowly


@pytest.fixture
def processes(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Return a list that gets the path of each model tried in a process of its own."""
    tried: list[str] = []
    run = subprocess.run

    def noted(command: list[str], **options: Any) -> subprocess.CompletedProcess[bytes]:  # noqa: ANN401
        tried.append(command[3])
        return run(command, **options)

    monkeypatch.setattr(subprocess, "run", noted)
    return tried


def copy(folder: Path, name: str = "mlp") -> Path:
    return Path(shutil.copy(zoo.find(name), folder / "mine.onnx"))


def test_a_model_of_the_zoo_is_loaded_without_trial(processes: list[str]) -> None:
    assert trial.load(zoo.find("mlp")).contract.name == "mlp"
    assert processes == []


def test_a_model_outside_the_zoo_is_tried_once_per_content(
    tmp_path: Path, processes: list[str]
) -> None:
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
def test_a_damaged_model_is_refused_only_beside_its_card(
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
    """Return the content of a model file with one bit of a weight flipped."""
    place = len(content) // 4
    return content[:place] + bytes([content[place] ^ 0x40]) + content[place + 1 :]


def test_a_model_with_a_forbidden_operator_is_refused(tmp_path: Path) -> None:
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


def test_a_model_of_too_much_time_or_memory_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(ModelError, match=r"Failed to allocate|takes too long|takes more than"):
        trial.load(giant(tmp_path, side=20_000))
    monkeypatch.setattr(trial, "WAIT_S", 3.0)
    with pytest.raises(ModelError, match="takes too long: no answer within 3 s"):
        trial.load(giant(tmp_path, side=5000))
    # As the kernel ends a process at its limit of processor time.
    over = "import os, signal; os.kill(os.getpid(), signal.SIGXCPU)"
    monkeypatch.setattr(trial, "_BEGIN", over)
    with pytest.raises(ModelError, match="takes too long: over 10 s of processor time"):
        trial.load(giant(tmp_path, side=5000))
