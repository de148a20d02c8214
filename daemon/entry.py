"""Where the program `graspd` begins: it makes sure that what it is going to run is graspd's own.

In the wheel this file is the module `graspd`, a name that no other package has. `daemon`, `drivers`
and `models` are names that others have too, and what is imported is the first that is found.
"""

from __future__ import annotations

import gc
import sys
from importlib.util import find_spec
from pathlib import Path

OURS = {"daemon": "cli.py", "drivers": "biotac.py", "models": "bts3.py"}
"""Our packages, each with a file that those of others do not have."""
WRONG = 2


def main() -> int:
    """Run the command line; 2 and one line on stderr if another package is in the way of ours."""
    gc.disable()  # until all is loaded: see `daemon.process.start`
    problem = clash()
    if problem is not None:
        sys.stderr.write(f"graspd: {problem}\n")
        return WRONG
    from daemon.__main__ import main as graspd

    return graspd()


def clash() -> str | None:
    """Which package is in the way of one of ours, and what to do; None if all is well."""
    beside = Path(__file__).parent.glob("graspd-*.dist-info/RECORD")
    record = "".join(path.read_text() for path in beside)
    for name, file in OURS.items():
        spec = find_spec(name)
        if spec is None or spec.origin is None:
            return f"the package {name} of graspd is missing: install graspd anew"
        init = Path(spec.origin)
        others = set()
        is_ours = (init.parent / file).is_file()
        if not is_ours or _was_replaced(init, name, record):
            # Not at each start: it takes 20 ms.
            from importlib.metadata import packages_distributions

            others = set(packages_distributions().get(name, ())) - {"graspd"}
        if others or not is_ours:
            if not others:
                return f"{init.parent} is not graspd's: leave {init.parent.parent} off PYTHONPATH"
            return (
                f"{init.parent} is not graspd's but of the package {', '.join(sorted(others))}: "
                "install graspd in an environment of its own (pipx, uv tool, python3 -m venv)"
            )
    return None


def _was_replaced(init: Path, name: str, record: str) -> bool:
    """Whether an `__init__.py` is another than `record` has; of a checkout, with none, nobody
    knows."""
    from base64 import urlsafe_b64encode
    from hashlib import sha256

    digest = urlsafe_b64encode(sha256(init.read_bytes()).digest()).rstrip(b"=").decode()
    lines = [line for line in record.splitlines() if line.startswith(f"{name}/__init__.py,")]
    return any(f",sha256={digest}," not in line for line in lines)


if __name__ == "__main__":
    sys.exit(main())
