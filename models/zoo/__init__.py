"""The exported models that ship with graspd, each with a card that says how it was made."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from models.contract import ModelError

ZOO = Path(__file__).parent


def names() -> list[str]:
    """Names of the models in the zoo, sorted."""
    return sorted(path.stem for path in ZOO.glob("*.onnx"))


def card(name: str) -> dict[str, Any]:
    """The card of a model by its name. Raises `ModelError` if there is none."""
    path = find(name).with_suffix(".json")
    try:
        content = json.loads(path.read_bytes())
    except (OSError, ValueError) as error:
        raise ModelError(f"{path}: cannot read the card: {error}") from error
    if not isinstance(content, dict):
        raise ModelError(f"{path}: is no card")
    return content


def find(name: str) -> Path:
    """Path of a model by its name. Raises `ModelError` listing the names that exist."""
    if name not in names():
        raise ModelError(f"no model '{name}' in the zoo; there are: {', '.join(names()) or 'none'}")
    return ZOO / f"{name}.onnx"
