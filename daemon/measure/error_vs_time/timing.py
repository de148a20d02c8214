"""How long things take: in a hot loop and paced, one candidate after the other in every round."""

from __future__ import annotations

import gc
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from daemon.process.text import progress

WARM_UP = 20
ROUNDS = 10
"""Of the hot loop: a machine that is busy for a second spoils a round of all, not all of one."""
PERIOD_S = 0.01
"""Of the paced readings: 100 Hz."""
PROGRESS_EVERY = 10
"""Paced readings between two words of how far it is."""
BANDWIDTH_BYTES = 64 << 20
BANDWIDTH_ROUNDS = 15

Step = Callable[[int], object]
"""Does what is timed for the reading of this number."""


@dataclass(frozen=True, slots=True, eq=False)
class Times:
    """What one candidate took."""

    hot_us: NDArray[np.float64]
    """Per reading, one right after the other, us."""
    paced_us: NDArray[np.float64]
    """Per reading, 10 ms apart with other work in between, so that caches are cold, us."""
    cpu_us: float
    """Processor time of a paced reading, us, mean."""

    def quantiles(self) -> dict[str, float]:
        """p50, p99 and p99.9 of both, us, and the share of a core at 100 Hz, %."""
        found = {}
        for name, values in (("hot", self.hot_us), ("paced", self.paced_us)):
            for label, share in (("p50", 0.5), ("p99", 0.99), ("p99.9", 0.999)):
                found[f"{name}_{label}_us"] = float(np.quantile(values, share))
        found["cpu_percent_at_100_hz"] = self.cpu_us * 1e-6 / PERIOD_S * 100.0
        return found


def measure(steps: Mapping[str, Step], readings: int, paced: int) -> dict[str, Times]:
    """Time each step on `readings` readings hot and `paced` readings at 100 Hz."""
    for step in steps.values():
        for index in range(WARM_UP):
            step(index)
    hot: dict[str, list[float]] = {name: [] for name in steps}
    with _no_collection():
        for done in range(ROUNDS):
            for name, step in steps.items():
                progress(f"one reading after the other, round {done + 1} of {ROUNDS}: {name}")
                hot[name] += _timed(step, readings // ROUNDS)
        cold, cpu = _paced(steps, paced)
    return {
        name: Times(np.array(hot[name]), np.array(cold[name]), float(np.mean(cpu[name])))
        for name in steps
    }


def _timed(step: Step, readings: int) -> Iterator[float]:
    for index in range(readings):
        began_ns = time.perf_counter_ns()
        step(index)
        yield (time.perf_counter_ns() - began_ns) / 1e3


def _paced(
    steps: Mapping[str, Step], readings: int
) -> tuple[dict[str, list[float]], dict[str, list[float]]]:
    wall: dict[str, list[float]] = {name: [] for name in steps}
    cpu: dict[str, list[float]] = {name: [] for name in steps}
    due_s = time.perf_counter()
    for index in range(readings):
        if index % PROGRESS_EVERY == 0:
            progress(f"paced at 100 Hz: {index} of {readings} readings each")
        for name, step in steps.items():
            due_s += PERIOD_S
            time.sleep(max(due_s - time.perf_counter(), 0.0))
            used_ns, began_ns = time.thread_time_ns(), time.perf_counter_ns()
            step(index)
            wall[name].append((time.perf_counter_ns() - began_ns) / 1e3)
            cpu[name].append((time.thread_time_ns() - used_ns) / 1e3)
    return wall, cpu


def bandwidth_bytes_per_s() -> float:
    """How fast one core reads memory that is in no cache: the best of several sums."""
    data = np.ones(BANDWIDTH_BYTES // 8)
    best_s = np.inf
    for _ in range(BANDWIDTH_ROUNDS):
        began_s = time.perf_counter()
        data.sum()
        best_s = min(best_s, time.perf_counter() - began_s)
    return BANDWIDTH_BYTES / best_s


@contextmanager
def _no_collection() -> Iterator[None]:
    """No garbage collection meanwhile, as `timeit` does it."""
    was_on = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was_on:
            gc.enable()
