"""Find models by name: those of the zoo, and those that `graspd models add` has added.

Added models lie in a folder of the user or, for services, of the system.
"""

from __future__ import annotations

import json
import os
import re
from pathlib import Path
from typing import Any

from graspd.models import trial, zoo
from graspd.models.contract import ModelError
from graspd.models.runtime import ModelFile, read

SYSTEM_FOLDER = Path("/var/lib/graspd/models")
"""Folder of added models for all users; the service's user has only this one."""
NAME_MAX = 64


def user_folder() -> Path | None:
    """Return the user's own folder of added models; None without a home."""
    try:
        return Path.home() / ".local" / "share" / "graspd" / "models"
    except RuntimeError:
        return None


def folders() -> list[Path]:
    """Return the folders of added models, in the order of the search."""
    return [folder for folder in (user_folder(), SYSTEM_FOLDER) if folder is not None]


def added() -> dict[str, Path]:
    """Return the files of the added models by name, sorted; unreadable ones are left out."""
    models: dict[str, Path] = {}
    for folder in reversed(folders()):
        models |= {path.stem: path for path in folder.glob("*.onnx") if is_name(path.stem)}
    return {name: path for name, path in sorted(models.items()) if name not in zoo.names()}


def is_name(text: str) -> bool:
    """Return True if a model may have this name: it must be a file name, not a path."""
    whole = re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9._-]*", text) is not None
    return whole and len(text) <= NAME_MAX and not text.endswith(".onnx")


def find(name: str) -> Path:
    """Return a model's file, from the zoo, the user or the system. Raises `ModelError`."""
    if name in zoo.names():
        return zoo.find(name)
    for folder in folders() if is_name(name) else ():
        path = folder / f"{name}.onnx"
        if os.path.isfile(path):  # raises no error if the folder cannot be read
            return path
    others = added()
    import difflib  # only where it is needed

    near = difflib.get_close_matches(name, [*zoo.names(), *others], n=1)
    meant = f"did you mean {near[0]}?" if near else "graspd models add FILE adds one"
    raise ModelError(
        f"no model '{name}' in the zoo; there are: {', '.join(zoo.names())}; in "
        f"{' or '.join(map(str, folders()))}: {', '.join(others) or 'none'}; {meant}"
    )


def card(path: Path, file: ModelFile | None = None) -> dict[str, Any]:
    """Return the card beside a model file; without a card, one made of its contract.

    The model is loaded as by the daemon. `file`: its content, if it was read before. Raises
    `ModelError` if the daemon would refuse the model, or if the card is of another file.
    """
    file = read(path) if file is None else file
    contract = json.loads(trial.load(path, file).contract.to_json())
    about = path.with_suffix(".json")
    if not about.exists():
        size = {"sha256": file.sha256, "size_bytes": len(file.data)}
        return {"what": "no card came with it", "contract": contract, "file": size}
    return {**zoo.read_card(about), "contract": contract}
