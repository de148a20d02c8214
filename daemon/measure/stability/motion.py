"""Joint velocity, calibration tables and the gate under extreme times and slopes."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from fractions import Fraction
from math import pi
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from daemon.judge.decision import HandLimits, JointLimits
from daemon.judge.hand import HandTracker
from daemon.judge.health import Checked
from daemon.judge.joint_motion import JointMotion
from daemon.judge.reasons import Reason
from daemon.measure.stability.steps import StepRow
from drivers.base import COUNT_MAX, ELECTRODES, JointReading, TactileReading
from drivers.palm.calibration import CalibrationError, parse_calibration
from drivers.palm.hall import CoupledTable, Table
from models.contract import Finger

FINGERS: tuple[Finger, ...] = ("ff", "mf", "th")
S, MS = 1_000_000_000, 1_000_000
JUMP_RAD = 0.5
ANGLE_ERROR_MAX_RAD = 1e-9
"""Of a table; one count of a Hall sensor is 6e-4 rad."""
REST_COUNTS, TOUCH_COUNTS, NOISE_COUNTS = 2600, 2200, 3.5
"""Untouched and touched electrodes, and the noise measured on untouched sensors."""
TARE_SWEEPS = 150


def joint_rows() -> Iterator[StepRow]:
    """Velocities whose time difference goes to zero."""
    for step_ns in (0, 1, 1_000, MS):
        motion = JointMotion(JointLimits())
        with np.errstate(all="raise"):
            motion.observe(_angle(0, 0.0), 0)
            motion.observe(_angle(step_ns, JUMP_RAD), step_ns)
            against = motion.objection(step_ns)
        yield StepRow(
            f"joint velocity, 0.5 rad within {step_ns} ns",
            "moving",
            str(against),
            against is Reason.MOVING,
        )
    limit = JointLimits().rad_per_s
    for rate, wanted in ((0.999 * limit, None), (1.001 * limit, Reason.MOVING)):
        motion = JointMotion(JointLimits())
        for t_ns in range(0, S, S // 10_000):
            motion.observe(_angle(t_ns, rate * t_ns / S), t_ns)
        against = motion.objection(t_ns)
        yield StepRow(
            f"joint velocity of {rate:.4f} rad/s at 10 kHz",
            "still" if wanted is None else str(wanted),
            "still" if against is None else str(against),
            against is wanted,
        )


def calibration_rows() -> Iterator[StepRow]:
    """Tables with segments that are nearly vertical."""
    for width in (1.0, 1e-6):
        points = [[1000.0, 0.0], [1000.0 + width, 80.0], [3000.0, 90.0]]
        refused = _is_refused(points)
        yield StepRow(
            f"calibration, 80 degrees within {width:g} counts",
            "refused",
            "refused" if refused else "taken",
            refused,
        )
    # As steep as a file may be, and a segment so short that its ends nearly cancel.
    steep = [(1000.0, 0.0), (1000.0 + 2.0**-20, 0.5 * 2.0**-20), (1100.0, 45.0), (3000.0, 80.0)]
    refused = _is_refused([list(point) for point in steep])
    error = _table_error(steep)
    yield StepRow(
        "calibration, steepest segment, 1e-6 counts wide",
        f"angle to {ANGLE_ERROR_MAX_RAD:.0e} rad",
        "refused" if refused else f"{error:.1e} rad",
        not refused and error <= ANGLE_ERROR_MAX_RAD,
    )
    error = _coupled_error()
    yield StepRow(
        "calibration, coupled joints, a triangle 2 counts high",
        f"angle to {ANGLE_ERROR_MAX_RAD:.0e} rad",
        f"{error:.1e} rad",
        error <= ANGLE_ERROR_MAX_RAD,
    )


def gate_rows() -> Iterator[StepRow]:
    """A whole grasp at 10 kHz, and one at 0.1 Hz, between whose readings anything may happen."""
    judged, _ = _grasp_through_gate(S // 10_000, 5_000)
    yield StepRow("gate, readings at 10 kHz", "judged once", f"judged {judged} times", judged == 1)
    judged, reasons = _grasp_through_gate(10 * S, 60)
    yield StepRow(
        "gate, readings at 0.1 Hz",
        "never judged, for a reason",
        f"judged {judged} times; {', '.join(reasons)}",
        judged == 0 and bool(reasons),
    )


def _angle(t_ns: int, angle_rad: float) -> JointReading:
    return JointReading(t_ns, 0, ("FFJ3",), np.array([angle_rad]))


def _is_refused(points: list[list[float]]) -> bool:
    try:
        parse_calibration({"version": 1, "joints": {"FFJ3": points}}, Path("calibration"))
    except CalibrationError:
        return True
    return False


def _table_error(points: list[tuple[float, float]]) -> float:
    """Largest error, rad, over all raw values and the points, against exact fractions."""
    table = Table(points)
    exact = [(Fraction(raw), Fraction(degrees)) for raw, degrees in points]
    raws = [*map(float, range(COUNT_MAX + 1)), *(raw for raw, _ in points)]
    return max(
        abs(table.angle_rad(raw) - float(_exact_degrees(exact, Fraction(raw))) * pi / 180.0)
        for raw in raws
    )


def _exact_degrees(points: list[tuple[Fraction, Fraction]], raw: Fraction) -> Fraction:
    segments = list(itertools.pairwise(points))
    (x, y), (next_x, next_y) = next((pair for pair in segments if raw < pair[1][0]), segments[-1])
    return y + (raw - x) * (next_y - y) / (next_x - x)


def _coupled_error() -> float:
    """Largest error, rad, at and between the corners of one long, thin triangle."""
    corners = [(100.0, 100.0), (4000.0, 4000.0), (2050.0, 2054.0)]
    degrees = [(0.0, -30.0), (80.0, 30.0), (40.0, 1.0)]
    table = CoupledTable([(*raws, *angles) for raws, angles in zip(corners, degrees, strict=True)])
    shares = [(1, 0, 0), (0, 1, 0), (0, 0, 1), (1, 1, 2), (1, 2, 5), (3, 4, 1)]
    errors = []
    for weights in shares:
        at = [Fraction(weight, sum(weights)) for weight in weights]
        raw_1, raw_2, *wanted = (
            sum(share * Fraction(row[axis]) for share, row in zip(at, rows, strict=True))
            for rows in (corners, degrees)
            for axis in (0, 1)
        )
        found = table.angles_rad(float(raw_1), float(raw_2))
        errors += [
            abs(angle - float(exact) * pi / 180.0)
            for angle, exact in zip(found, wanted, strict=True)
        ]
    return max(errors)


def _grasp_through_gate(period_ns: int, touching: int) -> tuple[int, list[Reason]]:
    """How often a grasp is judged that is held for so many sweeps, and what spoke against it."""
    hand = HandTracker(FINGERS, HandLimits())
    random = np.random.default_rng(0)
    judged, reasons = 0, dict.fromkeys(hand.moment().reasons)
    for number in range(TARE_SWEEPS + touching):
        level = REST_COUNTS if number < TARE_SWEEPS else TOUCH_COUNTS
        reading = _sweep(number, number * period_ns, level, random)
        checked = Checked((), np.zeros(reading.counts.shape, dtype=np.bool_))
        moment, _ = hand.step(reading, checked)
        judged += moment.judges
        if number >= TARE_SWEEPS:
            reasons |= dict.fromkeys(moment.reasons)
    return judged, list(reasons)


def _sweep(number: int, t_ns: int, level: int, random: np.random.Generator) -> TactileReading:
    """A finger's first third of electrodes feels the touch."""
    mean: NDArray[np.float64] = np.full((len(FINGERS), ELECTRODES), float(REST_COUNTS))
    mean[:, : ELECTRODES // 3] = level
    counts = np.rint(random.normal(mean, NOISE_COUNTS)).astype(np.uint16)
    return TactileReading(t_ns, number, counts, np.zeros(counts.shape, dtype=np.uint8))
