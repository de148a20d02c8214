"""Start of the program `graspd`: check that the imported packages are graspd's own.

In the wheel this file is the module `graspd`, a name that no other package has. Other packages too
are called `daemon`, `drivers` or `models`, and Python imports the first one on its path.
"""

from __future__ import annotations

import sys
from importlib.util import find_spec
from pathlib import Path

OURS = {
    "daemon": '"""The daemon: scene, judge, publisher',
    "drivers": '"""Sensors: wire formats',
    "models": '"""The tactile image, the networks',
}
"""Packages of graspd, and the first words in the `__init__.py` of each."""
WRONG = 2


def main() -> int:
    """Run the command line; return 2, with a line on stderr, if `clash` finds a problem."""
    problem = clash()
    if problem is not None:
        sys.stderr.write(f"graspd: {problem}\n")
        return WRONG
    from graspd.daemon.__main__ import main as graspd

    return graspd()


def clash() -> str | None:
    """Return which foreign package hides one of `OURS` and what to do; None: no problem."""
    for name, beginning in OURS.items():
        spec = find_spec(name)
        if spec is None or spec.origin is None:
            return f"the package {name} of graspd is missing: install graspd again"
        init = Path(spec.origin)
        if not init.read_text(errors="replace").startswith(beginning):
            return (
                f"{init.parent} is not graspd's: leave {init.parent.parent} off PYTHONPATH, or "
                "install graspd in an environment of its own (pipx, uv tool, python3 -m venv)"
            )
    return None


if __name__ == "__main__":
    sys.exit(main())
