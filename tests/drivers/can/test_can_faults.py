"""Every fault of a CAN bus in both formats: counted one by one, and nothing is invented."""

from __future__ import annotations

from collections.abc import Sequence

import pytest

from graspd.drivers.base import ElectrodeFault, TactileReading
from graspd.drivers.can.formats import CanFormat
from graspd.drivers.twins.faults import LinkFaults
from graspd.drivers.twins.grasps.grasps import Counts
from tests.drivers.can.can_standin import TwinLink, contact

FORMATS = list(CanFormat)


@pytest.mark.parametrize("frame_format", FORMATS)
@pytest.mark.parametrize(
    "faults",
    [
        LinkFaults(drop_probability=0.02),
        LinkFaults(duplicate_probability=0.05),
        LinkFaults(reorder_probability=0.05),
        LinkFaults(burst_frames=6),
        LinkFaults(disconnect_every_frames=50),
    ],
    ids=["drop", "duplicate", "reorder", "burst", "disconnect"],
)
def test_link_faults_are_counted_one_by_one_and_invent_nothing(
    frame_format: str, faults: LinkFaults
) -> None:
    link = TwinLink(frame_format)
    before, during, after = contact(2, 1), contact(200, 2), contact(2, 3)
    with link.driver:
        link.send(before)
        twin = link.send(during, faults)
        link.send(after)
    injected, counters = twin.injected, link.driver.counters
    sent = [*before, *during, *after]
    assert_only_what_was_sent(link.readings, sent)
    assert [reading.seq for reading in link.readings] == list(range(len(sent)))
    late = counters.late_frames
    assert counters.duplicate_frames == injected["duplicate"]
    assert counters.lost_frames == injected["drop"] + injected["disconnect"] + late
    assert counters.reordered_frames + late == injected["reorder"]
    assert counters.faulty_readings == sum(bool(r.faults.any()) for r in link.readings)
    assert injected.total() > 10
    assert_same_tail(link.readings, after)


def assert_only_what_was_sent(readings: Sequence[TactileReading], sent: Sequence[Counts]) -> None:
    """Every sound electrode holds the count of its own sweep."""
    for reading in readings:
        sound = reading.faults == 0
        assert (reading.counts[sound] == sent[reading.seq][sound]).all()


def assert_same_tail(readings: Sequence[TactileReading], counts: Sequence[Counts]) -> None:
    for reading, expected in zip(readings[-len(counts) :], counts, strict=True):
        assert not reading.faults.any()
        assert (reading.counts == expected).all()


def test_flipped_bits_are_counted_and_never_become_counts() -> None:
    link = TwinLink("syntouch")
    sent = contact(300)
    with link.driver:
        link.send(sent[:2])
        twin = link.send(sent[2:298], LinkFaults(bit_flip_probability=0.05))
        link.send(sent[298:])
    counters = link.driver.counters
    words = counters.parity_words + counters.error_words + counters.unplugged_words
    assert words + counters.unknown_commands == twin.injected["bit_flip"] > 100
    assert counters.lost_frames == counters.unknown_commands
    assert_only_what_was_sent(link.readings, sent)
    assert_same_tail(link.readings, sent[298:])


@pytest.mark.parametrize("frame_format", FORMATS)
def test_an_unplugged_sensor_is_missing_and_the_others_are_not(frame_format: str) -> None:
    link = TwinLink(frame_format)
    with link.driver:
        link.send(contact(20), LinkFaults(unplugged_fingers=(1,)))
    assert len(link.readings) == 20
    for reading, expected in zip(link.readings, contact(20), strict=True):
        assert (reading.faults[1] != 0).all()
        assert not reading.counts[1].any()
        assert not reading.faults[[0, 2]].any()
        assert (reading.counts[[0, 2]] == expected[[0, 2]]).all()
    assert link.driver.counters.unplugged_words == 20 * 24


def test_a_stuck_clock_is_counted() -> None:
    link = TwinLink("sweep_fd")
    with link.driver:
        link.send(contact(5), LinkFaults(stuck_clock=True))
    assert link.driver.counters.stuck_ticks == 3 * 4
    assert not link.readings[0].faults.any()
    assert len(link.readings) == 5
    assert all((reading.faults == ElectrodeFault.HELD).all() for reading in link.readings[1:])
