"""Where the program `graspd` begins: it makes sure that the packages it runs are graspd's own.

In the wheel this file is the module `graspd`, a name that no other package has. `daemon`, `drivers`
and `models` are names that other packages have too, and Python imports the first that it finds.
"""

from __future__ import annotations

import sys
from importlib.util import find_spec
from pathlib import Path

OURS = {
    "daemon": '"""The daemon: scene, judge, publisher',
    "drivers": '"""Everything that touches a sensor',
    "models": '"""What the tactile image is',
}
"""Our packages, and how the `__init__.py` of each begins."""
WRONG = 2


def main() -> int:
    """Run the command line; 2 and one line on stderr if another package is in place of ours."""
    problem = clash()
    if problem is not None:
        sys.stderr.write(f"graspd: {problem}\n")
        return WRONG
    from graspd.daemon.__main__ import main as graspd

    return graspd()


def clash() -> str | None:
    """Say what is in place of one of our packages and what to do; None: nothing is."""
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
