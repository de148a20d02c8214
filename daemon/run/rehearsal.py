"""Judge a synthetic grasp before real readings come, so that the first one is not slow."""

from __future__ import annotations

from collections.abc import Iterator
from random import Random

import numpy as np
from numpy.typing import NDArray

from graspd.daemon.assembly import assembly
from graspd.daemon.assembly.plan import Plan
from graspd.daemon.judge.pipeline import Pipeline
from graspd.drivers.base import TactileReading
from graspd.models.contract import SeenCounts

PERIOD_NS = 10_000_000
"""Time between two readings, ns (100 Hz, as the tare expects)."""
REST = 110
"""Number of untouched readings before the first grasp; a tare takes 100."""
GRASP_EVERY, CLOSING, HELD = 65, 5, 45
"""Numbers of readings from one grasp to the next, of closing or opening, and of holding."""
FALL_COUNTS = 150.0
"""Unit of the fall of an electrode's count in a grasp; electrodes fall by 0 to 3 units."""
COUNTS_MAX = 4000.0
"""Highest count of an electrode at rest, below saturation."""


def grasps(training: SeenCounts, readings: int) -> Iterator[NDArray[np.uint16]]:
    """Yield counts, shape (fingers, 24): a rest to tare, then grasps like those of `training`.

    `readings`: number of readings after the rest.
    """
    # The grasp is one standard deviation off along each axis, as the centre is unlike any grasp.
    sides = 1.0 - 2.0 * (np.arange(np.size(training.centre)) % 2)
    away = np.linalg.solve(training.whitening_matrix().T, sides)
    typical = np.array(training.centre) + away.reshape(np.shape(training.centre))
    place_of = np.arange(typical.size).reshape(typical.shape)
    rest = np.minimum(typical + FALL_COUNTS * (place_of % 4), COUNTS_MAX)
    chance = Random(1)
    for index in range(REST + readings):
        place = (index - REST) % GRASP_EVERY
        far = min(place + 1, CLOSING, max(2 * CLOSING + HELD - 1 - place, 0)) / CLOSING
        touch = 0.0 if index < REST else far
        # No sweep may repeat, or it counts as frozen. numpy.random would take megabytes.
        drawn = np.frombuffer(chance.randbytes(typical.size), dtype=np.uint8)
        noise = drawn.reshape(typical.shape) % 7 - 3.0
        yield (rest + touch * (typical - rest) + noise).astype(np.uint16)


def rehearse(plan: Plan) -> Pipeline:
    """Judge a synthetic grasp; return the pipeline used. Raises `ModelError`.

    It loads a model of its own, because judging changes the scaling of a model's inputs.
    """
    now_ns = 0
    model = assembly.load_model(plan.scene)
    pipeline = assembly.build_pipeline(plan, model, lambda: now_ns)
    for seq, counts in enumerate(grasps(model.contract.seen, GRASP_EVERY)):
        now_ns = (seq + 1) * PERIOD_NS
        faults = np.zeros(counts.shape, dtype=np.uint8)
        pipeline.judge(TactileReading(t_ns=now_ns, seq=seq, counts=counts, faults=faults))
    return pipeline
