"""Loading a model: what does not fit is refused in one line, what fits runs on one image."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from models import zoo
from models.contract import ModelError
from models.runtime import TactileModel

CNN1 = zoo.find("cnn1")


def test_the_answer_is_two_probabilities_that_follow_the_image() -> None:
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


def _missing(path: Path) -> None:
    path.with_name("other.onnx").touch()


def _directory(path: Path) -> None:
    path.mkdir()


def _fifo(path: Path) -> None:
    os.mkfifo(path)


def _empty(path: Path) -> None:
    path.touch()


def _text(path: Path) -> None:
    path.write_text("not a model")


def _truncated(path: Path) -> None:
    path.write_bytes(CNN1.read_bytes()[:-1000])


@pytest.mark.parametrize("make", [_missing, _directory, _fifo, _empty, _text, _truncated])
def test_what_is_no_model_is_refused_in_one_line(
    tmp_path: Path, make: Callable[[Path], None]
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


def _without_metadata(model: Any) -> None:  # noqa: ANN401 - onnx ships no types
    del model.metadata_props[:]


def _other_layout(model: Any) -> None:  # noqa: ANN401
    entry = model.metadata_props[0]
    entry.value = entry.value.replace('"layout":"D1"', '"layout":"D3"')


def _unknown_layout(model: Any) -> None:  # noqa: ANN401
    entry = model.metadata_props[0]
    entry.value = entry.value.replace('"layout":"D1"', '"layout":"D9"')


def _other_fill(model: Any) -> None:  # noqa: ANN401
    entry = model.metadata_props[0]
    entry.value = entry.value.replace("neighbour-mean", "zeros")


def _two_fingers(model: Any) -> None:  # noqa: ANN401
    entry = model.metadata_props[0]
    entry.value = entry.value.replace('["ff","mf","th"]', '["ff","mf"]')


def _other_input(model: Any) -> None:  # noqa: ANN401
    for node in model.graph.node:
        for index, name in enumerate(node.input):
            if name == "tactile_image":
                node.input[index] = "picture"
    model.graph.input[0].name = "picture"


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (_without_metadata, "has no contract"),
        (_other_layout, r"its contract says \(4, 7, 3\)"),
        (_unknown_layout, "asks for an image that is not known: 'D9'"),
        (_other_fill, "asks for an image that is not known: 'zeros'"),
        (_two_fingers, r"not \(fingers, 24\)"),
        (_other_input, r"has inputs \['picture'\]"),
    ],
)
def test_a_model_that_contradicts_its_contract_is_refused(
    tmp_path: Path,
    change: Callable[[Any], None],
    says: str,
) -> None:
    onnx = pytest.importorskip("onnx", reason="needs the train extra")
    model = onnx.load(CNN1)
    change(model)
    path = tmp_path / "model.onnx"
    onnx.save(model, path)
    with pytest.raises(ModelError, match=says):
        TactileModel(path)
