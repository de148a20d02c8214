"""Advice for a user who lacks the package of an extra."""

from __future__ import annotations

import re
import shlex
import sys
from pathlib import Path


def needs(what: str, extra: str, error: ModuleNotFoundError) -> str:
    """Return how to install the missing `extra`. Raises `error` for a module of graspd."""
    package = (error.name or "").partition(".")[0]
    if package == "graspd":
        raise error
    return (
        f"{what} needs the package '{package}': run {installer(Path(sys.prefix))} '.[{extra}]' in "
        "the folder of graspd's source"
    )


def installer(environment: Path) -> str:
    """Return the command that adds packages to `environment`: pipx, uv or pip."""
    if (environment / "pipx_metadata.json").exists():
        return f"pipx runpip {shlex.quote(environment.name)} install"
    config = environment / "pyvenv.cfg"
    if config.is_file() and re.search(r"^uv = ", config.read_text(), re.MULTILINE):
        return f"uv pip install --python {shlex.quote(str(environment))}"
    return "pip install"
