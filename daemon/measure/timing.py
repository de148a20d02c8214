"""Time steps in a hot loop and paced, one candidate after the other in every round."""

from __future__ import annotations

import gc
import time
from collections.abc import Callable, Mapping

import numpy as np

from graspd.daemon.process.text import progress

WARM_UP = 20
ROUNDS = 10
"""Rounds of the hot loop, so that a busy second spoils only one."""
PERIOD_S = 0.01
"""Time between paced readings, s. Other work in between makes caches cold."""
QUANTILES = {"p50": 0.5, "p99": 0.99, "p99.9": 0.999}

Step = Callable[[int], object]
"""Does the timed work for the reading of this number."""
Times = dict[str, float]
"""`hot_p50_us`, `paced_p99_us` and so on, and `cpu_percent_at_100_hz`, the share of a core."""


def measure(steps: Mapping[str, Step], readings: int, paced: int) -> dict[str, Times]:
    """Time each step on `readings` readings hot and `paced` readings at 100 Hz."""
    for step in steps.values():
        for index in range(WARM_UP):
            step(index)
    gc.disable()  # as timeit does
    try:
        hot = _hot(steps, readings // ROUNDS)
        cold, cpu = _paced(steps, paced)
    finally:
        gc.enable()
    return {name: _quantiles(hot[name], cold[name], cpu[name]) for name in steps}


def _hot(steps: Mapping[str, Step], readings: int) -> dict[str, list[int]]:
    """Wall time of readings right after each other, ns."""
    times: dict[str, list[int]] = {name: [] for name in steps}
    for done in range(ROUNDS):
        for name, step in steps.items():
            progress(f"one reading after the other, round {done + 1} of {ROUNDS}: {name}")
            for index in range(readings):
                began_ns = time.perf_counter_ns()
                step(index)
                times[name].append(time.perf_counter_ns() - began_ns)
    return times


def _paced(
    steps: Mapping[str, Step], readings: int
) -> tuple[dict[str, list[int]], dict[str, list[int]]]:
    """Wall and processor time of readings that are 10 ms apart, ns."""
    wall: dict[str, list[int]] = {name: [] for name in steps}
    cpu: dict[str, list[int]] = {name: [] for name in steps}
    due_s = time.perf_counter()
    for index in range(readings):
        progress(f"paced at 100 Hz: {index} of {readings} readings each")
        for name, step in steps.items():
            due_s += PERIOD_S
            time.sleep(max(due_s - time.perf_counter(), 0.0))
            used_ns, began_ns = time.thread_time_ns(), time.perf_counter_ns()
            step(index)
            wall[name].append(time.perf_counter_ns() - began_ns)
            cpu[name].append(time.thread_time_ns() - used_ns)
    return wall, cpu


def _quantiles(hot_ns: list[int], paced_ns: list[int], cpu_ns: list[int]) -> Times:
    times = {"cpu_percent_at_100_hz": float(np.mean(cpu_ns)) * 1e-9 / PERIOD_S * 100.0}
    for kind, values_ns in (("hot", hot_ns), ("paced", paced_ns)):
        for name, share in QUANTILES.items():
            times[f"{kind}_{name}_us"] = float(np.quantile(values_ns, share)) / 1e3
    return times
