"""What to tell a user who lacks a package that only an extra of `pyproject.toml` installs."""

from __future__ import annotations

import re
import shlex
import sys
from pathlib import Path

OURS = frozenset({"daemon", "drivers", "models"})


def needs(what: str, extra: str, error: ModuleNotFoundError) -> str:
    """One line for a user: `what` needs the package that `error` misses, and how to install it.

    `what` is such as "watch" or "[record]", `extra` the extras that bring the package. Raises
    `error` itself if it misses a module of graspd's own: no extra brings that.
    """
    package = (error.name or "").partition(".")[0]
    if package in OURS:
        raise error
    return (
        f"{what} needs the package '{package}': run {installer(Path(sys.prefix))} '.[{extra}]' in "
        "the folder of graspd's source"
    )


def installer(environment: Path) -> str:
    """The command that adds packages to a virtual environment, by who made it: pipx, uv or pip."""
    if (environment / "pipx_metadata.json").exists():
        return f"pipx runpip {shlex.quote(environment.name)} install"
    config = environment / "pyvenv.cfg"
    if config.is_file() and re.search(r"^uv = ", config.read_text(), re.MULTILINE):
        return f"uv pip install --python {shlex.quote(str(environment))}"
    return "pip install"
