"""`graspd models`, and models of a user's own: what is shown, and what is refused."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest

from graspd.models import zoo
from tests.kit.inside import output, refused
from tests.kit.scenes import demo_scene


@pytest.fixture
def own(tmp_path: Path) -> Path:
    """A copy of the model `mlp` without its card."""
    return Path(shutil.copy(zoo.find("mlp"), tmp_path / "mine.onnx"))


def test_a_model_without_a_card_is_shown_by_its_contract(own: Path) -> None:
    shown = output("models", own)
    assert shown.startswith("mlp: no card came with it\n")
    assert f"F1 {100 * zoo.card('mlp')['contract']['measured'][0]['f1_mean']:.1f} +- " in shown


def test_models_refuses_a_damaged_model_or_a_wrong_card(own: Path) -> None:
    whole, card = own.read_bytes(), zoo.card("mlp")
    for content, described, says in (
        (whole[:-100], None, "not a usable ONNX model"),
        (zoo.find("svm").read_bytes(), card, "mine.json: is the card of another file than"),
        (whole, {**card, "weak_points": 3}, "a card is wrong: Expected `array`"),
    ):
        own.write_bytes(content)
        if described is not None:
            own.with_suffix(".json").write_text(json.dumps(described))
        assert says in refused("models", own)


@pytest.mark.parametrize(
    "words",
    [
        ("--data", "t.csv"),
        ("mlp", "--name", "mine"),
        ("mlp", "--out", "runs"),
        ("wrap", "net.onnx", "--data", "t.csv", "--json"),
    ],
)
def test_options_without_effect_on_models_are_refused(words: tuple[str, ...]) -> None:
    said = refused("models", *words)
    assert said.startswith("graspd: --")
    assert "wrap" in said


@pytest.mark.parametrize("command", ["check", "run"])
def test_a_users_model_that_changed_after_first_use_is_refused(
    command: str, own: Path, tmp_path: Path
) -> None:
    scene = demo_scene(tmp_path, sections=f'[model]\npath = "{own}"')
    output(command, scene)
    content = bytearray(own.read_bytes())
    content[len(content) // 4] ^= 0x40  # a bit of a weight
    own.write_bytes(content)
    for again in (("check", scene), ("run", scene), ("models", own)):
        assert "mine.json: is the card of another file than mine.onnx" in refused(*again)
    own.with_suffix(".json").unlink()
    output("check", scene)
