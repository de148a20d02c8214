"""A held grasp that drifts to what the network calls slip."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from functools import cache

import numpy as np
from numpy.typing import NDArray

from graspd.drivers.twins.grasps.grasps import Counts
from graspd.drivers.twins.grasps.whole_grasps import synthetic_grasps
from graspd.models import zoo
from graspd.models.runtime import TactileModel
from tests.bench.live import HELD

MODEL = "cnn1"
"""What it says of counts depends on nothing else."""
SEED = 5
"""A synthetic grasp of which it says 0.3, and something else of counts nearby."""
SHAPE = (3, 24)
HELD_SWEEPS = 100
"""Of a hold, before the drift: time to be judged."""
DRIFT_SWEEPS = 500
DRIFT_COUNTS = 35.0
"""Of each electrode, at most: less than what makes it another grasp."""
STEP_COUNTS = 12.0


class Network:
    """The network, run directly."""

    def __init__(self) -> None:
        self._model = TactileModel(zoo.find(MODEL))

    def p_slip(self, counts: NDArray[np.generic]) -> float:
        """Of counts, shape (3, 24)."""
        self._model.inputs.build(counts, self._model.input)
        return self._model.run()[1]


@cache
def drift() -> NDArray[np.float64]:
    """Towards what the network calls slip, counts, shape (3, 24)."""
    grasp = synthetic_grasps(1, durations=HELD, seed=SEED)
    (timetable,) = grasp.timetables()
    settled = (moment.counts for moment in grasp if moment.t_s >= timetable.closed_s)
    base = np.median(list(itertools.islice(settled, HELD_SWEEPS, HELD_SWEEPS + 30)), axis=0)
    network, found = Network(), np.zeros(SHAPE)
    while network.p_slip(base + found) < 0.8 and np.abs(found).min() < DRIFT_COUNTS:
        for place in np.ndindex(SHAPE):
            one = np.zeros(SHAPE)
            one[place] = STEP_COUNTS
            up, down = (network.p_slip(base + found + step) for step in (one, -one))
            found[place] += STEP_COUNTS * np.sign(up - down)
        found = np.clip(found, -DRIFT_COUNTS, DRIFT_COUNTS)
    return found


def drifting() -> Iterator[Counts]:
    """Rest, a grasp that is held, drifts for some seconds, and stays there."""
    towards, held = drift(), 0
    grasp = synthetic_grasps(1, durations=HELD, seed=SEED)
    (timetable,) = grasp.timetables()
    for moment in grasp:
        held += timetable.closed_s <= moment.t_s < timetable.lift_s
        share = np.clip((held - HELD_SWEEPS) / DRIFT_SWEEPS, 0.0, 1.0)
        yield np.rint(moment.counts + share * towards).astype(np.uint16)
