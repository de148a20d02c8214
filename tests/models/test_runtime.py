"""Loading a model: what does not fit is refused in one line, what fits runs on one image."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from graspd.models import zoo
from graspd.models.contract import ModelError
from graspd.models.runtime import TactileModel

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


def test_another_input_or_no_contract_is_refused(tmp_path: Path) -> None:
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
