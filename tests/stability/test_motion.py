"""Calibration tables and the gate under extreme slopes and times."""

from __future__ import annotations

import itertools
from fractions import Fraction
from math import pi
from pathlib import Path

import numpy as np

from graspd.biotac import Finger
from graspd.daemon.judge.decision import HandLimits
from graspd.daemon.judge.hand import HandTracker
from graspd.daemon.judge.health import Checked
from graspd.daemon.judge.reasons import Reason
from graspd.drivers.palm.calibration import CoupledTable, Table, parse_calibration

FINGERS: tuple[Finger, ...] = ("ff", "mf", "th")
ELECTRODES, COUNT_MAX = 24, 4095
S, MS = 1_000_000_000, 1_000_000
ANGLE_ERROR_MAX_RAD = 1e-9
"""Largest error of a table; one count of a Hall sensor is 6e-4 rad."""
REST_COUNTS, TOUCH_COUNTS, NOISE_COUNTS = 2600, 2200, 3.5
"""Untouched and touched electrodes, and the noise measured on untouched sensors."""
TARE_SWEEPS = 150


def test_the_steepest_table_is_exact() -> None:
    # As steep as a file may be, and a segment so short that its ends nearly cancel.
    points = [(1000.0, 0.0), (1000.0 + 2.0**-20, 0.5 * 2.0**-20), (1100.0, 45.0), (3000.0, 80.0)]
    rows = [list(point) for point in points]
    parse_calibration({"version": 1, "joints": {"FFJ3": rows}}, Path("calibration"))
    table = Table(points)
    segments = list(itertools.pairwise((Fraction(x), Fraction(y)) for x, y in points))

    def degrees(raw: Fraction) -> Fraction:
        (x, y), (next_x, next_y) = next((s for s in segments if raw < s[1][0]), segments[-1])
        return y + (raw - x) * (next_y - y) / (next_x - x)

    raws = [*map(float, range(COUNT_MAX + 1)), *(raw for raw, _ in points)]
    error = max(
        abs(table.angle_rad(raw) - float(degrees(Fraction(raw))) * pi / 180) for raw in raws
    )
    assert error <= ANGLE_ERROR_MAX_RAD


def test_a_coupled_table_is_exact_in_a_thin_triangle() -> None:
    corners = [(100.0, 100.0), (4000.0, 4000.0), (2050.0, 2054.0)]
    degrees = [(0.0, -30.0), (80.0, 30.0), (40.0, 1.0)]
    table = CoupledTable([(*raws, *angles) for raws, angles in zip(corners, degrees, strict=True)])
    error = 0.0
    for weights in ((1, 0, 0), (0, 1, 0), (0, 0, 1), (1, 1, 2), (1, 2, 5), (3, 4, 1)):
        shares = [Fraction(weight, sum(weights)) for weight in weights]
        raw_1, raw_2, *wanted = (
            float(sum(share * Fraction(row[axis]) for share, row in zip(shares, rows, strict=True)))
            for rows in (corners, degrees)
            for axis in (0, 1)
        )
        for found, exact in zip(table.angles_rad(raw_1, raw_2), wanted, strict=True):
            error = max(error, abs(found - exact * pi / 180))
    assert error <= ANGLE_ERROR_MAX_RAD


def test_a_grasp_at_10_khz_is_judged_once() -> None:
    judged, _ = grasp_through_gate(S // 10_000, 5_000)
    assert judged == 1


def test_a_grasp_at_a_tenth_of_a_hertz_is_never_judged() -> None:
    # Between such readings anything may happen.
    judged, reasons = grasp_through_gate(10 * S, 60)
    assert judged == 0
    assert reasons


def grasp_through_gate(period_ns: int, touching: int) -> tuple[int, list[Reason]]:
    """How often a grasp of `touching` sweeps is judged, and the objections to it."""
    hand, random = HandTracker(FINGERS, HandLimits()), np.random.default_rng(0)
    judged, reasons = 0, dict.fromkeys(hand.silent().reasons)
    for number in range(TARE_SWEEPS + touching):
        mean = np.full((len(FINGERS), ELECTRODES), float(REST_COUNTS))
        if number >= TARE_SWEEPS:
            mean[:, : ELECTRODES // 3] = TOUCH_COUNTS
        counts = np.rint(random.normal(mean, NOISE_COUNTS)).astype(np.uint16)
        moment, _ = hand.step(number * period_ns, counts, Checked((), None))
        judged += moment.judges
        if number >= TARE_SWEEPS:
            reasons |= dict.fromkeys(moment.reasons)
    return judged, list(reasons)
