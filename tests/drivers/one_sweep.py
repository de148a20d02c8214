"""Sweeps whose counts give their number, and what happens to them between a board and a driver.

A reading that mixes two sweeps, or moves a count to another electrode, shows two numbers.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from hypothesis import strategies as st
from numpy.typing import NDArray

from graspd.biotac import ELECTRODES
from graspd.drivers.base import Reading, TactileReading

FIRST, NUMBERS = 50, 4000
"""The lowest count, and how many sweeps there are before a count comes again."""
FINGERS: Final = 3
_PLACES = 53 * np.random.default_rng(1).permutation(FINGERS * ELECTRODES)
"""Each electrode's own part of its count."""


def counts_of(number: int) -> NDArray[np.uint16]:
    """Counts of a sweep, shape (3, 24): no two electrodes agree."""
    return (FIRST + (number + _PLACES) % NUMBERS).astype(np.uint16).reshape(FINGERS, ELECTRODES)


def sweeps_of(number: int) -> list[NDArray[np.uint16]]:
    """Counts of the first `number` sweeps."""
    return [counts_of(each) for each in range(number)]


def number_in(reading: TactileReading) -> int | None:
    """The number of a reading's sweep; None if all counts are flagged. Fails for two numbers."""
    sound = reading.faults == 0
    assert not reading.counts[~sound].any(), "a flagged electrode has a count"
    places = _PLACES.reshape(sound.shape)[sound]
    numbers = {int(number) for number in (reading.counts[sound] - FIRST - places) % NUMBERS}
    assert len(numbers) <= 1, f"mixes the sweeps {sorted(numbers)}"
    return numbers.pop() if numbers else None


def tactile(readings: Iterable[Reading]) -> list[TactileReading]:
    return [reading for reading in readings if isinstance(reading, TactileReading)]


@dataclass(frozen=True)
class Step:
    """What happens to the next units of a board."""

    what: str
    """`send`; `lose`; `again`: the last ones come once more; `late`: each comes after a later one;
    `stall`: the board pauses; `restart`: it begins again, with all its counters."""
    units: int
    """Number of frames, packets or samples; for a stall, its length as the time of that number."""


def plans(sweep: int, steady_sweeps: int = 1) -> st.SearchStrategy[list[Step]]:
    """Plans for a board with `sweep` units in a sweep, the first `steady_sweeps` undisturbed.

    Losses are often of whole sweeps, or nearly: the next unit then has the expected electrodes,
    but of another sweep.
    """
    some = st.integers(1, 2 * sweep)
    whole = st.integers(1, 4).map(lambda sweeps: sweep * sweeps)
    nearly = st.builds(int.__add__, whole, st.integers(1 - min(sweep, 3), 2))
    few = st.integers(1, 3)
    kinds = {
        "send": st.one_of(some, whole),
        "lose": st.one_of(some, whole, nearly),
        "again": few,
        "late": few,
        "stall": st.one_of(some, whole),
        "restart": few,
    }
    steps = {what: st.builds(Step, st.just(what), units) for what, units in kinds.items()}
    any_step = st.one_of(steps["send"], steps["lose"], *steps.values())
    # Whole sweeps come and are lost in turns: they look like a board that is slower.
    sweeps = st.builds(Step, st.just("send"), st.sampled_from([sweep, sweep, 2 * sweep]))
    lost = st.builds(Step, st.just("lose"), whole)
    in_turns = st.lists(st.tuples(sweeps, lost), max_size=20).map(lambda both: sum(both, ()))
    torn = st.lists(st.tuples(steps["send"], lost), max_size=8).map(lambda both: sum(both, ()))
    first = Step("send", steady_sweeps * sweep)
    return st.builds(
        lambda *parts: [first, *itertools.chain(*parts)],
        in_turns,
        torn,
        st.lists(any_step, min_size=5, max_size=50),
    )


def losses(sweep: int) -> st.SearchStrategy[list[Step]]:
    """Plans that lose and repeat units only, after eight undisturbed sweeps.

    Too few are lost in a row for the link to count as down.
    """
    some = st.integers(1, 2 * sweep)
    whole = st.integers(1, 6).map(lambda sweeps: sweep * sweeps)
    send, lose = (
        st.builds(Step, st.just(what), st.one_of(some, whole)) for what in ("send", "lose")
    )
    part = st.one_of(
        send.map(lambda step: [step]),
        st.tuples(lose, send).map(list),
        st.just([Step("again", 1)]),
    )
    steady = Step("send", 8 * sweep)
    return st.lists(part, min_size=1, max_size=14).map(
        lambda parts: [steady, *itertools.chain(*parts), steady]
    )


@dataclass(frozen=True)
class Unit:
    """A frame, packet or sample as it comes to the host."""

    at: int
    """When it comes, in units since the board's first start."""
    index: int
    """Number of the unit since the board's last start, from 0; lost ones count."""
    boot: int
    """Number of that start, from 0."""


def arrivals(plan: Sequence[Step], silent: int, late_max: int = 3) -> Iterator[Unit]:
    """Units in the order in which they come.

    A board that begins again is silent for `silent` units first. A late or repeated unit that would
    come more than `late_max` units after it was sent never comes.
    """
    at = index = boot = 0
    recent: list[Unit] = []
    held: list[Unit] = []
    for step in plan:
        if step.what == "again":
            again = [each for each in recent[-step.units :] if at - each.at <= late_max]
            yield from (replace(each, at=at) for each in again)
        elif step.what == "stall":
            at += step.units
        elif step.what == "restart":
            at, index, boot = at + silent, 0, boot + 1
        for _ in range(step.units if step.what in ("send", "lose", "late") else 0):
            unit = Unit(at, index, boot)
            at, index = at + 1, index + 1
            held = [each for each in held if unit.at - each.at <= late_max]
            if step.what == "late":
                held.append(unit)
            elif step.what == "send":
                yield unit
                recent = [*recent[-late_max:], unit]
                yield from (replace(each, at=unit.at) for each in held[:1])
                del held[:1]
