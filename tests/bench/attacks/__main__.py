"""Attacks a daemon over its real doors, and prints what was tried, how often, and what happened.

`python -m tests.bench.attacks --minutes 60` shares the time evenly; `--only NAME` tries one. Exits
with 1 if something did not hold.
"""

from __future__ import annotations

import argparse
import importlib
import logging
import pkgutil
import random
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

from graspd.daemon.process.text import markdown_table
from tests.bench.attacks.attack import Aim, Attack, Outcome, Plan
from tests.bench.live import end_children_at_sigterm

NOT_ATTACKS = {"__main__", "attack"}
"""Modules of this folder that are none; each other has a tuple `ATTACKS`."""
HEAD = ("attack", "what was tried", "how often", "what happened", "held")

log = logging.getLogger("attacks")


def attacks() -> list[Attack]:
    """All of them, by what they are after."""
    found = [
        attack
        for module in pkgutil.iter_modules([str(Path(__file__).parent)])
        if module.name not in NOT_ATTACKS
        for attack in importlib.import_module(f"tests.bench.attacks.{module.name}").ATTACKS
    ]
    return sorted(found, key=lambda attack: list(Aim).index(attack.aim))


def tried(attack: Attack, seconds: float, seed: int) -> Outcome:
    """What came of one attack; what it raises is not held."""
    with tempfile.TemporaryDirectory(prefix="graspd-") as folder:
        try:
            return attack.run(Plan(seconds, random.Random(f"{attack.name}-{seed}"), Path(folder)))
        except Exception as error:
            log.exception("%s", attack.name)
            return Outcome(0, f"{type(error).__name__}: {error}".partition("\n")[0], held=False)


def report(attacked: Sequence[tuple[Attack, Outcome]]) -> str:
    """A table in Markdown for each aim."""
    lines: list[str] = []
    for aim in Aim:
        rows = [
            [
                f"`{attack.name}`",
                attack.what,
                f"{outcome.tried:,} {attack.unit}",
                outcome.happened,
                "yes" if outcome.held else "**no**",
            ]
            for attack, outcome in attacked
            if attack.aim is aim
        ]
        if rows:
            lines += [f"## {aim.value[:1].upper()}{aim.value[1:]}", "", *markdown_table(HEAD, rows)]
            lines.append("")
    return "\n".join(lines)


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.bench.attacks", description=__doc__)
    parser.add_argument("--minutes", type=float, default=5.0, help="for all of them (default 5)")
    parser.add_argument("--only", action="append", metavar="NAME", help="one; may be given again")
    parser.add_argument("--seed", type=int, default=1)
    given = parser.parse_args(arguments)
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    wanted = [attack for attack in attacks() if given.only is None or attack.name in given.only]
    if not wanted:
        parser.error("no such attack")
    attacked = []
    end_s = time.monotonic() + given.minutes * 60.0
    for number, attack in enumerate(wanted):
        left_s = max(0.0, end_s - time.monotonic())  # some take longer: the others have less
        outcome = tried(attack, left_s / (len(wanted) - number), given.seed)
        log.info("%s: %s %s: %s", attack.name, outcome.tried, attack.unit, outcome.happened)
        attacked.append((attack, outcome))
    print(report(attacked))  # noqa: T201
    return 0 if all(outcome.held for _, outcome in attacked) else 1


if __name__ == "__main__":
    end_children_at_sigterm()
    sys.exit(main())
