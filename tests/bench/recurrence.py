"""How often a finger's sweep comes again in a stream."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np

from graspd.daemon.judge.health import Health
from graspd.daemon.judge.reasons import Reason
from graspd.drivers.base import TactileReading
from graspd.drivers.twins.grasps.grasps import Counts

TABLES = ("palm_45", "palm_down", "palm_side")
UNTOUCHED = Path("untouched") / "untouched.csv"


def again(sweeps: Iterable[Counts]) -> tuple[int, int]:
    """Return the number of sweeps, and of those in which a finger comes again."""
    health, faults = Health(3), np.zeros((3, 24), dtype=np.uint8)
    readings = [TactileReading(place, place, counts, faults) for place, counts in enumerate(sweeps)]
    frozen = [Reason.FROZEN in health.check(reading).reasons for reading in readings]
    return len(frozen), sum(frozen)
