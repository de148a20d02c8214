"""How often a finger's sweep comes again in a stream."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from daemon.judge.health import PastSweeps
from drivers.twins.grasps.grasps import Counts

TABLES = ("palm_45", "palm_down", "palm_side")
UNTOUCHED = Path("untouched") / "untouched.csv"


def again(sweeps: Iterable[Counts]) -> tuple[int, int]:
    """How many sweeps there are, and in how many a finger comes again."""
    past = PastSweeps.none(3)
    found = [past.recurs(counts) for counts in sweeps]
    return len(found), sum(found)
