"""Raw Hall values of a palm packet -> joint angles, by the hand's own calibration.

Each joint has a table of (raw, degrees): linear between its points and, without clamping, beyond
them, as Shadow's driver does it. THJ5 and WRJ1 have two sensors whose raw values are averaged
first. THJ1 and THJ2 see each other's magnets: both angles come from both raw values, linear in the
triangles between points measured in pairs. J0 is the sum of J1 and J2 of a finger, which hang on
one tendon: one motor moves both, so the two also come on their own.

How tables are read from a file and checked: `drivers.palm.calibration`.
"""

from __future__ import annotations

import itertools
import math
from bisect import bisect_right
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from drivers.base import COUNT_MAX

HALL_SENSORS: Final = {
    **{
        f"{finger}J{joint}": (4 * at + joint - 1,)
        for at, finger in enumerate(("FF", "MF", "RF"))
        for joint in (1, 2, 3, 4)
    },
    **{f"LFJ{joint}": (11 + joint,) for joint in (1, 2, 3, 4, 5)},
    **{f"THJ{joint}": (16 + joint,) for joint in (1, 2, 3, 4)},
    "THJ5": (21, 22),
    "WRJ1": (23, 24),
    "WRJ2": (25,),
}
"""Words of `PalmPacket.sensors` by joint; two are averaged."""
COUPLED = ("THJ1", "THJ2")
"""The joints whose angles come from both raw values."""
SUMS: Final = {f"{finger}J0": (f"{finger}J1", f"{finger}J2") for finger in ("FF", "MF", "RF", "LF")}
JOINTS: Final = (*HALL_SENSORS, *SUMS)
"""All joints of a reading, in its order: 24 with sensors of their own, and the four J0."""

_FINGER_RANGES: Final = {0: (0, 180), 1: (0, 90), 2: (0, 90), 3: (-15, 90), 4: (-20, 20)}
RANGE_DEG: Final[Mapping[str, tuple[int, int]]] = {
    **{
        f"{finger}J{joint}": limits
        for finger in ("FF", "MF", "RF", "LF")
        for joint, limits in _FINGER_RANGES.items()
    },
    "LFJ5": (0, 45),
    "THJ1": (-15, 90),
    "THJ2": (-40, 40),
    "THJ3": (-12, 12),
    "THJ4": (0, 70),
    "THJ5": (-60, 60),
    "WRJ1": (-40, 28),
    "WRJ2": (-28, 10),
}
"""How far joints go, degrees (Shadow's documentation, ranges)."""
RANGE_MARGIN_DEG = 10
"""Beyond its range by more than this, degrees, an angle is impossible: not the hand's calibration,
or a broken sensor."""

Point = tuple[float, float]
"""(raw, degrees)."""
CoupledPoint = tuple[float, float, float, float]
"""(raw THJ1, raw THJ2, degrees THJ1, degrees THJ2)."""


class Table:
    """Raw -> radians by one table."""

    def __init__(self, points: Sequence[Point]) -> None:
        """Raises `ValueError` for fewer than two points, or two with the same raw value."""
        ordered = sorted(points)
        self._raws = [raw for raw, _ in ordered]
        self._slopes: list[float] = []
        self._offsets: list[float] = []
        if len(ordered) < 2 or len(set(self._raws)) < len(ordered):
            raise ValueError("a table needs two points or more, with different raw values")
        for (raw, degrees), (next_raw, next_degrees) in itertools.pairwise(ordered):
            slope = math.radians((next_degrees - degrees) / (next_raw - raw))
            self._slopes.append(slope)
            self._offsets.append(math.radians(degrees) - slope * raw)

    def angle_rad(self, raw: float) -> float:
        """Linear between the points, and beyond them by the first or last segment."""
        segment = bisect_right(self._raws, raw, 1, len(self._raws) - 1) - 1
        return self._slopes[segment] * raw + self._offsets[segment]


class CoupledTable:
    """A pair of raw values -> a pair of radians, linear in the triangles between measured pairs."""

    def __init__(self, points: Sequence[CoupledPoint]) -> None:
        """Raises `ValueError` if the raw pairs span no triangle."""
        table = np.array(points, dtype=np.float64)
        triangles = _delaunay(table[:, :2])
        if not len(triangles):
            raise ValueError("the raw pairs do not span a triangle")
        corners = np.concatenate([table[triangles, :2], np.ones((len(triangles), 3, 1))], axis=2)
        self._to_weights = np.linalg.inv(corners)
        """Shape (triangles, 3, 3): (raw 1, raw 2, 1) times this is the weights of the corners."""
        self._angles_rad = np.radians(table[triangles, 2:])

    def angles_rad(self, raw_1: float, raw_2: float) -> tuple[float, float]:
        """Both angles; outside all triangles, by the triangle that is least far away."""
        weights = np.array([raw_1, raw_2, 1.0]) @ self._to_weights
        nearest = int(np.argmax(weights.min(axis=1)))
        first, second = weights[nearest] @ self._angles_rad[nearest]
        return float(first), float(second)


@dataclass(frozen=True, slots=True, eq=False)
class JointCalibration:
    """What one hand's sensors mean. A joint without a table has no angle."""

    tables: Mapping[str, Table]
    coupled: CoupledTable | None = None

    def angles_rad(self, sensors: Sequence[int]) -> NDArray[np.float64]:
        """Angles of `JOINTS`, radians, from the words of a packet.

        NaN without a table, and where a raw value is not in 0..4095.
        """
        angles = dict.fromkeys(JOINTS, math.nan)
        for joint, table in self.tables.items():
            raw = _raw(sensors, HALL_SENSORS[joint])
            if raw is not None:
                angles[joint] = table.angle_rad(raw)
        if self.coupled is not None:
            raw_1, raw_2 = (_raw(sensors, HALL_SENSORS[joint]) for joint in COUPLED)
            if raw_1 is not None and raw_2 is not None:
                both = self.coupled.angles_rad(raw_1, raw_2)
                angles.update(zip(COUPLED, both, strict=True))
        for joint, (first, second) in SUMS.items():
            angles[joint] = angles[first] + angles[second]
        return np.array(list(angles.values()))


_LOW_RAD, _HIGH_RAD = (
    np.radians([RANGE_DEG[joint][side] + sign * RANGE_MARGIN_DEG for joint in JOINTS])
    for side, sign in ((0, -1), (1, 1))
)


def impossible_angles(position_rad: NDArray[np.float64]) -> int:
    """How many of the angles of `JOINTS`, radians, the joints cannot reach. NaN is none."""
    return int(((position_rad < _LOW_RAD) | (position_rad > _HIGH_RAD)).sum())


def _raw(sensors: Sequence[int], words: Sequence[int]) -> float | None:
    values = [sensors[word] for word in words]
    return None if max(values) > COUNT_MAX else sum(values) / len(values)


def _delaunay(points: NDArray[np.float64]) -> NDArray[np.intp]:
    """Triangles, shape (n, 3), whose circumcircle has no point inside; points has shape (p, 2).

    A calibration has 25 points, so all their triples may be tried. Four points on one circle give
    both pairs of triangles: either is right.
    """
    triples = np.array(list(itertools.combinations(range(len(points)), 3)), dtype=np.intp)
    a, b, c = (points[triples[:, corner]] for corner in range(3))
    edges = np.stack([b - a, c - a], axis=1)
    broad = np.abs(np.linalg.det(edges)) > 0.5  # twice the area, counts squared; 0 on one line
    triples, a, edges = triples[broad], a[broad], edges[broad]
    # The circle's centre is as far from the first corner as from the others.
    offset = np.linalg.solve(edges, (edges**2).sum(axis=2, keepdims=True) / 2)[:, :, 0]
    distance = np.linalg.norm(points - (a + offset)[:, None, :], axis=2)
    radius = np.linalg.norm(offset, axis=1, keepdims=True)
    empty = (distance > radius * (1.0 - 1e-9)).all(axis=1)
    found: NDArray[np.intp] = triples[empty]
    return found
