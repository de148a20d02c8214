"""The exported models that ship with graspd, each with a card that says how it was made."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from models.contract import ModelError

ZOO = Path(__file__).parent
STANDING = ZOO / "standing.json"
"""Written by `graspd report error-vs-time --standing`."""


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


def standing(sha256: str) -> dict[str, Any] | None:
    """What `graspd report error-vs-time` found of the model file with this digest, if it was there.

    `f1` on known objects, 0..1, `f1_rank` and `models` that were compared, `paced_p50_us` and
    `speed`, how many times as fast as `cnn1`. Raises `ModelError` if the file is broken.
    """
    try:
        content = json.loads(STANDING.read_bytes())
        found: dict[str, Any] | None = content["models"].get(sha256)
    except FileNotFoundError:
        return None
    except (OSError, ValueError, KeyError, AttributeError) as error:
        raise ModelError(f"{STANDING}: cannot read the standing: {error}") from error
    return found


def find(name: str) -> Path:
    """Path of a model by its name. Raises `ModelError` listing the names that exist."""
    if name not in names():
        raise ModelError(f"no model '{name}' in the zoo; there are: {', '.join(names()) or 'none'}")
    return ZOO / f"{name}.onnx"
