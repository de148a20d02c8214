"""Synthetic grasps like those a model was trained on, to judge one before real readings come."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from random import Random

import numpy as np
from numpy.typing import NDArray

from graspd.daemon.judge.pipeline import Pipeline
from graspd.drivers.base import TactileReading
from graspd.models.contract import SeenCounts

PERIOD_NS = 10_000_000
"""Time between two readings, ns; 100 Hz, as the tare expects."""
REST = 110
"""Untouched readings before the first grasp; a tare takes 100."""
GRASP_EVERY, CLOSING, HELD = 65, 5, 45
"""Readings of a grasp in all, while it closes or opens, and while it is held."""
FALL_COUNTS = 150.0
"""An electrode falls by 0, 1, 2 or 3 times this in a typical grasp."""
COUNTS_MAX = 4000.0
"""Highest count of an electrode at rest, below saturation."""


def grasps(seen: SeenCounts, readings: int) -> Iterator[NDArray[np.uint16]]:
    """Yield counts (fingers, 24): a hand at rest, long enough to tare, then grasps."""
    # One standard deviation along each axis of the training: its very centre was never grasped.
    sides = 1.0 - 2.0 * (np.arange(np.size(seen.centre)) % 2)
    away = np.linalg.solve(seen.whitening_matrix().T, sides)
    typical = np.array(seen.centre) + away.reshape(np.shape(seen.centre))
    place_of = np.arange(typical.size).reshape(typical.shape)
    rest = np.minimum(typical + FALL_COUNTS * (place_of % 4), COUNTS_MAX)
    chance = Random(1)
    for number in range(REST + readings):
        place = (number - REST) % GRASP_EVERY
        far = min(place + 1, CLOSING, max(2 * CLOSING + HELD - 1 - place, 0)) / CLOSING
        touch = 0.0 if number < REST else far
        # No sweep may come again: that would be frozen. numpy's own chance takes megabytes.
        drawn = np.frombuffer(chance.randbytes(typical.size), dtype=np.uint8)
        noise = drawn.reshape(typical.shape) % 7 - 3.0
        yield (rest + touch * (typical - rest) + noise).astype(np.uint16)


def rehearse(make: Callable[[Callable[[], int]], Pipeline], seen: SeenCounts) -> Pipeline:
    """Judge a synthetic grasp; return the pipeline that `make` makes from a clock."""
    now_ns = 0
    pipeline = make(lambda: now_ns)
    for seq, counts in enumerate(grasps(seen, GRASP_EVERY)):
        now_ns = (seq + 1) * PERIOD_NS
        faults = np.zeros(counts.shape, dtype=np.uint8)
        pipeline.judge(TactileReading(t_ns=now_ns, seq=seq, counts=counts, faults=faults))
    return pipeline
