"""The calibration file of a hand: read and checked, so that a slip of the pen is not an angle.

    version = 1
    hand = "378"                       # for people

    [joints]                           # [raw, degrees], 2 to 64 points, any order
    FFJ1 = [[3109, 0.0], [2673, 22.5], [1942, 45.0], [1247, 67.5], [649, 90.0]]
    THJ5 = [[3633, -60.0], [1063, 60.0]]   # raw is the mean of THJ5A and THJ5B; WRJ1 alike

    [coupled]                          # optional; without it THJ1 and THJ2 have no angle
    THJ1_THJ2 = [[2132, 2294, 0.0, -20.0], ...]   # [raw THJ1, raw THJ2, degrees, degrees]

A joint that is left out has no angle (NaN). A mistake anywhere refuses the whole file. Files that
hands were shipped with hold the very mistakes that are looked for: raw values with a digit too
many, zeros where nobody measured, tables that turn back.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from drivers import toml
from drivers.base import COUNT_MAX, DriverError
from drivers.palm.hall import (
    COUPLED,
    HALL_SENSORS,
    RANGE_DEG,
    RANGE_MARGIN_DEG,
    SUMS,
    CoupledPoint,
    CoupledTable,
    JointCalibration,
    Point,
    Table,
)

VERSION = 1
COUPLED_KEY = "THJ1_THJ2"
FILE_BYTES_MAX = 256 * 1024
"""A full file has 4 kB."""
POINTS_MIN, POINTS_MAX = 2, 64
"""Points of a table; Shadow's own have 2 to 9."""
COUPLED_POINTS_MIN, COUPLED_POINTS_MAX = 3, 49
"""Points of the coupled table; Shadow's own has 25, five by five."""
SLOPE_MAX_DEG = 0.5
"""Degrees per count from which a segment is too steep: a sensor's noise of one count would move
the joint by as much. Usual are 0.03 to 0.1."""


class CalibrationError(DriverError):
    """The calibration cannot be used: mend the file. The message has one line per mistake."""

    def __init__(self, path: Path, problems: Sequence[str]) -> None:
        super().__init__("\n".join(f"{path}: {problem}" for problem in problems))
        self.path = path
        self.problems = tuple(problems)
        """Without the path; those of a joint begin with its name."""


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
    except ValueError as error:  # no UTF-8 and long numbers too
        raise CalibrationError(path, [f"is not TOML: {error}"]) from error


def parse_calibration(data: Mapping[str, Any], path: Path) -> JointCalibration:
    """Check the content of a file; `path` is for the message. Raises `CalibrationError`."""
    problems = list(_problems(data))
    if problems:
        raise CalibrationError(path, problems)
    tables = {joint: Table(_points(rows)) for joint, rows in data.get("joints", {}).items()}
    coupled = data.get("coupled", {}).get(COUPLED_KEY)
    return JointCalibration(tables, None if coupled is None else CoupledTable(_coupled(coupled)))


def _points(rows: Sequence[Sequence[float]]) -> list[Point]:
    return [(raw, degrees) for raw, degrees in rows]


def _coupled(rows: Sequence[Sequence[float]]) -> list[CoupledPoint]:
    return [(raw_1, raw_2, first, second) for raw_1, raw_2, first, second in rows]


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
            points = sorted(_points(rows))
            yield from _raw_problems([raw for raw, _ in points])
            yield from _degree_problems(joint, [degrees for _, degrees in points])
            yield from _curve_problems(points)


def _coupled_problems(rows: object) -> Iterator[str]:
    shape = list(_shape_problems(rows, 4, COUPLED_POINTS_MIN, COUPLED_POINTS_MAX))
    yield from shape
    if shape or not isinstance(rows, list):
        return
    points = _coupled(rows)
    found = list(_raw_problems([raw for point in points for raw in point[:2]]))
    for at, joint in enumerate(COUPLED):
        found += [
            f"{joint}: {problem}"
            for problem in _degree_problems(joint, [point[2 + at] for point in points])
        ]
    found += _steepness_problems(points)
    yield from found
    if not found:
        try:
            CoupledTable(points)
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
    """NaN and infinity are none, nor is anything that no raw value or angle could be."""
    return isinstance(value, int | float) and not isinstance(value, bool) and -1e9 < value < 1e9


def _raw_problems(raws: Sequence[float]) -> Iterator[str]:
    for raw in dict.fromkeys(raws):
        if raw == 0:
            yield "raw 0 is a placeholder, not a measured value"
        elif not 0 < raw <= COUNT_MAX:
            yield f"raw {raw} is not in 1..{COUNT_MAX}"


def _degree_problems(joint: str, degrees: Sequence[float]) -> Iterator[str]:
    low, high = RANGE_DEG[joint]
    for angle in dict.fromkeys(degrees):
        if not low - RANGE_MARGIN_DEG <= angle <= high + RANGE_MARGIN_DEG:
            yield f"{angle} degrees is out of reach, the joint goes from {low} to {high}"


def _curve_problems(points: Sequence[Point]) -> Iterator[str]:
    """`points` are sorted by raw."""
    slopes = []
    for (raw, degrees), (next_raw, next_degrees) in itertools.pairwise(points):
        if raw == next_raw:
            yield f"raw {raw} stands twice"
            continue
        slope = (next_degrees - degrees) / (next_raw - raw)
        slopes.append(slope)
        if abs(slope) > SLOPE_MAX_DEG:
            yield (
                f"{abs(slope):.2f} degrees per count from raw {raw} to {next_raw} "
                f"is steeper than {SLOPE_MAX_DEG}"
            )
    if not (all(slope > 0 for slope in slopes) or all(slope < 0 for slope in slopes)):
        yield "is not monotone: degrees must only rise or only fall with raw"


def _steepness_problems(points: Sequence[CoupledPoint]) -> list[str]:
    """Points so near each other that noise would move the joints."""
    problems = []
    for first, second in itertools.combinations(points, 2):
        distance = float(np.hypot(first[0] - second[0], first[1] - second[1]))
        turn = max(abs(first[2] - second[2]), abs(first[3] - second[3]))
        if distance == 0:
            problems.append(f"raw {first[0]}, {first[1]} stands twice")
        elif turn / distance > SLOPE_MAX_DEG:
            problems.append(
                f"{turn / distance:.2f} degrees per count from raw {first[0]}, {first[1]} to "
                f"{second[0]}, {second[1]} is steeper than {SLOPE_MAX_DEG}"
            )
    return problems
