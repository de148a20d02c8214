"""Raw Hall values to joint angles, and the mistakes that a calibration file may not have."""

from __future__ import annotations

import itertools
import math
import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from graspd.drivers.base import JOINTS
from graspd.drivers.palm.calibration import (
    HALL_SENSORS,
    CalibrationError,
    CoupledTable,
    JointCalibration,
    impossible_angles,
    load_calibration,
    parse_calibration,
)
from tests.drivers.palm.palm_stream import SNAPSHOT

EXAMPLE = Path(__file__).parents[3] / "deploy" / "calibration" / "example_hand.toml"
FFJ1 = [[3109, 0.0], [2673, 22.5], [1942, 45.0], [1247, 67.5], [649, 90.0]]
FILE = Path("hand.toml")


def degrees(calibration: JointCalibration, **raws: int | tuple[int, ...]) -> dict[str, float]:
    """Return the angles of all joints, degrees. `raws`: sensor values of some, by joint; THJ5 and
    WRJ1 have two each. The other sensors read 1."""
    sensors = [1] * 37
    for joint, raw in raws.items():
        values = raw if isinstance(raw, tuple) else (raw,)
        for word, value in zip(HALL_SENSORS[joint], values, strict=True):
            sensors[word] = value
    return dict(zip(JOINTS, np.degrees(calibration.angles_rad(sensors)), strict=True))


def calibration(**joints: list[list[float]]) -> JointCalibration:
    return parse_calibration({"version": 1, "joints": joints}, FILE)


def problems(data: dict[str, object]) -> tuple[str, ...]:
    with pytest.raises(CalibrationError) as caught:
        parse_calibration(data, FILE)
    lines = str(caught.value).splitlines()
    assert all(line.startswith("hand.toml: ") for line in lines)
    assert len(set(lines)) == len(lines)
    return tuple(line.removeprefix("hand.toml: ") for line in lines)


@pytest.mark.parametrize(
    ("joint", "raw", "expected_deg"),
    [
        ("FFJ1", 2891, 11.25),  # half way from 3109 to 2673
        ("FFJ1", 1595, 45 + 22.5 * (1942 - 1595) / (1942 - 1247)),
        ("FFJ1", 4095, 0 - 22.5 * (4095 - 3109) / (3109 - 2673)),  # beyond, by the first segment
        ("FFJ1", 100, 90 + 22.5 * (649 - 100) / (1247 - 649)),  # and by the last one
        ("FFJ1", 1942, 45),
        ("FFJ3", 946, 90),
        ("FFJ4", 591, -20),
        ("THJ4", 2260, 67.5),
        ("THJ5", (4029, 1668), -60 + 120 * (3633 - 2848.5) / 2570),
    ],
)
def test_angles_of_the_example_file_are_interpolated_and_extended(
    joint: str, raw: int | tuple[int, int], expected_deg: float
) -> None:
    assert degrees(load_calibration(EXAMPLE), **{joint: raw})[joint] == pytest.approx(expected_deg)


def test_two_sensors_are_averaged_before_the_table_not_after() -> None:
    bent: list[list[float]] = [[1000, -40], [2000, 0], [3000, 20]]
    angle = degrees(calibration(WRJ1=bent), WRJ1=(1000, 2500))["WRJ1"]
    assert angle == pytest.approx(-10.0)  # at 1750; the mean of -40 and 10 would be -15


def test_j0_is_the_sum_of_j1_and_j2() -> None:
    both = calibration(FFJ1=FFJ1, FFJ2=[[3000, 0.0], [1000, 90.0]])
    angles = degrees(both, FFJ1=1942, FFJ2=2000)
    assert [angles["FFJ1"], angles["FFJ2"], angles["FFJ0"]] == pytest.approx([45, 45, 90])


def test_a_joint_without_a_table_has_no_angle() -> None:
    angles = dict(zip(JOINTS, load_calibration(EXAMPLE).angles_rad(SNAPSHOT), strict=True))
    known = {joint for joint, angle in angles.items() if not math.isnan(angle)}
    assert known == {"FFJ1", "FFJ3", "FFJ4", "THJ4", "THJ5"}
    assert len(angles) == 28


@pytest.mark.parametrize("raw", [(4096, 2000), (2000, 65535)])
def test_a_raw_value_over_12_bits_gives_no_angle(raw: tuple[int, int]) -> None:
    assert math.isnan(degrees(load_calibration(EXAMPLE), THJ5=raw)["THJ5"])
    both = calibration(FFJ1=FFJ1, FFJ2=FFJ1)
    assert math.isnan(degrees(both, FFJ1=4096, FFJ2=2000)["FFJ0"])
    angles = degrees(parse_calibration(coupled(COUPLED), FILE), THJ1=raw[0], THJ2=raw[1])
    assert np.isnan([angles["THJ1"], angles["THJ2"]]).all()


# Shadow's documentation, md_ranges.rst; J0 is the sum of J1 and J2.
RANGES_DEG = {
    **{f"{finger}J0": (0, 180) for finger in ("FF", "MF", "RF", "LF")},
    **{f"{finger}J1": (0, 90) for finger in ("FF", "MF", "RF", "LF")},
    **{f"{finger}J2": (0, 90) for finger in ("FF", "MF", "RF", "LF")},
    **{f"{finger}J3": (-15, 90) for finger in ("FF", "MF", "RF", "LF")},
    **{f"{finger}J4": (-20, 20) for finger in ("FF", "MF", "RF", "LF")},
    **{"LFJ5": (0, 45), "THJ1": (-15, 90), "THJ2": (-40, 40), "THJ3": (-12, 12)},
    **{"THJ4": (0, 70), "THJ5": (-60, 60), "WRJ1": (-40, 28), "WRJ2": (-28, 10)},
}


def test_an_angle_over_ten_degrees_beyond_range_is_impossible() -> None:
    assert set(JOINTS) == set(RANGES_DEG)
    for joint, (low, high) in RANGES_DEG.items():
        for angle, impossible in (
            *((low - 10.01, 1), (low - 10, 0), (low, 0)),
            *((high, 0), (high + 10, 0), (high + 10.01, 1)),
        ):
            angles = np.full(28, np.nan)
            angles[JOINTS.index(joint)] = math.radians(angle)
            assert impossible_angles(angles) == impossible, joint


def test_the_sensor_indices_of_joints_are_those_of_shadows_headers() -> None:
    """`sensors[]` of the palm headers: THJ5 and WRJ1 have two, A and B."""
    order = [f"{finger}J{joint}" for finger in ("FF", "MF", "RF") for joint in (1, 2, 3, 4)]
    order += ["LFJ1", "LFJ2", "LFJ3", "LFJ4", "LFJ5", "THJ1", "THJ2", "THJ3", "THJ4"]
    order += ["THJ5", "THJ5", "WRJ1", "WRJ1", "WRJ2"]
    assert {
        joint: tuple(word for word, name in enumerate(order) if name == joint) for joint in order
    } == HALL_SENSORS


# THJ1 and THJ2: five by five raw pairs, as a hand is calibrated.
RAW_PAIRS = [(900 + 420 * i + 60 * j, 800 + 380 * j - 45 * i) for i in range(5) for j in range(5)]
ANGLES = [(-15 + 26 * i, -40 + 20 * j) for i in range(5) for j in range(5)]
COUPLED = [[*raws, *angles] for raws, angles in zip(RAW_PAIRS, ANGLES, strict=True)]


def coupled(rows: Sequence[Sequence[float]]) -> dict[str, object]:
    return {"version": 1, "coupled": {"THJ1_THJ2": [list(row) for row in rows]}}


def single(joint: str, rows: Sequence[Sequence[float]]) -> dict[str, object]:
    return {"version": 1, "joints": {joint: [list(row) for row in rows]}}


def steep(slope: float) -> list[list[float]]:
    return [[1000, 1000, 0, -15], [1060, 1080, 0, 100 * slope - 15], [1060, 1000, 0, 10]]


POINTS = [[1000 + 10 * row, row / 2] for row in range(65)]
PAIRS = [[1000 + 100 * (row % 2), 1000 + 60 * (row // 2), row % 2, 0] for row in range(50)]
TAKEN = [
    *(single("FFJ1", POINTS[:number]) for number in (2, 64)),
    *(coupled(PAIRS[:number]) for number in (3, 49)),
    *(single("FFJ1", [[1000, 0.0], [1100, 50.0]]), coupled(steep(0.5))),
    *(single("FFJ4", [[1000, first], [3000, last]]) for first, last in ((-30.0, 30.0), (0.5, 0.0))),
]


def test_a_table_at_its_limits_is_accepted() -> None:
    for data in TAKEN:
        parse_calibration(data, FILE)


GRID = [
    (1000.0 + 500 * i, 1000.0 + 500 * j, 15.0 * i + 3 * ((i + j) % 2), 15.0 * j - 10)
    for i, j in itertools.product(range(3), repeat=2)
]
"""Raw pairs on a square grid, as of a jig; each square can be cut into triangles in two ways."""
ANYWHERE = np.random.default_rng(5).uniform((500, 500, -15, -15), (3500, 3500, 40, 40), (25, 4))


@pytest.mark.parametrize(
    ("rows", "low", "high"), [(GRID, 1000, 2000), (ANYWHERE.tolist(), 500, 3500)]
)
def test_the_coupled_table_agrees_with_an_independent_interpolation(
    rows: list[tuple[float, float, float, float]], low: float, high: float
) -> None:
    """By the table's `SHEAR` of the raw pairs, the reference cuts the same triangles."""
    interpolate = pytest.importorskip("scipy.interpolate", reason="needs the extra `test`")
    sheared, whole = np.array([[1.0, 1e-5], [0.0, 1.00001618]]), np.array(rows)
    reference = interpolate.LinearNDInterpolator(whole[:, :2] @ sheared, whole[:, 2:])
    tables = [CoupledTable(order) for order in (rows, rows[::-1], rows[4:] + rows[:4])]
    inside = 0
    for pair in np.random.default_rng(8).uniform(low, high, (300, 2)):
        expected = reference(*(pair @ sheared))
        if np.isnan(expected).any():
            continue
        inside += 1
        for table in tables:
            assert np.degrees(table.angles_rad(*pair)) == pytest.approx(expected, abs=1e-9)
    assert inside > 150


@pytest.mark.parametrize(
    ("joint", "rows", "reason"),
    [
        # As shipped with three hands: a digit too many.
        ("LFJ1", [[22361, 0.0], [1942, 45.0], [649, 90.0]], "raw 22361 is not in 1..4095"),
        ("RFJ2", [[0, 0.0], [0, 22.5], [0, 45.0]], "raw 0 is a placeholder"),
        ("RFJ2", [[-5, 0.0], [900, 45.0]], "raw -5 is not in 1..4095"),
        ("LFJ3", [[2500, 0.0], [1800, 45.0], [1200, 44.5], [700, 90.0]], "is not monotone"),
        ("LFJ3", [[700, 0.0], [1200, 45.0], [1800, 44.5], [2500, 90.0]], "is not monotone"),
        ("THJ3", [[2500, 0.0], [1800, 0.0]], "is not monotone"),
        ("WRJ2", [[2500, 0.0], [2500, 10.0]], "raw 2500 stands twice"),
        ("FFJ3", [[2500, 0.0], [2510, 45.0]], "4.50 degrees per count from raw 2500 to 2510"),
        ("ffj1", FFJ1, "no such joint"),
        ("FFJ0", FFJ1, "is the sum of FFJ1 and FFJ2"),
        ("THJ1", FFJ1, "stand in [coupled]"),
        ("FFJ1", [[1000, 0.0, 1], [2000, 45.0]], "must be a list of points of 2 numbers"),
        ("FFJ1", [[1000, True], [2000, 45.0]], "must be a list of points"),
        ("FFJ1", [[1000, math.nan], [2000, 45.0]], "must be a list of points"),
        ("FFJ1", [[10**400, 0.0], [2000, 45.0]], "must be a list of points"),
        ("FFJ1", 7, "must be a list of points"),
    ],
)
def test_a_wrong_table_is_refused_with_joint_and_reason(
    joint: str, rows: object, reason: str
) -> None:
    found = problems({"version": 1, "joints": {joint: rows, "FFJ4": [[591, -20], [1884, 0]]}})
    assert any(line.startswith(f"{joint}: ") and reason in line for line in found), found


@pytest.mark.parametrize(
    ("data", "reason"),
    [
        ({"joints": {"FFJ1": FFJ1}}, "version is None, must be 1"),
        ({"version": True, "joints": {"FFJ1": FFJ1}}, "version is True"),
        ({"version": 1}, "joints: is empty"),
        ({"version": 1, "joints": 3}, "joints: must be a table"),
        ({"version": 1, "joint": {}, "joints": {"FFJ1": FFJ1}}, "joint: no such key"),
        ({"version": 1, "coupled": {"THJ1": COUPLED}}, "THJ1: no such key; there is: THJ1_THJ2"),
        (coupled([[0, 0, 0, 0]] * 25), "THJ1_THJ2: raw 0 is a placeholder"),
        (coupled([*COUPLED, COUPLED[0]]), "stands twice"),
        (coupled([*COUPLED, [800, 4096, 0, -40]]), "raw 4096 is not in 1..4095"),
        (coupled([*COUPLED, [3500, 300, 120, -40]]), "THJ1: 120 degrees is out of reach"),
        (coupled([[1000 + 90 * i, 2000 + 90 * i, i, i] for i in range(9)]), "span a triangle"),
        (single("FFJ1", POINTS[:1]), "FFJ1: has 1 points, must have 2 to 64"),
        (single("FFJ1", POINTS), "FFJ1: has 65 points, must have 2 to 64"),
        (coupled(PAIRS[:2]), "THJ1_THJ2: has 2 points, must have 3 to 49"),
        (coupled(PAIRS), "THJ1_THJ2: has 50 points, must have 3 to 49"),
        (single("FFJ1", [[1000, 0.0], [1100, 51.0]]), "steeper than 0.5"),
        (coupled(steep(0.51)), "steeper than 0.5"),
        (single("FFJ4", [[1000, -30.5], [3000, 30.0]]), "goes from -20 to 20"),
        (single("FFJ4", [[1000, -30.0], [3000, 30.5]]), "goes from -20 to 20"),
    ],
)
def test_a_wrong_file_is_refused_with_the_reason(data: dict[str, object], reason: str) -> None:
    assert any(reason in line for line in problems(data)), problems(data)


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        (b"version = ", "is not TOML"),
        (b"#" * 262_145, "is longer than 262144 bytes"),
        (None, "cannot be read"),
    ],
)
def test_an_unreadable_file_is_refused_with_path_and_reason(
    tmp_path: Path, content: bytes | None, reason: str
) -> None:
    path = tmp_path / "hand.toml"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(CalibrationError, match=re.escape(f"{path}: {reason}")):
        load_calibration(path)


def test_a_file_of_256_kib_is_accepted(tmp_path: Path) -> None:
    path = tmp_path / "hand.toml"
    path.write_text(EXAMPLE.read_text().ljust(262_144, "#"))
    assert load_calibration(path).tables


values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5),
    lambda inner: (
        st.lists(inner, max_size=4)
        | st.dictionaries(st.sampled_from(["FFJ1", "THJ1_THJ2", "x"]), inner, max_size=3)
    ),
    max_leaves=20,
)


@settings(max_examples=40)
@given(st.fixed_dictionaries({}, optional=dict.fromkeys(("version", "joints", "coupled"), values)))
def test_any_content_gives_a_calibration_or_a_calibration_error(data: dict[str, object]) -> None:
    try:
        found = parse_calibration({"version": 1} | data, FILE)
    except CalibrationError:
        return
    assert len(found.angles_rad(SNAPSHOT)) == 28
