"""Messages of counts, and what a network and a sender may do to them."""

from __future__ import annotations

import json
from collections.abc import Callable

from hypothesis import strategies as st

from graspd.drivers.udp import Datagram

PERIOD_NS = 10_000_000
FINGERS = ("ff", "mf", "th")
COUNTS = list(range(2000, 2024))
HERE = ("127.0.0.1", 7)
START_S = 70.0
ACTIONS = ("send", "lose", "copy", "late", "stall", "stale")
"""What becomes of a sweep. `late`: others overtake it; `stall`: those behind it wait as well;
`stale`: the topic repeats the time of the one before."""
Plan = list[tuple[str, int]]
"""For each sweep an action, and for how many periods it is held back."""


def message(counts: object = None, **fields: object) -> bytes:
    """A datagram with counts of three fingers, and number 1, unless told otherwise."""
    whole = {"seq": 1, "counts": dict.fromkeys(FINGERS, COUNTS) if counts is None else counts}
    return json.dumps({**whole, **fields}).encode()


@st.composite
def links(draw: st.DrawFn) -> Plan:
    """Draw a plan; the first sweep comes at once."""
    action = st.tuples(st.sampled_from(ACTIONS), st.integers(1, 20))
    runs = draw(st.lists(st.tuples(action, st.integers(1, 12)), min_size=1, max_size=15))
    return [("send", 0), *(each for each, times in runs for _ in range(times))]


def arrivals(
    plan: Plan, counts: Callable[[int], list[list[int]]]
) -> list[tuple[int, Datagram, int]]:
    """Return reception in ns, datagram and place of its sweep, one sweep every 10 ms.

    `counts`: of a sweep, by finger.
    """
    found: list[tuple[int, Datagram, int]] = []
    held_until = 0
    for place, (action, periods) in enumerate(plan):
        good = dict(zip(FINGERS, counts(place), strict=True))
        now, time_s = max(place, held_until), START_S + place / 100
        if action == "stall":
            now = held_until = max(held_until, place + periods)
        if action == "stale":
            time_s -= 0.01
        elif action == "late":
            now += periods
        datagram = Datagram(message(good, seq=place, t=time_s), 0, HERE)
        if action != "lose":
            found.append((now, datagram, place))
        if action == "copy":
            found.append((now + periods, datagram, place))
    found.sort(key=lambda each: each[0])  # those of one time stay in their order
    return [(PERIOD_NS * periods, datagram, place) for periods, datagram, place in found]
