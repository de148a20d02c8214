"""Advice for a user who lacks a package."""

from __future__ import annotations

import re
import shlex
import sys
from importlib import import_module
from pathlib import Path


def require(package: str, what: str, extra: str) -> None:
    """Raise `ModuleNotFoundError` if `package`, which `what` needs, is missing.

    The message says how to install `extra`.
    """
    try:
        import_module(package)
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError(needs(what, extra, error), name=error.name) from error


def needs(what: str, extra: str, error: ModuleNotFoundError) -> str:
    """Return text that `what` needs the package missing in `error`, and how to install `extra`.

    Raises `error` if it is about a module of graspd itself.
    """
    package = (error.name or "").partition(".")[0]
    if package == "graspd":
        raise error
    return (
        f"{what} needs the package '{package}': run {installer()} '.[{extra}]' in "
        "the folder of graspd's source"
    )


def installer() -> str:
    """Return the command that adds packages to the environment of this Python."""
    environment = Path(sys.prefix)
    if (environment / "pipx_metadata.json").exists():
        return f"pipx runpip {shlex.quote(environment.name)} install"
    config = environment / "pyvenv.cfg"
    if config.is_file() and re.search(r"^uv = ", config.read_text(), re.MULTILINE):
        return f"uv pip install --python {shlex.quote(str(environment))}"
    return f"{shlex.quote(sys.executable)} -m pip install"
