"""The measured period, and the times from which on samples are of another sweep, to the ns."""

from __future__ import annotations

import pytest

from graspd.drivers.can.readings import SweepPeriod
from tests.drivers.can.can_words import SLOT_NS, assembler, concatenated, samples

MS = 1_000_000
PERIOD_NS = 24 * SLOT_NS


def test_a_period_is_the_median_of_the_last_fifteen_and_known_after_five() -> None:
    made, known = SweepPeriod(), []
    for gap_ns in [10] * 15 + [20] * 9:
        made.learn(gap_ns)
        known.append(made.period_ns)
    assert known == [None] * 4 + [10] * 11 + [10] * 7 + [20] * 2


def test_a_period_is_of_two_seconds_at_most_and_of_no_sweeps_at_one_time() -> None:
    made = SweepPeriod()
    for gap_ns in (0, -1, 2_000 * MS + 1) * 5:
        made.learn(gap_ns)
    assert made.period_ns is None
    for _ in range(5):
        made.learn(2_000 * MS)
    assert made.period_ns == 2_000 * MS


def missed_when_late(number: int, late_ns: int) -> int:
    """Sweeps said to be missed when after `number` of them all samples come so late."""
    made, counters = assembler()
    for sweep in range(number + 2):
        for channel, words, t_ns in samples(sweep):
            made.push(channel, words, t_ns + (late_ns if sweep >= number else 0))
    return counters.missed_readings


@pytest.mark.parametrize(("late_ns", "missed"), [(5 * MS - 1, 0), (5 * MS, 1)])
def test_a_sweep_less_than_five_milliseconds_late_tells_of_no_missed_one(
    late_ns: int, missed: int
) -> None:
    """Of a fast board, whose sweeps take 5.4 ms: it may be the host that is late."""
    assert missed_when_late(10, late_ns) == missed


@pytest.mark.parametrize(
    ("gap_ns", "missed"), [(2_000_000_000, round(2e9 / PERIOD_NS) - 1), (2_000_000_001, 1)]
)
def test_an_outage_of_more_than_two_seconds_counts_as_one_missed_sweep(
    gap_ns: int, missed: int
) -> None:
    assert missed_when_late(9, gap_ns - PERIOD_NS) == missed


@pytest.mark.parametrize(("distance", "readings"), [(3, 9), (4, 10)])
def test_a_sample_four_after_its_place_is_of_another_sweep(distance: int, readings: int) -> None:
    made, counters = assembler()
    stream = concatenated([samples(n) for n in range(9)])
    here = 6 * 24 + 8
    stream.insert(here + distance, stream.pop(here))
    assert sum(len(made.push(*sample)) for sample in stream) == readings
    assert counters.reordered_frames == (distance == 3)


@pytest.mark.parametrize(
    ("doubt_ns", "untimed"), [(round(0.75 * PERIOD_NS) - 1, 0), (round(0.75 * PERIOD_NS), 1)]
)
def test_a_sample_whose_time_is_in_doubt_by_three_quarters_of_a_period_is_useless(
    doubt_ns: int, untimed: int
) -> None:
    made, counters = assembler()
    for sample in concatenated([samples(n) for n in range(9)]):
        made.push(*sample)
    channel, words, t_ns = samples(9)[0]
    made.push(channel, words, t_ns, t_ns + doubt_ns)
    assert counters.untimed_frames == untimed
