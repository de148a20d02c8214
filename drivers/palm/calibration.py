"""A hand's calibration: convert raw Hall values of a palm packet to joint angles.

A calibration file is TOML, as `deploy/calibration/example_hand.toml`. `[joints]` has points of
[raw, degrees] for each joint, 2 to 64 in any order. If a joint has two sensors, as THJ5 does, raw
is their mean.
`[coupled]` has THJ1_THJ2, points of [raw THJ1, raw THJ2, degrees, degrees]; it is optional, but
without it THJ1 and THJ2 have no angle.

Tables are linear between their points, and continue in a straight line beyond them, as in Shadow's
driver. The sensors of THJ1 and THJ2 see each other's magnets, so both angles come from both raw
values. J0 of a finger is the sum of J1 and J2, which one motor moves. A joint that is left out has
no angle (NaN).

One mistake refuses the whole file. Files shipped with hands have had these: a digit too many, zeros
for joints that were not measured, tables that first rise and then fall.
"""

from __future__ import annotations

import itertools
import math
from bisect import bisect_right
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from operator import itemgetter
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from graspd.biotac import COUNT_MAX
from graspd.drivers import toml
from graspd.drivers.base import JOINTS, DriverError

HALL_SENSORS: Final = {
    **{joint: (word,) for word, joint in enumerate(JOINTS[:21])},
    "THJ5": (21, 22),
    "WRJ1": (23, 24),
    "WRJ2": (25,),
}
"""Indices in `PalmPacket.sensors` of each joint's sensors; of two the mean is used."""
COUPLED = ("THJ1", "THJ2")
"""Joints whose angles come from the raw values of both."""
SUMS: Final = {f"{finger}J0": (f"{finger}J1", f"{finger}J2") for finger in ("FF", "MF", "RF", "LF")}

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
"""Lowest and highest angle of each joint, degrees (Shadow's documentation, ranges)."""
RANGE_MARGIN_DEG = 10
"""Degrees beyond a joint's range from which on calibration or sensor must be wrong."""

VERSION = 1
COUPLED_KEY = "THJ1_THJ2"
FILE_BYTES_MAX = 256 * 1024
"""Largest calibration file, bytes; a full one has 4 kB."""
POINTS_MIN, POINTS_MAX = 2, 64
"""Fewest and most points of a table; Shadow's own have 2 to 9."""
COUPLED_POINTS_MIN, COUPLED_POINTS_MAX = 3, 49
"""Fewest and most points of the coupled table; Shadow's own has 25, five by five."""
SLOPE_MAX_DEG = 0.5
"""Steepest allowed segment, degrees per count; usual are 0.03 to 0.1."""

SHEAR: Final = np.array([[1.0, 1e-5], [0.0, 1.0 + 1.618e-5]])
"""Shear of raw pairs after which no square has its corners on one circle. A square could be cut in
two ways, and the angles would jump from one to the other."""

Points = Sequence[Sequence[float]]
"""Rows of (raw, degrees), or of (raw THJ1, raw THJ2, degrees THJ1, degrees THJ2)."""


class Table:
    """Convert one raw value to radians."""

    def __init__(self, points: Points) -> None:
        """`points`: two or more, checked by `parse_calibration`."""
        ordered = sorted(points, key=itemgetter(0))
        self._raws = [raw for raw, _ in ordered]
        self._slopes: list[float] = []
        self._offsets: list[float] = []
        for (raw, degrees), (next_raw, next_degrees) in itertools.pairwise(ordered):
            slope = math.radians((next_degrees - degrees) / (next_raw - raw))
            self._slopes.append(slope)
            self._offsets.append(math.radians(degrees) - slope * raw)

    def angle_rad(self, raw: float) -> float:
        segment = bisect_right(self._raws, raw, 1, len(self._raws) - 1) - 1
        return self._slopes[segment] * raw + self._offsets[segment]


class CoupledTable:
    """Convert two raw values to two angles, linear between measured pairs."""

    def __init__(self, points: Points) -> None:
        """Raises `ValueError` if all raw pairs lie on one line."""
        table = np.array(points, dtype=np.float64)
        triangles = _delaunay(table[:, :2])
        if not len(triangles):
            raise ValueError("the raw pairs do not span a triangle")
        corners = np.concatenate([table[triangles, :2], np.ones((len(triangles), 3, 1))], axis=2)
        self._to_weights = np.linalg.inv(corners)
        """Shape (triangles, 3, 3); (raw 1, raw 2, 1) times it gives the weights of the corners."""
        self._angles_rad = np.radians(table[triangles, 2:])

    def angles_rad(self, raw_1: float, raw_2: float) -> tuple[float, float]:
        """Return both angles, radians; outside all triangles the nearest one is extended."""
        weights = np.array([raw_1, raw_2, 1.0]) @ self._to_weights
        nearest = int(np.argmax(weights.min(axis=1)))
        first, second = weights[nearest] @ self._angles_rad[nearest]
        return float(first), float(second)


@dataclass(frozen=True, slots=True, eq=False)
class JointCalibration:
    """Tables of all joints of one hand."""

    tables: Mapping[str, Table]
    coupled: CoupledTable | None = None

    def angles_rad(self, sensors: Sequence[int]) -> NDArray[np.float64]:
        """Return the angles of `JOINTS`, radians; NaN without a table or a valid raw value.

        `sensors`: as in `PalmPacket`.
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
    """Return how many angles, in the order of `JOINTS`, are more than `RANGE_MARGIN_DEG` out of
    their range; NaN does not count."""
    return int(((position_rad < _LOW_RAD) | (position_rad > _HIGH_RAD)).sum())


def _raw(sensors: Sequence[int], words: Sequence[int]) -> float | None:
    values = [sensors[word] for word in words]
    return None if max(values) > COUNT_MAX else sum(values) / len(values)


def _delaunay(points: NDArray[np.float64]) -> NDArray[np.intp]:
    """Return the triangles, shape (n, 3), whose circumcircle has no point inside.

    `points`: shape (p, 2). `SHEAR` decides between the triangles of four points on one circle.
    """
    points = points @ SHEAR
    triples = np.array(list(itertools.combinations(range(len(points)), 3)), dtype=np.intp)
    a, b, c = (points[triples[:, corner]] for corner in range(3))
    edges = np.stack([b - a, c - a], axis=1)
    broad = np.abs(np.linalg.det(edges)) > 0.5  # twice the area; 0 on a line
    triples, a, edges = triples[broad], a[broad], edges[broad]
    # The circle's centre is equally far from all three corners.
    offset = np.linalg.solve(edges, (edges**2).sum(axis=2, keepdims=True) / 2)[:, :, 0]
    distance = np.linalg.norm(points - (a + offset)[:, None, :], axis=2)
    radius = np.linalg.norm(offset, axis=1, keepdims=True)
    empty = (distance > radius * (1.0 - 1e-9)).all(axis=1)
    triangles: NDArray[np.intp] = triples[empty]
    return triangles


class CalibrationError(DriverError):
    """A calibration file cannot be used. The message has one line per mistake."""

    def __init__(self, path: Path, problems: Sequence[str]) -> None:
        super().__init__("\n".join(f"{path}: {problem}" for problem in problems))


def load_calibration(path: Path) -> JointCalibration:
    """Read a calibration file. Raises `CalibrationError`."""
    try:
        with path.open("rb") as file:
            content = file.read(FILE_BYTES_MAX + 1)
    except OSError as error:
        raise CalibrationError(path, [f"cannot be read: {error.strerror}"]) from error
    if len(content) > FILE_BYTES_MAX:
        raise CalibrationError(path, [f"is longer than {FILE_BYTES_MAX} bytes"])
    try:
        return parse_calibration(toml.loads(content.decode()), path)
    except ValueError as error:  # also for bytes that are not UTF-8, and for very long numbers
        raise CalibrationError(path, [f"is not TOML: {error}"]) from error


def parse_calibration(data: Mapping[str, Any], path: Path) -> JointCalibration:
    """Check and convert the content of a file. Raises `CalibrationError`, which names `path`."""
    problems = list(dict.fromkeys(_problems(data)))
    if problems:
        raise CalibrationError(path, problems)
    tables = {joint: Table(points) for joint, points in data.get("joints", {}).items()}
    coupled = data.get("coupled", {}).get(COUPLED_KEY)
    return JointCalibration(tables, None if coupled is None else CoupledTable(coupled))


def _problems(data: Mapping[str, Any]) -> Iterator[str]:
    if data.get("version") != VERSION or isinstance(data.get("version"), bool):
        yield f"version is {data.get('version')!r}, must be {VERSION}"
    for key in data:
        if key not in ("version", "hand", "joints", "coupled"):
            yield f"{key}: no such key; there are: version, hand, joints, coupled"
    joints, coupled = data.get("joints", {}), data.get("coupled", {})
    for name, section in (("joints", joints), ("coupled", coupled)):
        if not isinstance(section, dict):
            yield f"{name}: must be a table of TOML"
            return
    if not joints and not coupled:
        yield "joints: is empty"
    for joint, rows in joints.items():
        yield from (f"{joint}: {problem}" for problem in _joint_problems(joint, rows))
    for key, rows in coupled.items():
        if key == COUPLED_KEY:
            yield from (f"{key}: {problem}" for problem in _coupled_problems(rows))
        else:
            yield f"{key}: no such key; there is: {COUPLED_KEY}"


def _joint_problems(joint: str, rows: object) -> Iterator[str]:
    if joint in COUPLED:
        yield f"depends on two sensors; its points stand in [coupled] under {COUPLED_KEY}"
    elif joint in SUMS:
        yield f"is the sum of {' and '.join(SUMS[joint])} and has no sensor of its own"
    elif joint not in HALL_SENSORS:
        yield f"no such joint; there are: {', '.join(HALL_SENSORS)}"
    else:
        shape = list(_shape_problems(rows, 2, POINTS_MIN, POINTS_MAX))
        yield from shape
        if not shape and isinstance(rows, list):
            points = sorted(rows)
            degrees = [point[1] for point in points]
            yield from _raw_problems([raw for raw, _ in points])
            yield from _degree_problems(joint, degrees)
            yield from _steepness_problems(itertools.pairwise(points))
            steps = [later - former for former, later in itertools.pairwise(degrees)]
            if not (all(step > 0 for step in steps) or all(step < 0 for step in steps)):
                yield "is not monotone: degrees must only rise or only fall with raw"


def _coupled_problems(rows: object) -> Iterator[str]:
    shape = list(_shape_problems(rows, 4, COUPLED_POINTS_MIN, COUPLED_POINTS_MAX))
    yield from shape
    if shape or not isinstance(rows, list):
        return
    problems = list(_raw_problems([raw for point in rows for raw in point[:2]]))
    for at, joint in enumerate(COUPLED):
        problems += [
            f"{joint}: {problem}"
            for problem in _degree_problems(joint, [point[2 + at] for point in rows])
        ]
    problems += _steepness_problems(itertools.combinations(rows, 2))
    yield from problems
    if not problems:
        try:
            CoupledTable(rows)
        except ValueError as error:
            yield str(error)


def _shape_problems(rows: object, width: int, least: int, most: int) -> Iterator[str]:
    if not isinstance(rows, list) or not all(
        isinstance(row, list) and len(row) == width and all(map(_is_number, row)) for row in rows
    ):
        yield f"must be a list of points of {width} numbers each"
    elif not least <= len(rows) <= most:
        yield f"has {len(rows)} points, must have {least} to {most}"


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and -1e9 < value < 1e9


def _raw_problems(raws: Sequence[float]) -> Iterator[str]:
    for raw in raws:
        if raw == 0:
            yield "raw 0 is a placeholder, not a measured value"
        elif not 0 < raw <= COUNT_MAX:
            yield f"raw {raw} is not in 1..{COUNT_MAX}"


def _degree_problems(joint: str, degrees: Sequence[float]) -> Iterator[str]:
    low, high = RANGE_DEG[joint]
    for angle in degrees:
        if not low - RANGE_MARGIN_DEG <= angle <= high + RANGE_MARGIN_DEG:
            yield f"{angle} degrees is out of reach, the joint goes from {low} to {high}"


def _steepness_problems(pairs: Iterable[tuple[Sequence[float], Sequence[float]]]) -> Iterator[str]:
    """Yield mistakes for pairs of points with too steep a slope. The first half of a point is raw
    values, the second half angles in degrees."""
    for first, second in pairs:
        half = len(first) // 2
        distance = math.dist(first[:half], second[:half])
        turn = max(abs(one - other) for one, other in zip(first[half:], second[half:], strict=True))
        place, end = (", ".join(map(str, point[:half])) for point in (first, second))
        if distance == 0:
            yield f"raw {place} stands twice"
        elif turn / distance > SLOPE_MAX_DEG:
            slope = f"{turn / distance:.2f} degrees per count from raw {place} to {end}"
            yield f"{slope} is steeper than {SLOPE_MAX_DEG}"
