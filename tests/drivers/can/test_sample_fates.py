"""What becomes of a sample is what the table of `deploy/can/PROTOCOL.md` says."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from pathlib import Path

from graspd.drivers.can.samples import Fate, Held, classify
from graspd.drivers.can.sweep_clock import Timing

PAGE = Path(__file__).parents[3] / "deploy" / "can" / "PROTOCOL.md"
PLACES: dict[str, Callable[[int, int], bool]] = {
    "any": lambda _place, _last: True,
    "ahead": lambda place, last: place > last,
    "back": lambda place, last: last - 3 <= place <= last,
    "far back": lambda place, last: place < last - 3,
    "jump": lambda place, last: place in (21, 22, 23) and last in (0, 1, 2),
}
"""Words of the page, as it says below the table; places and the furthest one from 0."""
OUT = ", reading has ended"
TIMES = {"any": set(Timing), "late": {Timing.LATE}, "early": {Timing.EARLY}}
HELD = {
    "any": set(Held),
    "nothing": {Held.NOTHING},
    "the same words": {Held.SAME},
    "other words": {Held.OTHER},
}
FATES = {
    "begins another sweep": Fate.BEGINS,
    "takes it": Fate.PLACED,
    "drops it: `duplicate_frames`": Fate.COPY,
    "drops it: `late_frames`": Fate.LATE,
    "puts it in its place: `reordered_frames`": Fate.REORDERED,
}


def rows() -> list[list[str]]:
    table = PAGE.read_text().partition("| electrode | time |")[2].partition("\n\n")[0]
    return [[cell.strip() for cell in line.split("|")[1:-1]] for line in table.splitlines()[2:]]


def test_the_first_row_of_the_page_that_fits_decides() -> None:
    used, table = set(), rows()
    for place, last, timing, held, is_over in itertools.product(
        range(24), range(-1, 24), Timing, Held, (False, True)
    ):
        row = next(
            (electrode, time, has, what)
            for electrode, time, has, what in table
            if PLACES[electrode.removesuffix(OUT)](place, last)
            and (is_over or not electrode.endswith(OUT))
            and timing in TIMES[time]
            and held in HELD[has]
        )
        used.add(row)
        assert classify(place, last, timing, held, is_over=is_over) is FATES[row[3]]
    assert len(used) == len(table)
