"""The exported models that ship with graspd, each with a card that says how it was made."""

from __future__ import annotations

import json
import os
import re
from collections.abc import Collection
from pathlib import Path
from typing import Any, get_args

from graspd.biotac import Finger
from graspd.models.contract import ModelError

ZOO = Path(__file__).resolve().parent
CARD_MAX_BYTES = 16 << 20
"""Largest card, bytes; a usual one has 0.1 MB."""
NAME_MAX = 64


def names() -> list[str]:
    """Names of the models in the zoo, sorted."""
    return sorted(path.stem for path in ZOO.glob("*.onnx"))


def for_hand(name: str, fingers: Collection[Finger]) -> str:
    """Return the name of a model's variant for these fingers, such as `small-session-ff-th`.

    Return the name itself if no such variant exists, or if it is one already."""
    hand = [finger for finger in get_args(Finger) if finger in fingers]
    form = "-".join((name, *hand))
    is_form = name.endswith(tuple(f"-{finger}" for finger in get_args(Finger)))
    return form if form in names() and not is_form else name


def judging(fingers: Collection[Finger]) -> list[str]:
    """Return the names of models for exactly these fingers. Raises `ModelError` for a bad card."""
    return [name for name in names() if set(card(name)["contract"]["fingers"]) == set(fingers)]


def card(name: str) -> dict[str, Any]:
    """Return the card of a model by name. Raises `ModelError` if there is none."""
    return read_card(find(name).with_suffix(".json"))


def read_card(path: Path) -> dict[str, Any]:
    """Return a card (JSON), checked to have a contract and a file. Raises `ModelError`."""
    try:
        if path.stat().st_size > CARD_MAX_BYTES:
            raise ModelError(f"{path}: larger than {CARD_MAX_BYTES} bytes, not a card")
        content = json.loads(path.read_bytes())
    except (OSError, ValueError, RecursionError) as error:
        raise ModelError(f"{path}: cannot read the card: {error}") from error
    parts = ("contract", "file") if isinstance(content, dict) else ()
    if not parts or not all(isinstance(content.get(part), dict) for part in parts):
        raise ModelError(f"{path}: is not a card")
    return dict(content)


def ships(path: Path, sha256: str) -> bool:
    """Return True for a model of the zoo, False for another file.

    Raises `ModelError` if the file has a card, as all of the zoo have, and this digest
    (hexadecimal) is not the card's.
    """
    real = path.resolve()  # the card may be beside a link or beside its target
    is_ours = real.parent == ZOO.resolve()
    for about in {path.with_suffix(".json"), real.with_suffix(".json")}:
        is_required = is_ours and about.stem == real.stem
        if not is_required and not os.path.exists(about):
            continue
        if read_card(about)["file"].get("sha256") != sha256:
            advice = "install graspd again" if is_ours else f"if it is right, remove {about.name}"
            raise ModelError(
                f"{about}: is the card of another file than {path.name}, which was changed or "
                f"damaged: {advice}"
            )
    return is_ours


def find(name: str) -> Path:
    """Return the path of a model by name. Raises `ModelError`, which lists the existing names."""
    if name not in names():
        import difflib  # only where it is needed

        near = difflib.get_close_matches(name, names(), n=1)
        meant = f"did you mean {near[0]}?" if near else "a model of your own is named by its file"
        raise ModelError(f"no model '{name}' in the zoo; there are: {', '.join(names())}; {meant}")
    return ZOO / f"{name}.onnx"


def is_name(text: str) -> bool:
    """Return True if a model may have this name: it must be a file name, not a path."""
    whole = re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9._-]*", text) is not None
    return whole and len(text) <= NAME_MAX and not text.endswith(".onnx")
