"""Samples lost by whole sweeps, stalls, and frames without a time: no reading holds two sweeps."""

from __future__ import annotations

import random
from collections.abc import Sequence
from itertools import accumulate

import numpy as np
import pytest

from graspd.drivers.base import TactileReading
from graspd.drivers.biotac import SEQUENCES
from tests.drivers.can.can_words import (
    SLOT_NS,
    Sample,
    assembler,
    assert_true,
    concatenated,
    feed,
    samples,
    truth,
)

MS = 1_000_000


def assert_of_one_sweep(reading: TactileReading) -> int:
    """The sweep of all counts of a reading that are not flagged; each sweep has its own counts."""
    sound = reading.faults == 0
    base = (reading.counts.astype(int) - truth(0).astype(int)) % 4096
    tags = set(base[sound].tolist())
    assert len(tags) == 1, f"the reading has counts of the sweeps {tags}"
    assert not reading.counts[~sound].any()
    return int(tags.pop()) // 7


@pytest.mark.parametrize("lost", [22, 23, 24, 25, 46, 47, 48])
def test_repeated_words_make_no_copies_of_lost_samples(lost: int) -> None:
    """The words of all sweeps are the same, so only time tells that a sample is no copy."""
    sweeps, counters = assembler()
    stream = concatenated([samples(n) for n in range(20)])
    stream = [(channel, samples(0)[channel - 17][1], t_ns) for channel, _, t_ns in stream]
    start = 9 * 24 + 12
    feed(sweeps, stream[:start] + stream[start + lost :])
    assert counters.lost_frames + 24 * counters.missed_readings == lost
    assert counters.duplicate_frames == counters.reordered_frames == 0


@pytest.mark.parametrize("at", [1, 5, 12, 23])
def test_a_sender_that_stalls_looks_like_a_loss(at: int) -> None:
    sweeps, counters = assembler()
    stream = concatenated([samples(n) for n in range(10)])
    here = 8 * 24 + at
    stream[here:] = [(channel, words, t_ns + 15 * MS) for channel, words, t_ns in stream[here:]]
    readings = feed(sweeps, stream)
    assert [assert_of_one_sweep(reading) for reading in readings] == [*range(9), 8, 9]
    assert [int(np.count_nonzero(r.faults[0])) for r in readings[8:]] == [24 - at, at, 0]
    assert counters.missed_readings == 2


@pytest.mark.parametrize(
    ("place", "after_ns", "is_next"),
    [
        (5, 1_899_999, False),
        (5, 1_900_000, True),
        (9, 2_299_999, False),
        (9, 2_300_000, True),
    ],
)
def test_an_unknown_period_is_the_fastest_boards(place: int, after_ns: int, is_next: bool) -> None:
    """100 us a sample: three quarters of a sweep are 1800 us, after the time to that place."""
    sweeps, _ = assembler()
    begun, late = samples(0)[:5], samples(0)[place]
    readings = feed(sweeps, [*begun, (*late[:2], begun[-1][2] + after_ns)])
    assert len(readings) == is_next


def test_a_period_is_learned_from_two_ends_in_succession() -> None:
    """Every second sweep has no end, and its lost samples are too few to look like a pause."""
    sweeps, _ = assembler()
    stream = [samples(n) if n < 8 or n % 2 else samples(n)[:10] for n in range(50)]
    feed(sweeps, concatenated(stream))
    assert sweeps.period_ns == 24 * SLOT_NS


def test_a_period_is_learned_though_each_sweep_has_losses() -> None:
    sweeps, _ = assembler()
    feed(sweeps, concatenated([samples(n)[:5] + samples(n)[6:] for n in range(6)]))
    assert sweeps.period_ns == 24 * SLOT_NS


def test_the_first_sweep_may_end_on_time_after_a_loss() -> None:
    sweeps, counters = assembler()
    kept = samples(0)[:2] + samples(0)[21:]
    (reading,) = feed(sweeps, retimed(kept, [at * 100_000 for at in (0, 1, 21, 22, 23)]))
    assert_true(reading, 0)
    assert (counters.late_frames, counters.lost_frames) == (0, 19)


@pytest.mark.parametrize("cut_at", [0, 1, 12, 23])
def test_a_known_loss_ends_the_sweep_at_hand(cut_at: int) -> None:
    """So few are lost that neither order nor time would show where."""
    sweeps, counters = assembler()
    readings = feed(sweeps, concatenated([samples(n) for n in range(8)]) + samples(8)[:cut_at])
    readings += sweeps.cut()
    readings += feed(sweeps, samples(8)[cut_at:] + samples(9) + samples(10))
    tags = [assert_of_one_sweep(reading) for reading in readings]
    assert tags == [*range(11)]
    assert [reading.seq for reading in readings] == tags
    assert np.count_nonzero(readings[8].faults[0]) == (24 - cut_at if cut_at else 0)
    assert counters.cut_sweeps == (cut_at > 0)
    assert counters.unsynchronised_frames == (24 - cut_at if cut_at else 0)


def test_samples_of_vague_time_make_no_reading() -> None:
    sweeps, counters = assembler()
    readings = feed(sweeps, concatenated([samples(n) for n in range(8)]) + samples(8)[:12])
    until_ns = samples(10)[12][2]
    since_ns = samples(8)[12][2]
    stalled = [*samples(8)[12:], *samples(9), *samples(10)[:12]]
    for channel, words, _ in stalled:
        readings += sweeps.push(channel, words, since_ns, until_ns)
    readings += feed(sweeps, samples(10)[12:] + samples(11))
    assert [assert_of_one_sweep(reading) for reading in readings] == [*range(9), 10, 11]
    assert [int(np.count_nonzero(r.faults[0])) for r in readings[8:]] == [12, 12, 0]
    assert counters.untimed_frames == len(stalled)
    assert [reading.seq for reading in readings] == [*range(9), 10, 11]


def test_the_period_is_learned_from_samples_whose_time_is_vague() -> None:
    sweeps, counters = assembler()
    for n in range(20):
        for channel, words, t_ns in samples(n):
            sweeps.push(channel, words, t_ns - 3 * MS, t_ns)
    assert sweeps.period_ns == 24 * SLOT_NS
    assert 0 < counters.untimed_frames < 10 * 24
    assert counters.readings >= 10


def retimed(stream: Sequence[Sample], times_ns: Sequence[int]) -> list[Sample]:
    return [(sample[0], sample[1], t) for sample, t in zip(stream, times_ns, strict=True)]


@pytest.mark.parametrize("sequence", sorted(SEQUENCES))
@pytest.mark.parametrize("mean_ms", [2, 5])
def test_a_host_that_stalls_leaves_no_wrong_period_behind(sequence: str, mean_ms: float) -> None:
    """Half a second of samples that come late and in heaps, as from a computer without a break."""
    chance = random.Random(0)
    sweeps, _ = assembler(sequence)
    count = 5000 // len(SEQUENCES[sequence])
    stream = concatenated([samples(n, sequence) for n in range(count)])
    times = [t_ns for _, _, t_ns in stream]
    for at, sent_ns in enumerate(times):
        if 150 * MS <= sent_ns < 650 * MS:
            times[at] = sent_ns + round(chance.expovariate(1 / mean_ms) * MS)
    readings = feed(sweeps, retimed(stream, list(accumulate(times, max))))  # the order stays
    for reading in readings:
        assert_of_one_sweep(reading)
    assert sweeps.period_ns == len(SEQUENCES[sequence]) * SLOT_NS
    assert not any(reading.faults.any() for reading in readings[-20:])


@pytest.mark.parametrize("sequence", sorted(SEQUENCES))
@pytest.mark.parametrize("rate_hz", [1, 60, 400])
def test_slow_and_fast_boards_are_understood(sequence: str, rate_hz: int) -> None:
    """Nothing is known of the rate when the driver opens."""
    sweeps, _ = assembler(sequence)
    slot_ns = round(1e9 / rate_hz / len(SEQUENCES[sequence]))
    stream = concatenated([samples(n, sequence) for n in range(40)])
    readings = feed(sweeps, retimed(stream, [slot_ns * at for at in range(len(stream))]))
    for reading in readings:
        assert_of_one_sweep(reading)
    assert [r.faults.any() for r in readings[-30:]] == [False] * 30
    assert sweeps.period_ns == slot_ns * len(SEQUENCES[sequence])


@pytest.mark.parametrize("sequence", sorted(SEQUENCES))
@pytest.mark.parametrize("lost", [-1, 0, 1])
def test_rhythmic_losses_make_no_longer_period(sequence: str, lost: int) -> None:
    """The order looks as if nothing were missing."""
    sweeps, _ = assembler(sequence)
    length = len(SEQUENCES[sequence])
    stream = concatenated([samples(n, sequence) for n in range(200)])
    rhythm = 5 * length // 2 + 1
    kept = [
        sample
        for at, sample in enumerate(stream)
        if at < 20 * length or at % rhythm >= length + lost
    ]
    for reading in feed(sweeps, kept):
        assert_of_one_sweep(reading)
    assert sweeps.period_ns == length * SLOT_NS
