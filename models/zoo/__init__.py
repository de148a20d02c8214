"""The exported models that ship with graspd, each with a card that says how it was made."""

from __future__ import annotations

from pathlib import Path

from models.contract import ModelError

ZOO = Path(__file__).parent


def names() -> list[str]:
    """Names of the models in the zoo, sorted."""
    return sorted(path.stem for path in ZOO.glob("*.onnx"))


def find(name: str) -> Path:
    """Path of a model by its name. Raises `ModelError` listing the names that exist."""
    if name not in names():
        raise ModelError(f"no model '{name}' in the zoo; there are: {', '.join(names()) or 'none'}")
    return ZOO / f"{name}.onnx"
