"""Samples become readings: nothing shifts, nothing is invented, limits hold to the ns."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest

from graspd.drivers.base import ElectrodeFault, TactileReading
from graspd.drivers.biotac import PAC, SEQUENCES
from graspd.drivers.can.sweep_clock import SweepClock
from tests.drivers.can.can_words import (
    FINGERS,
    SLOT_NS,
    assembler,
    assert_true,
    concatenated,
    feed,
    samples,
    truth,
    word,
)

OUTAGE_NS = 2_000_000_000
PERIODS_NEEDED = 5

MISSING = ElectrodeFault.MISSING


def missing_electrodes(reading: TactileReading) -> list[int]:
    """Electrodes, from 1, that are missing, the same for all fingers."""
    flagged = reading.faults == MISSING
    assert (flagged == flagged[0]).all()
    return [int(electrode) + 1 for electrode in np.flatnonzero(flagged[0])]


@pytest.mark.parametrize("sequence", sorted(SEQUENCES))
def test_a_sweep_is_complete_with_its_last_electrode(sequence: str) -> None:
    sweeps, counters = assembler(sequence)
    stream = samples(0, sequence)
    last = max(at for at, (channel, _, _) in enumerate(stream) if channel == 40)
    assert feed(sweeps, stream[:last]) == []
    (reading,) = feed(sweeps, stream[last:])
    assert reading.t_ns == stream[last][2]
    assert (reading.counts == truth(0)).all()
    assert not reading.faults.any()
    assert counters.readings == 1


@pytest.mark.parametrize("lost", [0, 12, 22])
def test_samples_that_come_at_once_keep_their_places(lost: int) -> None:
    sweeps, counters = assembler()
    spoiled = samples(5)
    del spoiled[lost]
    stream = concatenated([*(samples(n) for n in range(5)), spoiled, samples(6), samples(7)])
    readings = feed(sweeps, [(channel, words, 0) for channel, words, _ in stream])
    assert len(readings) == 8
    for sweep, reading in enumerate(readings):
        assert missing_electrodes(reading) == ([lost + 1] if sweep == 5 else [])
        assert_true(reading, sweep)
    assert counters.lost_frames == counters.faulty_readings == 1
    assert counters.missed_readings == 0


@pytest.mark.parametrize("distance", [1, 2, 3])
@pytest.mark.parametrize("at", [0, 12, 19, 20, 21, 22, 23])
def test_a_late_sample_is_put_in_its_place_or_flagged(at: int, distance: int) -> None:
    """A sample comes up to three after its place; behind the last electrode it is too late."""
    sweeps, counters = assembler()
    stream = concatenated([samples(n) for n in range(9)])
    here = 6 * 24 + at
    stream.insert(here + distance, stream.pop(here))
    readings = feed(sweeps, stream)
    assert len(readings) == 9
    for sweep, reading in enumerate(readings):
        assert_true(reading, sweep)
    in_time = at + distance < 23
    assert missing_electrodes(readings[6]) == ([] if in_time else [at + 1])
    assert counters.reordered_frames == in_time
    assert counters.late_frames == (not in_time)
    assert all(not reading.faults.any() for n, reading in enumerate(readings) if n != 6)


def test_joining_in_the_middle_waits_for_a_sweep_to_begin() -> None:
    sweeps, counters = assembler()
    readings = feed(sweeps, concatenated([samples(0)[10:], samples(1), samples(2)]))
    assert len(readings) == 2
    assert counters.unsynchronised_frames == 14
    for sweep, reading in enumerate(readings, start=1):
        assert not reading.faults.any()
        assert_true(reading, sweep)


def test_an_interrupted_sweep_is_dropped_and_not_mended() -> None:
    sweeps, counters = assembler()
    readings = feed(sweeps, samples(0) + samples(1)[:12])
    sweeps.interrupt()
    readings += feed(sweeps, samples(2)[12:] + samples(3))
    assert [reading.t_ns for reading in readings] == [samples(0)[-1][2], samples(3)[-1][2]]
    assert_true(readings[1], 3)
    assert counters.interrupted_sweeps == 1


@pytest.mark.parametrize("known", [False, True], ids=["period unknown", "period known"])
def test_a_sweep_cut_by_silence_is_not_filled_up_later(known: bool) -> None:
    sweeps, counters = assembler()
    before = PERIODS_NEEDED + 3 if known else 2
    readings = feed(sweeps, concatenated([samples(n) for n in range(before)]))
    readings += feed(sweeps, samples(before)[:12])
    late = [(channel, words, t_ns + OUTAGE_NS) for channel, words, t_ns in samples(before + 1)]
    readings += feed(sweeps, late[12:])
    assert missing_electrodes(readings[-2]) == list(range(13, 25))
    assert missing_electrodes(readings[-1]) == list(range(1, 13))
    assert_true(readings[-2], before)
    assert_true(readings[-1], before + 1)
    assert counters.lost_frames == 24


def test_channels_that_the_sequence_lacks_are_counted() -> None:
    sweeps, counters = assembler("electrodes")
    stream = samples(0)
    stream.insert(5, (PAC, word(2050) * FINGERS, stream[5][2]))
    (reading,) = feed(sweeps, stream)
    assert not reading.faults.any()
    assert counters.unexpected_channels == 1


def test_the_next_reading_is_expected_when_its_last_electrode_is() -> None:
    sweeps, _ = assembler()
    assert sweeps.expected_ns is None
    feed(sweeps, concatenated([samples(n) for n in range(8)]))
    ends = [samples(n)[-1][2] for n in range(10)]
    assert sweeps.expected_ns == ends[8]
    feed(sweeps, samples(8)[:12])
    assert sweeps.expected_ns == pytest.approx(ends[8], abs=10)


MS = 1_000_000
PERIOD_NS = 24 * SLOT_NS


def periods(gaps_ns: Sequence[int]) -> list[int | None]:
    """The period after each of these times between the ends of sweeps."""
    clock, end_ns, known = SweepClock(range(24), 24), 10**12, []
    clock.learn_end(end_ns)
    for gap_ns in gaps_ns:
        end_ns += gap_ns
        clock.learn_end(end_ns)
        known.append(clock.period_ns)
    return known


def test_a_period_is_the_median_of_five_to_fifteen() -> None:
    assert periods([10] * 15 + [20] * 9) == [None] * 4 + [10] * 11 + [10] * 7 + [20] * 2


def test_a_period_is_two_seconds_at_most() -> None:
    assert periods([0, -1, 2_000 * MS + 1] * 5) == [None] * 15
    assert periods([2_000 * MS] * 5)[-1] == 2_000 * MS


def missed_when_late(number: int, late_ns: int) -> int:
    """Sweeps said to be missed when after `number` of them all samples come so late."""
    made, counters = assembler()
    for sweep in range(number + 2):
        for channel, words, t_ns in samples(sweep):
            made.push(channel, words, t_ns + (late_ns if sweep >= number else 0))
    return counters.missed_readings


@pytest.mark.parametrize(("late_ns", "missed"), [(5 * MS - 1, 0), (5 * MS, 1)])
def test_a_sweep_five_milliseconds_late_means_a_missed_one(late_ns: int, missed: int) -> None:
    """Of a fast board, whose sweeps take 5.4 ms: it may be the host that is late."""
    assert missed_when_late(10, late_ns) == missed


@pytest.mark.parametrize(
    ("gap_ns", "missed"), [(2_000_000_000, round(2e9 / PERIOD_NS) - 1), (2_000_000_001, 1)]
)
def test_an_outage_over_two_seconds_is_one_missed_sweep(gap_ns: int, missed: int) -> None:
    assert missed_when_late(9, gap_ns - PERIOD_NS) == missed


@pytest.mark.parametrize(
    ("doubt_ns", "untimed"), [(round(0.75 * PERIOD_NS) - 1, 0), (round(0.75 * PERIOD_NS), 1)]
)
def test_a_sample_vague_by_three_quarters_is_dropped(doubt_ns: int, untimed: int) -> None:
    made, counters = assembler()
    for sample in concatenated([samples(n) for n in range(9)]):
        made.push(*sample)
    channel, words, t_ns = samples(9)[0]
    made.push(channel, words, t_ns, t_ns + doubt_ns)
    assert counters.untimed_frames == untimed
