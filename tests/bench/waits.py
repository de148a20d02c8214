"""How late the loop's waits end, and what one costs: `python -m tests.bench.waits`."""

from __future__ import annotations

import os
import random
import selectors
import time
from collections.abc import Callable
from contextlib import closing

import numpy as np

from daemon.run.loop import Selector
from daemon.run.selector import ExactSelector
from tests.bench.live import table

DESCRIPTORS = 12
"""That a scene with sockets, joints and a page waits for."""
WAITS, LOOKS, TURNS = 500, 5000, 4
WAIT_NS = (200_000, 2_000_000)
"""From and to so long a wait, ns."""
KINDS: tuple[Callable[[], Selector], ...] = (selectors.SelectSelector, ExactSelector)


def measured(kind: Callable[[], Selector]) -> tuple[list[int], list[int]]:
    """By how much waits were too long, and how long it takes where something is ready, ns."""
    rng = random.Random(1)
    pipes = [os.pipe() for _ in range(DESCRIPTORS)]
    late_ns, took_ns = [], []
    with closing(kind()) as selector:
        for reads, _ in pipes:
            selector.register(reads, selectors.EVENT_READ)
        for _ in range(WAITS):
            wait_ns = rng.randrange(*WAIT_NS)
            began_ns = time.monotonic_ns()
            selector.select(wait_ns / 1e9)
            late_ns.append(time.monotonic_ns() - began_ns - wait_ns)
        os.write(pipes[0][1], b"x")
        for _ in range(LOOKS):
            began_ns = time.monotonic_ns()
            selector.select(0.01)
            took_ns.append(time.monotonic_ns() - began_ns)
    for ends in pipes:
        for end in ends:
            os.close(end)
    return late_ns, took_ns


def main() -> None:
    found: list[tuple[list[int], list[int]]] = [([], []) for _ in KINDS]
    for _ in range(TURNS):  # in turns, for the computer is not always the same
        for (late_ns, took_ns), kind in zip(found, KINDS, strict=True):
            more_late_ns, more_took_ns = measured(kind)
            late_ns += more_late_ns
            took_ns += more_took_ns
    rows = []
    for name, (late_ns, took_ns) in zip(("select(2)", "graspd's"), found, strict=True):
        late_us = np.percentile(late_ns, [0, 50, 99]) / 1e3
        rows.append([name, *(f"{each:.0f}" for each in late_us), f"{np.median(took_ns) / 1e3:.1f}"])
    head = ("waits by", "late: least, us", "p50", "p99", "ready, us")
    print(table(head, rows))  # noqa: T201


if __name__ == "__main__":
    main()
