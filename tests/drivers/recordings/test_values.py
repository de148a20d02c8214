"""What values of a recording may be: counts, angles, outcomes."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import pytest

from tests.drivers.recordings.tables import refusal, rows_of, stream, table

PLAIN = table(4)
TIMES = ["100.00", "100.01", "100.02", "100.03"]


def scaled(change: Callable[[int], str], separator: str = ",") -> bytes:
    lines = PLAIN.decode().splitlines()
    cells = [line.split(",") for line in lines[1:]]
    rows = [[*row[:2], *(change(int(cell)) for cell in row[2:])] for row in cells]
    return "".join(separator.join(row) + "\n" for row in [lines[0].split(","), *rows]).encode()


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (scaled(lambda n: f"{n / 4095:.4f}"), "normalised? multiply by 4095"),
        (scaled(lambda n: f"{n / 4095 * 3.3:.3f}"), "volts?"),
        (scaled(lambda n: f"{n // 2}.5"), "means of several readings?"),
        (scaled(lambda n: str(n - 1100)), "differences?"),
        (scaled(lambda n: str(n * 16)), "another sensor, or another scale?"),
        (scaled(lambda n: f'"{n // 1000},{n % 1000:03}"'), "without a separator of thousands"),
        (scaled(lambda n: f"{n // 1000} {n % 1000:03}", ";"), "without a separator of thousands"),
        (scaled(lambda n: f"{n / 1000:.3f}", ";"), "thousands with a point, or volts?"),
        (scaled(lambda n: f"{n / 40.95:.2f}"), "percent, or another scale?"),
        (scaled(hex), "hexadecimal?"),
        (scaled(lambda _: "high"), "text in place of numbers?"),
    ],
)
def test_values_that_are_not_counts_are_refused_once(content: bytes, said: str) -> None:
    message = refusal(content)
    assert "of 288 values are not counts, whole numbers in 0..4095, the first is '" in message
    assert said in message


def test_joints_in_degrees_are_named() -> None:
    degrees = {"FFJ1": ["1", "2", "3", "1"], "rh_FFJ3": ["45.8", "46.1", "46.0", "3"]}
    content = stream(TIMES, degrees)
    assert "FFJ3 = 45.8 rad is beyond every joint: degrees?" in refusal(content)
    named = content.replace(b"FFJ1", b"FFJ1 [deg]")
    assert "FFJ1 [deg]: angles are in degrees: write radians" in refusal(named)


def test_a_single_large_angle_is_bad() -> None:
    angles = ["0.5", "70", *["0.5"] * 18]
    rows = rows_of(stream([f"{n / 100}" for n in range(20)], {"FFJ3": angles}))
    assert [math.isnan(row.position_rad[0]) for row in rows] == [False, True, *[False] * 18]


@pytest.mark.parametrize(
    ("cells", "expected"),
    [
        (["0.0", "1.0", "", "1.0"], [False, True, None, True]),
        (["False", "True", "nan", "TRUE"], [False, True, None, True]),
        (["0,0", "1,0", "NA", "1,0"], [False, True, None, True]),
        (["stable", "slip", "None", " Slip "], [False, True, None, True]),
    ],
)
def test_outcomes_are_read_as_tools_write_them(
    cells: Sequence[str], expected: Sequence[bool | None]
) -> None:
    content = table(4, {row: {"slipped": f'"{cell}"'} for row, cell in enumerate(cells)})
    rows = rows_of(content, outcomes=True)
    assert [row.annotation.slipped for row in rows] == expected
