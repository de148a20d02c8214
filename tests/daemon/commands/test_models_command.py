"""`graspd models`: what a user reads before choosing one."""

from __future__ import annotations

import json
import shutil
from functools import partial
from pathlib import Path

import pytest

from graspd.models import zoo
from tests.kit.inside import graspd


@pytest.fixture
def trained(tmp_path: Path) -> Path:
    """What `graspd train` leaves behind: a model and its card."""
    folder = tmp_path / "runs"
    folder.mkdir()
    shutil.copy(zoo.find("mlp").with_suffix(".json"), folder / "mine.json")
    return Path(shutil.copy(zoo.find("mlp"), folder / "mine.onnx"))


command = partial(graspd, "models")


def done(*words: object) -> str:
    """What a command that succeeds prints."""
    result = command(*words)
    assert result.returncode == 0, result.stderr
    return result.stdout


def refused(says: str, *words: object) -> None:
    result = command(*words)
    assert result.returncode == 2
    assert says in result.stderr
    assert result.stderr.count("\n") == 1


@pytest.mark.parametrize("name", zoo.names())
def test_a_card_gives_a_models_worth_and_limits(name: str) -> None:
    result = graspd("models", name)
    assert result.returncode == 0, result.stderr
    card = zoo.card(name)
    assert card["what"] in result.stdout
    for point in card["weak_points"]:
        assert point in result.stdout
    assert f"made by: graspd train {name} --data DIR" in result.stdout
    assert "licence of the data: MIT" in result.stdout
    assert json.loads(graspd("models", name, "--json").stdout) == card


def test_a_model_without_a_card_is_shown_by_its_contract(trained: Path) -> None:
    trained.with_suffix(".json").unlink()
    shown = done(trained)
    assert shown.startswith("mlp: no card came with it\n")
    assert f"F1 {100 * zoo.card('mlp')['contract']['measured'][0]['f1_mean']:.1f} +- " in shown


def test_a_file_that_the_daemon_would_refuse_is_not_shown(trained: Path) -> None:
    whole, card = trained.read_bytes(), trained.with_suffix(".json").read_text()
    trained.with_suffix(".json").unlink()
    trained.write_bytes(whole[:-100])
    refused("not a usable ONNX model", trained)
    trained.with_suffix(".json").write_text(card)
    shutil.copy(zoo.find("svm"), trained)
    refused("mine.json: is the card of another file than mine.onnx", trained)
    trained.write_bytes(whole)
    trained.with_suffix(".json").write_text(json.dumps({**json.loads(card), "weak_points": 3}))
    refused("a card is wrong: Expected `array`", trained)
    refused("absent.onnx: cannot read the model", "absent.onnx")
