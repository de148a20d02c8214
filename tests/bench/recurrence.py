"""How often a finger's sweep comes again by chance, in real recordings and with measured noise.

`python -m tests.bench.recurrence DIR` prints a table; DIR is the folder that holds `bts3/` and
`untouched/`. The grasps of the tables are played with the noise of real sensors between them.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterable, Iterator
from pathlib import Path

import numpy as np

from daemon.judge.health import PastSweeps
from daemon.process.text import markdown_table
from drivers.twins.grasps.grasps import Counts, recorded_counts
from drivers.twins.grasps.whole_grasps import (
    PALM_RATE_HZ,
    RATE_HZ,
    Sampling,
    WholeGrasps,
    read_end_points,
    rest_above,
)

TABLES = ("palm_45", "palm_down", "palm_side")
UNTOUCHED = Path("untouched") / "untouched.csv"
GRASPS = 150
"""Of each table that are played with noise."""
HEAD = (
    "stream",
    "sweeps of three fingers",
    "said to come again",
    "electrodes equal in two at most",
)


def again(sweeps: Iterable[Counts]) -> tuple[int, int]:
    """How many sweeps there are, and in how many a finger comes again."""
    past = PastSweeps.none(3)
    found = [past.recurs(counts) for counts in sweeps]
    return len(found), sum(found)


def most_equal(sweeps: Iterable[Counts]) -> int:
    """Electrodes of a finger that are equal in any two of its sweeps, at most."""
    counts = np.array(list(sweeps))
    return max(
        int((counts[apart:] == counts[:-apart]).sum(axis=2).max())
        for apart in range(1, len(counts))
    )


def with_noise(table: Path, rate_hz: float, sampling: Sampling) -> Iterator[Counts]:
    """Its first grasps as a stream."""
    ends = read_end_points(table)
    rest = rest_above(np.array([end.counts for end in ends]))
    stream = WholeGrasps(rest, ends[:GRASPS], rate_hz=rate_hz, sampling=sampling, seed=1)
    return (moment.counts for moment in stream)


def rows(data: Path) -> Iterator[tuple[str, ...]]:
    """Of the table that is printed."""
    tables = [data / "bts3" / f"{name}.csv" for name in TABLES]
    for name, path in (("untouched, 100 Hz", data / UNTOUCHED), *zip(TABLES, tables, strict=True)):
        sweeps = list(recorded_counts(path))
        yield name, *map(str, again(sweeps)), str(most_equal(sweeps))
    for rate_hz, sampling in (
        (PALM_RATE_HZ, Sampling.FRESH),
        (RATE_HZ, Sampling.FRESH),
        (RATE_HZ, Sampling.HELD),
    ):
        found = np.sum([again(with_noise(path, rate_hz, sampling)) for path in tables], axis=0)
        yield f"grasps with noise, {rate_hz:.0f} Hz, {sampling}", *map(str, found.tolist()), "-"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("data", type=Path, metavar="DIR")
    given = parser.parse_args()
    sys.stdout.write("\n".join(markdown_table(HEAD, list(rows(given.data)))) + "\n")


if __name__ == "__main__":
    main()
