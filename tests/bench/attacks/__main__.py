"""Attack a daemon through its real sockets; print how much was tried, and what happened.

deploy/ATTACKS.md says what each attack tries. `python -m tests.bench.attacks --minutes 60` shares
the time evenly among them; `--only NAME` tries one. Exits with 1 if graspd failed in one.
"""

from __future__ import annotations

import argparse
import logging
import random
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Final

from graspd.models.training.evaluating.files import markdown_table
from tests.bench.attacks import doors, hang_ups
from tests.bench.attacks.doors import Outcome, Plan
from tests.bench.live import end_children_at_sigterm
from tests.daemon.processes import before_others

ATTACKS: Final[dict[str, Callable[[Plan], Outcome]]] = {
    "connections-curve": doors.connections,
    "noise-ipc": doors.noises,
    "flood": doors.flood,
    "ping-hangup": hang_ups.hang_ups,
}
"""Attacks by name, in the order of deploy/ATTACKS.md. One that raises counts as not held."""
HEAD = ("attack", "how often", "what happened", "held")

log = logging.getLogger("attacks")


def tried(name: str, seconds: float, seed: int) -> Outcome:
    """Run one attack for about `seconds`; return its outcome, not held if it raises."""
    with tempfile.TemporaryDirectory(prefix="graspd-") as folder:
        try:
            return ATTACKS[name](Plan(seconds, random.Random(f"{name}-{seed}"), Path(folder)))
        except Exception as error:
            log.exception("%s", name)
            return Outcome(0, f"{type(error).__name__}: {error}".partition("\n")[0], held=False)


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.bench.attacks", description=__doc__)
    parser.add_argument("--minutes", type=float, default=5.0, help="for all of them (default 5)")
    parser.add_argument(
        "--only", action="append", metavar="NAME", choices=ATTACKS, help="one; may be given again"
    )
    parser.add_argument("--seed", type=int, default=1)
    given = parser.parse_args(arguments)
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    names = given.only or list(ATTACKS)
    outcomes: dict[str, Outcome] = {}
    end_s = time.monotonic() + given.minutes * 60.0
    for name in names:
        left_s = max(0.0, end_s - time.monotonic())  # some take longer: the others have less
        outcome = tried(name, left_s / (len(names) - len(outcomes)), given.seed)
        log.info("%s: %s: %s", name, outcome.tried, outcome.happened)
        outcomes[name] = outcome
    rows = [
        (f"`{name}`", f"{each.tried:,}", each.happened, "yes" if each.held else "**no**")
        for name, each in outcomes.items()
    ]
    print("\n".join(markdown_table(HEAD, rows)))  # noqa: T201
    return 0 if all(outcome.held for outcome in outcomes.values()) else 1


if __name__ == "__main__":
    end_children_at_sigterm()
    with before_others():
        code = main()
    sys.exit(code)
