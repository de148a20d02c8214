"""PlotJuggler's JSON parser gets numbers out of our messages, under names that can be relied on.

The oracle does what that parser does (ParserFactory JSON, version 3.8 to 3.10): objects and arrays
become paths, booleans numbers, all numbers doubles; text, null and what is empty is skipped. The
ZeroMQ plugin puts the first frame, the topic, before the path.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from pathlib import Path

import pytest

GOLDEN = Path(__file__).parents[1] / "publish" / "golden"
EXACT_MAX = 2**53
"""Whole numbers up to here are doubles without loss; as ns, 104 days of a monotonic clock."""


def flattened(prefix: str, value: object) -> Iterator[tuple[str, float]]:
    match value:
        case dict():
            for key, inner in value.items():
                yield from flattened(f"{prefix}/{key}", inner)
        case list():
            for index, inner in enumerate(value):
                yield from flattened(f"{prefix}[{index}]", inner)
        case bool() | int() | float():
            yield prefix, float(value)


def series(golden: str, topic: str) -> dict[str, float]:
    found = list(flattened(topic, json.loads((GOLDEN / f"{golden}.json").read_text())))
    assert len(dict(found)) == len(found), "two series of one name"
    return dict(found)


def test_a_verdict_is_numbers_and_the_outcome_is_a_code() -> None:
    assert series("verdict_slip", "verdict.right") == {
        "verdict.right/v": 1.0,
        "verdict.right/seq": 42.0,
        "verdict.right/t": 1790000000.5,
        "verdict.right/t_mono_ns": 123456799012345.0,
        "verdict.right/grasp": 43.0,
        "verdict.right/verdict_code": 2.0,
        "verdict.right/p_slip": 0.96875,
        "verdict.right/valid": 1.0,
        "verdict.right/age_ms": 0.5,
        "verdict.right/latency_us": 500.0,
        "verdict.right/judged": 1.0,
        "verdict.right/silence_ms": 100.0,
        "verdict.right/outcomes": 0.0,
        "verdict.right/supervised": 0.0,
        "verdict.right/early": 0.0,
    }


def test_stillness_has_a_series_for_each_finger_and_what_is_not_known_makes_a_gap() -> None:
    found = series("gate_moved", "gate.right")
    assert found["gate.right/still_ms"] == 0.0
    assert found["gate.right/motion/mf"] == 12.5
    assert found["gate.right/motion_limits/mf"] == 1.5
    assert "gate.right/motion/th" not in found


def test_an_unknown_verdict_makes_a_gap_in_the_probability_and_not_a_zero() -> None:
    found = series("verdict_unknown", "verdict.right")
    assert "verdict.right/p_slip" not in found
    assert found["verdict.right/verdict_code"] == 0.0
    assert found["verdict.right/valid"] == 0.0


def test_counts_have_a_series_for_each_electrode_and_joints_one_by_name() -> None:
    found = series("tactile", "tactile.right")
    assert found["tactile.right/counts[0][0]"] == 2000.0
    assert found["tactile.right/counts[1][23]"] == 3021.0
    assert found["tactile.right/faults[1][1]"] == 1.0
    assert found["tactile.right/joints/FFJ3"] == 0.5
    assert sum("/counts[" in name for name in found) == 48


def test_a_status_has_series_below_its_parts() -> None:
    found = series("status", "status.right")
    assert found["status.right/latency_us/p99"] == 500.0
    assert found["status.right/verdicts/slip"] == 1.0
    assert found["status.right/drivers/replay/faulty_readings"] == 1.0
    assert found["status.right/repaired/ff_7"] == 12.0


@pytest.mark.parametrize("path", sorted(GOLDEN.glob("*.json")), ids=lambda path: path.stem)
def test_all_messages_can_be_drawn_without_loss(path: Path) -> None:
    found = series(path.stem, "topic")
    assert found["topic/t"] > 1e9  # seconds since 1970: the field to take as timestamp
    for name, value in found.items():
        assert math.isfinite(value), name
        assert abs(value) < EXACT_MAX, name
