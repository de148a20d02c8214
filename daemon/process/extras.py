"""What to tell a user who lacks a package that only an extra of `pyproject.toml` installs."""

from __future__ import annotations

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
        f"{what} needs the package '{package}': run pip install '.[{extra}]' in the folder of "
        "graspd's source"
    )
