"""A change of a user's own model is noticed, from the first time that a scene names it."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest

from graspd.models import zoo
from tests.kit.inside import graspd
from tests.kit.scenes import demo_scene


def flip(path: Path) -> None:
    """Flip a bit of a weight."""
    content = bytearray(path.read_bytes())
    content[len(content) // 4] ^= 0x40
    path.write_bytes(content)


@pytest.mark.parametrize("command", ["check", "run"])
def test_a_change_of_an_own_model_is_refused(command: str, tmp_path: Path) -> None:
    model = Path(shutil.copy(zoo.find("mlp"), tmp_path / "mine.onnx"))
    scene = demo_scene(tmp_path, sections=f'[model]\npath = "{model}"')
    first = graspd(command, scene)
    assert first.returncode == 0, first.stderr
    kept = json.loads(model.with_suffix(".json").read_text())
    assert kept["file"]["sha256"] == zoo.card("mlp")["file"]["sha256"]
    flip(model)
    for again in (("check", scene), ("run", scene), ("models", model)):
        refused = graspd(*again)
        assert refused.returncode == 2
        assert "mine.json: is the card of another file than mine.onnx" in refused.stderr
    model.with_suffix(".json").unlink()
    assert graspd("check", scene).returncode == 0
