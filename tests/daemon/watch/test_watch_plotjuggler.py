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

from tests.kit.messages import GOLDEN

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


def series(golden: str) -> dict[str, float]:
    pairs = list(flattened("topic", json.loads((GOLDEN / f"{golden}.json").read_text())))
    assert len(dict(pairs)) == len(pairs), "two series of one name"
    return dict(pairs)


def test_a_field_is_a_series_and_null_makes_a_gap() -> None:
    slip, unknown, moved = map(series, ("verdict_slip", "verdict_unknown", "gate_moved"))
    assert (slip["topic/verdict_code"], slip["topic/p_slip"]) == (2.0, 0.96875)
    assert unknown["topic/verdict_code"] == 0.0
    assert "topic/p_slip" not in unknown
    assert moved["topic/motion/mf"] == 12.5
    assert "topic/motion/th" not in moved
    tactile, status = series("tactile"), series("status")
    assert (tactile["topic/counts[1][23]"], tactile["topic/joints/FFJ3"]) == (3021.0, 0.5)
    assert status["topic/drivers/replay/faulty_readings"] == 1.0


@pytest.mark.parametrize("path", sorted(GOLDEN.glob("*.json")), ids=lambda path: path.stem)
def test_all_messages_can_be_drawn_without_loss(path: Path) -> None:
    values = series(path.stem)
    assert values["topic/t"] > 1e9  # seconds since 1970: the field to take as timestamp
    for name, value in values.items():
        assert math.isfinite(value), name
        assert abs(value) < EXACT_MAX, name
