"""The fault table of the palm stream: what is injected is what is counted, and nothing is made up.

What no test can ask for: a palm packet has no checksum, so a flipped bit that leaves a count in
0..4095 cannot be told from a count. UDP's checksum finds it on the way from the relay.
"""

from __future__ import annotations

import pytest

from graspd.drivers.base import COUNT_MAX
from graspd.drivers.twins.faults import LinkFaults
from graspd.drivers.twins.palm import PalmTwin
from tests.drivers.palm.palm_stream import (
    MS,
    ROUND,
    Played,
    play,
    row_of,
    rows,
)

ROUNDS = 300


def run(faults: LinkFaults, rounds: int = ROUNDS) -> tuple[Played, PalmTwin, list[list[bytes]]]:
    twin = PalmTwin(rows(rounds), faults=faults)
    cycles = [list(cycle) for cycle in twin.cycles()]
    return play(cycles), twin, cycles


def expect_truth(played: Played) -> None:
    """Every unflagged count stands where the hand felt it, in the round of the reading's number."""
    truth = rows(ROUNDS)
    for reading in played.readings:
        assert row_of(reading, truth[reading.seq : reading.seq + 1]) == 0
    numbers = [reading.seq for reading in played.readings]
    assert numbers == sorted(set(numbers))


@pytest.mark.parametrize("probability", [0.001, 0.2])
def test_dropped_packets_are_counted_one_by_one(probability: float) -> None:
    played, twin, cycles = run(LinkFaults(drop_probability=probability, seed=4))
    last_seen = max(index for index, cycle in enumerate(cycles) if cycle)
    closed = len(played.readings) * ROUND  # the last round may wait for ever
    dropped = [index for index, cycle in enumerate(cycles[: ROUNDS * ROUND]) if not cycle]
    assert len(dropped) == twin.injected["drop"]
    assert 0 not in dropped  # else all of round 0 is waited for in vain
    assert last_seen < closed + ROUND
    assert played.counters.lost_packets == sum(index < closed for index in dropped)
    expect_truth(played)
    hit = {index // ROUND for index in dropped if index % ROUND and index < closed}
    assert played.counters.faulty_readings == len(hit)


def test_doubled_packets_are_dropped_and_counted_one_by_one() -> None:
    played, twin, _ = run(LinkFaults(duplicate_probability=0.2))
    assert played.counters.duplicate_packets == twin.injected["duplicate"] > 100
    assert len(played.sound()) == ROUNDS
    expect_truth(played)


def test_swapped_packets_find_their_place_or_are_counted_as_late() -> None:
    played, twin, _ = run(LinkFaults(reorder_probability=0.1))
    counters = played.counters
    assert counters.reordered_packets + counters.late_packets == twin.injected["reorder"] > 100
    assert counters.lost_packets == counters.late_packets  # swapped over the end of a round
    assert counters.conflicting_packets == counters.duplicate_packets == 0
    expect_truth(played)


def test_a_flipped_bit_is_seen_or_stays_within_the_range_of_a_count() -> None:
    played, twin, _ = run(LinkFaults(bit_flip_probability=0.2, seed=3))
    truth, wrong = rows(ROUNDS), 0
    for reading in played.readings:
        fresh = reading.faults == 0
        wrong += int((reading.counts[fresh] != truth[reading.seq][fresh]).sum())
        assert reading.counts.max() <= COUNT_MAX
    flips = twin.injected["bit_flip"]
    assert flips > 700
    # Each of 3 fingers has 2 words with 12 bits that can lie; a packet has 1760 bits.
    assert wrong <= flips
    assert wrong / flips == pytest.approx(3 * 2 * 12 / 1760, rel=0.5)
    assert len(played.readings) > 0.95 * ROUNDS


def test_after_the_link_broke_readings_are_sound_within_two_rounds() -> None:
    played, twin, cycles = run(LinkFaults(disconnect_every_frames=1000))
    broken = twin.injected["disconnect"]
    assert broken == 3
    assert played.counters.bad_lengths == broken  # the half packet
    back = [index for index in range(1, len(cycles) - 1) if cycles[index] and not cycles[index - 1]]
    assert len(back) == broken - (not cycles[-2])
    for index in back:
        later = [reading.t_ns for reading in played.sound() if reading.t_ns >= index * MS]
        assert later[0] - index * MS < 2 * ROUND * MS
    expect_truth(played)
