"""Times of samples: limits hold to the ns, and the board's period is learned despite losses."""

from __future__ import annotations

import itertools
import random
from collections.abc import Callable, Sequence
from itertools import accumulate
from pathlib import Path

import numpy as np
import pytest

from graspd.drivers.base import ElectrodeFault
from graspd.drivers.biotac import PAC, SEQUENCES
from graspd.drivers.can.samples import Fate, Held, classify
from graspd.drivers.can.sweep_clock import SweepClock, Timing
from tests.drivers.can.can_words import (
    FINGERS,
    SLOT_NS,
    Sample,
    assembler,
    concatenated,
    feed,
    samples,
    word,
)
from tests.drivers.one_sweep import number_in

MS = 1_000_000
PERIOD_NS = 24 * SLOT_NS


@pytest.mark.parametrize("distance", [1, 2, 3])
@pytest.mark.parametrize("at", [0, 20, 23])
def test_a_late_sample_is_placed_unless_its_sweep_has_ended(at: int, distance: int) -> None:
    """A sample comes one to three places late; after the last electrode's it is too late."""
    sweeps, counters = assembler()
    stream = concatenated([samples(n) for n in range(9)])
    here = 6 * 24 + at
    stream.insert(here + distance, stream.pop(here))
    readings = feed(sweeps, stream)
    assert len(readings) == 9
    for sweep, reading in enumerate(readings):
        assert number_in(reading) == sweep
    in_time = at + distance < 23
    missing = readings[6].faults == ElectrodeFault.MISSING
    assert (missing == missing[0]).all()
    assert np.flatnonzero(missing[0]).tolist() == ([] if in_time else [at])
    assert counters.reordered_frames == in_time
    assert counters.late_frames == (not in_time)
    assert all(not reading.faults.any() for n, reading in enumerate(readings) if n != 6)


def test_only_a_sweep_with_samples_counts_as_cut() -> None:
    sweeps, counters = assembler()
    sweeps.cut()
    assert counters.cut_sweeps == 0
    feed(sweeps, samples(0)[:1])
    sweeps.cut()
    assert counters.cut_sweeps == 1


def test_a_break_between_readings_marks_only_the_next_as_interrupted() -> None:
    sweeps, _ = assembler()
    sweeps.interrupt()
    readings = feed(sweeps, samples(0))
    sweeps.interrupt()
    readings += feed(sweeps, concatenated([samples(1), samples(2)]))
    assert [reading.interrupted for reading in readings] == [False, True, False]


def test_channels_that_the_sequence_lacks_are_counted() -> None:
    sweeps, counters = assembler("electrodes")
    stream = samples(0)
    stream.insert(5, (PAC, word(2050) * FINGERS, stream[5][2]))
    (reading,) = feed(sweeps, stream)
    assert not reading.faults.any()
    assert counters.unexpected_channels == 1


def periods(gaps_ns: Sequence[int]) -> list[int | None]:
    """The period known after each of `gaps_ns`, times from sweep's end to sweep's end; None: none
    yet."""
    clock, end_ns, known = SweepClock(range(24), 24), 10**12, []
    clock.learn_end(end_ns)
    for gap_ns in gaps_ns:
        end_ns += gap_ns
        clock.learn_end(end_ns)
        known.append(clock.period_ns)
    return known


def test_the_period_is_the_median_of_five_to_fifteen_gaps() -> None:
    assert periods([10] * 15 + [20] * 9) == [None] * 4 + [10] * 11 + [10] * 7 + [20] * 2


def test_only_gaps_up_to_two_seconds_teach_a_period() -> None:
    for gap_ns in (0, -1, 2_000 * MS + 1):
        assert periods([gap_ns] * 5) == [None] * 5
    assert periods([2_000 * MS] * 5)[-1] == 2_000 * MS


@pytest.mark.parametrize(
    ("number", "late_ns", "missed"),
    [
        # Sweeps of a fast board take 5.4 ms: the host may be late instead.
        (10, 5 * MS - 1, 0),
        (10, 5 * MS, 1),
        # An outage of more than two seconds is one missed sweep.
        (9, 2_000 * MS - PERIOD_NS, round(2e9 / PERIOD_NS) - 1),
        (9, 2_000 * MS - PERIOD_NS + 1, 1),
    ],
)
def test_sweeps_missed_before_a_late_one_are_counted(
    number: int, late_ns: int, missed: int
) -> None:
    """All samples from sweep `number` on are late."""
    made, counters = assembler()
    for sweep in range(number + 2):
        for channel, words, t_ns in samples(sweep):
            made.push(channel, words, t_ns + (late_ns if sweep >= number else 0))
    assert counters.missed_readings == missed


@pytest.mark.parametrize(
    ("doubt_ns", "untimed"), [(round(0.75 * PERIOD_NS) - 1, 0), (round(0.75 * PERIOD_NS), 1)]
)
def test_a_sample_uncertain_by_three_quarters_period_is_dropped(
    doubt_ns: int, untimed: int
) -> None:
    made, counters = assembler()
    for sample in concatenated([samples(n) for n in range(9)]):
        made.push(*sample)
    channel, words, t_ns = samples(9)[0]
    made.push(channel, words, t_ns, t_ns + doubt_ns)
    assert counters.untimed_frames == untimed


@pytest.mark.parametrize("lost", [23, 24, 47])
def test_losses_are_counted_exactly_if_all_sweeps_have_equal_words(lost: int) -> None:
    """The words of all sweeps are the same, so only time tells that a sample is not a copy."""
    sweeps, counters = assembler()
    stream = concatenated([samples(n) for n in range(20)])
    stream = [(channel, samples(0)[channel - 17][1], t_ns) for channel, _, t_ns in stream]
    start = 9 * 24 + 12
    feed(sweeps, stream[:start] + stream[start + lost :])
    assert counters.lost_frames + 24 * counters.missed_readings == lost
    assert counters.duplicate_frames == counters.reordered_frames == 0


@pytest.mark.parametrize(
    ("place", "after_ns", "is_next"),
    [
        (4, 1_799_999, False),
        (4, 1_800_000, True),
        (5, 1_899_999, False),
        (5, 1_900_000, True),
        (9, 2_299_999, False),
        (9, 2_300_000, True),
    ],
)
def test_an_unknown_period_counts_as_that_of_the_fastest_board(
    place: int, after_ns: int, is_next: bool
) -> None:
    """At 100 us a sample, 3/4 of a sweep are 1800 us, added to the time to that place."""
    sweeps, _ = assembler()
    begun, late = samples(0)[:5], samples(0)[place]
    readings = feed(sweeps, [*begun, (*late[:2], begun[-1][2] + after_ns)])
    assert len(readings) == is_next


@pytest.mark.parametrize("kept", [0, 10])
def test_the_period_stays_if_every_second_sweep_loses_its_end(kept: int) -> None:
    """From the ninth on, every second sweep is lost, whole or after its tenth sample."""
    sweeps, _ = assembler()
    stream = [samples(n) if n < 8 or n % 2 else samples(n)[:kept] for n in range(50)]
    feed(sweeps, concatenated(stream))
    assert sweeps.period_ns == PERIOD_NS
    assert sweeps.expected_ns == samples(50)[-1][2]
    feed(sweeps, samples(50)[:11])
    assert sweeps.expected_ns == samples(50)[-1][2]


@pytest.mark.parametrize("sequence", sorted(SEQUENCES))
@pytest.mark.parametrize("rate_hz", [1, 400])
def test_the_period_of_slow_and_fast_boards_is_learned(sequence: str, rate_hz: int) -> None:
    """Nothing is known of the rate when the driver opens."""
    sweeps, _ = assembler(sequence)
    slot_ns = round(1e9 / rate_hz / len(SEQUENCES[sequence]))
    stream = concatenated([samples(n, sequence) for n in range(40)])
    readings = feed(sweeps, retimed(stream, [slot_ns * at for at in range(len(stream))]))
    assert [number_in(r) for r in readings[-30:] if not r.faults.any()] == [*range(10, 40)]
    assert sweeps.period_ns == slot_ns * len(SEQUENCES[sequence])


@pytest.mark.parametrize(
    ("sweep", "step_ns", "t_ns", "late"),
    [
        # Until the period is known a sample takes 100 us, then 3/4 of a period before is early.
        (0, 100_000, 2_100_000, 0),
        (0, 100_000, 2_099_999, 1),
        (9, SLOT_NS, 3 * SLOT_NS + 1, 0),
        (9, SLOT_NS, 3 * SLOT_NS, 1),
    ],
)
def test_a_sample_far_ahead_is_dropped_if_too_early(
    sweep: int, step_ns: int, t_ns: int, late: int
) -> None:
    sweeps, counters = assembler()
    stream = concatenated([samples(n) for n in range(sweep + 1)])
    start_ns = sweep * PERIOD_NS
    begun = retimed(stream[-24:-22] + stream[-3:-2], [0, step_ns, t_ns])
    feed(sweeps, stream[:-24] + [(*sample[:2], sample[2] + start_ns) for sample in begun])
    assert counters.late_frames == late


def test_uncertain_times_teach_a_period_after_six_sweeps() -> None:
    sweeps, counters = assembler()
    for channel, words, t_ns in concatenated([samples(n) for n in range(20)]):
        sweeps.push(channel, words, t_ns - 3 * MS, t_ns)
    assert sweeps.period_ns == PERIOD_NS
    assert (counters.untimed_frames, counters.readings) == (6 * 24, 14)


def test_samples_of_too_uncertain_time_are_left_out() -> None:
    sweeps, counters = assembler()
    readings = feed(sweeps, concatenated([samples(n) for n in range(8)]) + samples(8)[:12])
    until_ns = samples(10)[12][2]
    since_ns = samples(8)[12][2]
    stalled = [*samples(8)[12:], *samples(9), *samples(10)[:12]]
    for channel, words, _ in stalled:
        readings += sweeps.push(channel, words, since_ns, until_ns)
    readings += feed(sweeps, samples(10)[12:] + samples(11))
    assert [number_in(reading) for reading in readings] == [*range(9), 10, 11]
    assert [int(np.count_nonzero(r.faults[0])) for r in readings[8:]] == [12, 12, 0]
    assert counters.untimed_frames == len(stalled)
    assert [reading.seq for reading in readings] == [*range(9), 10, 11]


def retimed(stream: Sequence[Sample], times_ns: Sequence[int]) -> list[Sample]:
    return [(sample[0], sample[1], t) for sample, t in zip(stream, times_ns, strict=True)]


@pytest.mark.parametrize("sequence", sorted(SEQUENCES))
def test_a_host_that_stalls_leaves_no_wrong_period_behind(sequence: str) -> None:
    """For half a second samples come late and many at once, as on a busy computer."""
    chance = random.Random(0)
    sweeps, _ = assembler(sequence)
    count = 5000 // len(SEQUENCES[sequence])
    stream = concatenated([samples(n, sequence) for n in range(count)])
    times = [t_ns for _, _, t_ns in stream]
    for at, sent_ns in enumerate(times):
        if 150 * MS <= sent_ns < 650 * MS:
            times[at] = sent_ns + round(chance.expovariate(1 / 5) * MS)
    readings = feed(sweeps, retimed(stream, list(accumulate(times, max))))  # the order stays
    for reading in readings:
        number_in(reading)
    assert sweeps.period_ns == len(SEQUENCES[sequence]) * SLOT_NS
    assert not any(reading.faults.any() for reading in readings[-20:])


PAGE = Path(__file__).parents[3] / "deploy" / "can" / "PROTOCOL.md"
PLACES: dict[str, Callable[[int, int], bool]] = {
    "any": lambda _place, _last: True,
    "ahead": lambda place, last: place > last,
    "back": lambda place, last: last - 3 <= place <= last,
    "far back": lambda place, last: place < last - 3,
    "jump": lambda place, last: place in (21, 22, 23) and last in (0, 1, 2),
}
"""By words of `PAGE`: function that returns True if they are true of a sample's place and of the
furthest place before, both from 0."""
OUT = ", reading has ended"
TIMES = {"any": set(Timing), "late": {Timing.LATE}, "early": {Timing.EARLY}}
HELD = {
    "any": set(Held),
    "nothing": {Held.NOTHING},
    "the same words": {Held.SAME},
    "other words": {Held.OTHER},
}
FATES = {
    "begins another sweep": Fate.BEGINS,
    "takes it": Fate.PLACED,
    "drops it: `duplicate_frames`": Fate.COPY,
    "drops it: `late_frames`": Fate.LATE,
    "puts it in its place: `reordered_frames`": Fate.REORDERED,
}


def rows() -> list[list[str]]:
    table = PAGE.read_text().partition("| electrode | time |")[2].partition("\n\n")[0]
    return [[cell.strip() for cell in line.split("|")[1:-1]] for line in table.splitlines()[2:]]


def test_classify_follows_the_first_matching_row_of_the_protocols_table() -> None:
    used, table = set(), rows()
    for place, last, timing, held, is_over in itertools.product(
        range(24), range(-1, 24), Timing, Held, (False, True)
    ):
        row = next(
            (electrode, time, has, what)
            for electrode, time, has, what in table
            if PLACES[electrode.removesuffix(OUT)](place, last)
            and (is_over or not electrode.endswith(OUT))
            and timing in TIMES[time]
            and held in HELD[has]
        )
        used.add(row)
        assert classify(place, last, timing, held, is_over=is_over) is FATES[row[3]]
    assert len(used) == len(table)
