"""Whether readings come in time: counted by hand."""

from __future__ import annotations

import pytest

from graspd.daemon.publish.outbox import Deadlines
from tests.daemon.fakes import MS, reading

PERIOD_NS = 10 * MS


@pytest.mark.parametrize(
    ("times_ms", "counted", "longest_us"),
    [
        ({0: 100, 1: 110, 2: 121, 3: 130}, 3, 1000.0),
        ({0: 100, 2: 120, 3: 130}, 1, 0.0),
        ({0: 100, 1: 110, 2: 3110, 3: 3120}, 2, 0.0),
    ],
    ids=["distance from the period", "lost reading", "outage"],
)
def test_jitter_is_of_readings_in_a_row(
    times_ms: dict[int, int], counted: int, longest_us: float
) -> None:
    deadlines = Deadlines()
    for seq, t_ms in times_ms.items():
        deadlines.add(reading(t_ms * MS, seq=seq), 0.5, PERIOD_NS)
    assert deadlines.jitter.count == counted
    assert deadlines.jitter.max_us == pytest.approx(longest_us)


def test_a_verdict_more_than_a_period_after_its_reading_is_late() -> None:
    deadlines = Deadlines()
    for seq, age_ms in enumerate((0.5, 10.0, 10.5, 2.0)):
        deadlines.add(reading(seq * PERIOD_NS, seq=seq), age_ms, PERIOD_NS)
    assert deadlines.late == 1
    assert deadlines.worst_age_ms == 10.5


def test_without_a_period_nothing_is_late() -> None:
    deadlines = Deadlines()
    for seq in range(3):
        deadlines.add(reading(seq * PERIOD_NS, seq=seq), 500.0, None)
    assert (deadlines.late, deadlines.jitter.count) == (0, 0)
    assert deadlines.worst_age_ms == 500.0
