"""Rounds of palm packets: what is lost, held, late or damaged; the driver, and its joints."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from graspd.drivers.base import ElectrodeFault, Reading
from graspd.drivers.palm.calibration import CalibrationError
from graspd.drivers.palm.packet import Palm, PalmPacket
from graspd.drivers.palm.stream import PalmDriver, PalmStream
from graspd.drivers.twins.datagrams import PalmTwin
from tests.conftest import ROOT
from tests.drivers.one_sweep import number_in, sweeps_of, tactile
from tests.drivers.palm.palm_stream import (
    FINGERS,
    MS,
    ROUND,
    datagrams,
    flags,
    joints,
    packets,
    play,
    play_packets,
)
from tests.drivers.udp_standin import Receiver
from tests.kit.clock import Clock

MISSING, HELD, NOT_A_COUNT = (
    ElectrodeFault.MISSING,
    ElectrodeFault.HELD,
    ElectrodeFault.NOT_A_COUNT,
)


def change(packet: PalmPacket, finger: str, values: dict[str, int], **fields: int) -> PalmPacket:
    """A packet with other values in one finger's slot and other fields."""
    slot = ("ff", "mf", "rf", "lf", "th").index(finger)
    slots = list(packet.tactile)
    slots[slot] = slots[slot]._replace(**values)
    changed: dict[str, Any] = {"tactile": tuple(slots), **fields}
    return dataclasses.replace(packet, **changed)


@pytest.mark.parametrize("order", [("th", "ff"), ("mf",), ("ff", "mf", "rf", "lf", "th")])
def test_fingers_come_in_the_order_asked_for(order: tuple[str, ...]) -> None:
    made = list(PalmTwin(sweeps_of(2)).packets())
    readings = play(([packet.to_bytes()] for packet in made), order).readings
    for reading, row in zip(readings, sweeps_of(2), strict=True):
        for place, finger in enumerate(order):
            if finger in FINGERS:
                assert np.array_equal(reading.counts[place], row[FINGERS.index(finger)])
                assert not reading.faults[place].any()
            else:
                assert (reading.faults[place] == MISSING).all()


def test_an_electrode_without_its_valid_bit_is_held_or_missing() -> None:
    stream = packets(3)
    for index in (2, ROUND + 2):  # E2 and E3 of rounds 0 and 1, without the bit of other_sensor_1
        stream[index] = change(stream[index], "mf", {"valid": 0b0111})
    played = play_packets(stream[ROUND:] + stream[:ROUND])
    assert played.counters.held_values == 2
    first, second, third = played.readings
    assert flags(first, MISSING) == [[1, 2]]  # nothing older is known
    assert not second.faults.any()
    assert flags(third, HELD) == [[1, 2]]
    assert third.counts[1, 2] == sweeps_of(3)[2][1, 2]  # that of the round before
    assert flags(third, MISSING) == []


def test_a_value_over_12_bits_is_not_a_count() -> None:
    stream = packets(2)
    stream[3] = change(stream[3], "th", {"other_0": 4096, "other_1": 65535})
    stream[4] = change(stream[4], "th", {"other_0": 4095})
    played = play_packets(stream)
    assert flags(played.readings[0], NOT_A_COUNT) == [[2, 3], [2, 4]]
    assert played.readings[0].counts[2, 3:6].tolist() == [0, 0, 4095]
    assert played.counters.not_counts == 2


def test_a_finger_that_the_palm_marks_invalid_is_missing() -> None:
    stream = packets(2)
    for index in range(5, ROUND):
        stream[index] = change(stream[index], "ff", {}, tactile_valid=0b10010)
    played = play_packets(stream)
    assert flags(played.readings[0], MISSING) == [[0, electrode] for electrode in range(7, 24)]
    assert played.counters.invalid_fingers == ROUND - 5
    sweeps = PalmStream(FINGERS, heed_finger_bits=False)
    heedless = [reading for packet in stream for reading in sweeps.push(packet, 0)]
    assert not heedless[0].faults.any()


@pytest.mark.parametrize("position", [0, 1])
def test_an_impossible_pressure_or_temperature_is_an_absent_sensor(
    position: int,
) -> None:
    """A hand without this sensor gave -22072, which is 43464 unsigned."""
    stream = packets(2)
    stream[position] = change(stream[position], "mf", {"other_0": 43464})
    stream[position] = change(stream[position], "ff", {"other_0": 4095})  # may be that high
    stream[5] = change(stream[5], "th", {"other_0": 43464})  # an electrode tells only of itself
    first, second = play_packets(stream).readings
    assert flags(first, MISSING) == [[1, electrode] for electrode in range(24)]
    assert flags(first, NOT_A_COUNT) == [[2, 7]]
    assert not second.faults.any()
    stale = change(packets(1)[position], "mf", {"other_0": 43464, "valid": 0b1011})
    (reading,) = play_packets(
        [stale if at == position else p for at, p in enumerate(packets(1))]
    ).readings
    assert not flags(reading, NOT_A_COUNT)
    assert [1, 5] not in flags(reading, MISSING), "what is not fresh tells nothing"


def test_a_finger_of_nothing_but_zeros_is_absent() -> None:
    stream = packets(2)
    for index in range(ROUND):
        stream[index] = change(stream[index], "mf", {"other_0": 0, "other_1": 0})
    stream[3] = change(stream[3], "th", {"other_0": 0, "other_1": 0})
    played = play_packets(stream)
    assert flags(played.readings[0], MISSING) == [[1, electrode] for electrode in range(24)]
    assert played.counters.absent_fingers == 1
    assert not played.readings[1].faults.any()


def test_a_damaged_tactile_type_flags_readings_and_moves_no_values() -> None:
    stream = packets(4)
    for position, wrong in itertools.product(range(ROUND), range(1, 29, 2)):
        damaged = list(stream)
        index = ROUND + position
        damaged[index] = change(stream[index], "ff", {}, tactile_type=wrong)
        played = play_packets(damaged)
        found = [number for each in played.readings if (number := number_in(each)) is not None]
        assert found == sorted(set(found))
        assert not played.readings[-1].faults.any()
        if position != 0 and wrong != 2 * position + 1:  # the first packet has no electrode
            assert any(reading.faults.any() for reading in played.readings)


@pytest.mark.parametrize(
    ("tactile_type", "counter"),
    [
        *((kind, "metadata_packets") for kind in (0xFFF9, 0xFFFF)),
        *((kind, "unknown_types") for kind in (0, 2, 0x1D, 0xFFF8, 0x10000)),
    ],
)
def test_a_packet_without_samples_is_counted_and_changes_no_reading(
    tactile_type: int, counter: str
) -> None:
    stream = packets(3)
    other = change(stream[0], "ff", {}, tactile_type=tactile_type)
    played = play_packets([*stream[:20], other, *stream[20:]])
    assert getattr(played.counters, counter) == 1
    assert not any(reading.faults.any() for reading in played.readings)


@pytest.mark.parametrize(
    ("at", "counter", "lost"),
    [
        (ROUND - 2, "reordered_packets", []),
        (ROUND - 1, "late_packets", [[row, 23] for row in range(3)]),
    ],
)
def test_an_overtaken_packet_is_used_unless_its_round_is_over(
    at: int, counter: str, lost: list[list[int]]
) -> None:
    stream = packets(3)
    stream[at : at + 2] = stream[at + 1], stream[at]
    played = play_packets(stream)
    assert flags(played.readings[0], MISSING) == lost
    counted = {name: number for name, number in played.counters.as_dict().items() if number}
    losses = {"faulty_readings": 1, "lost_packets": 1} if lost else {}
    assert counted == {"packets": 42, "readings": 3, counter: 1, **losses}


@pytest.mark.parametrize(
    ("after_ns", "lost"),
    [(MS, 0), (11 * MS - 1, 0), (11 * MS, 1), (25 * MS - 1, 1), (25 * MS, 2)],
)
def test_a_packet_ten_cycles_overdue_means_a_lost_round(after_ns: int, lost: int) -> None:
    sweeps = PalmStream(FINGERS)
    stream = packets(2)
    readings = [reading for at in range(ROUND) for reading in sweeps.push(stream[at], at * MS)]
    end_ns = 13 * MS + after_ns
    for at in range(ROUND):
        readings += sweeps.push(stream[ROUND + at], end_ns + at * MS)
    assert [reading.seq for reading in readings] == [0, 1 + lost]
    assert (sweeps.counters.missed_readings, sweeps.counters.lost_packets) == (lost, lost * ROUND)


@pytest.mark.parametrize(
    ("after_ns", "missed"),
    [(13 * MS, 0), (14 * MS, 1), (2_000 * MS, 142), (2_000 * MS + 1, 1)],
)
def test_missed_rounds_are_counted_but_over_two_seconds_as_one(after_ns: int, missed: int) -> None:
    sweeps = PalmStream(FINGERS)
    stream = packets(2)
    sweeps.interrupt()
    for at in range(ROUND):
        sweeps.push(stream[at], at * MS)
    sweeps.interrupt()
    assert sweeps.counters.interrupted_rounds == 0
    assert sweeps.push(stream[ROUND + 3], 15 * MS) == ()
    sweeps.push(stream[ROUND], 13 * MS + after_ns)
    assert (sweeps.counters.missed_readings, sweeps.counters.unsynchronised_packets) == (missed, 1)
    sweeps.interrupt()
    assert sweeps.counters.interrupted_rounds == 1


@pytest.mark.parametrize(
    ("step", "after_ns", "late"),
    [
        (8, 4 * MS - 1, True),  # six before, or eight ahead: nearer in time
        (8, 4 * MS, False),
        (13, 6_500_000 - 1, True),
        (13, 6_500_000, False),
        (7, 0, False),  # half a round ahead
    ],
)
def test_a_packet_far_ahead_but_too_soon_counts_as_late(
    step: int, after_ns: int, late: bool
) -> None:
    sweeps = PalmStream(FINGERS)
    stream = packets(1)
    for at in range(ROUND):
        sweeps.push(stream[at], at * MS)
    sweeps.push(stream[(ROUND - 1 + step) % ROUND], 13 * MS + after_ns)
    assert sweeps.counters.conflicting_packets == late, "its place is taken already"


@pytest.mark.parametrize(("copies", "batch"), [(2, 1), (1, 4)])
def test_a_palm_that_repeats_equal_rounds_is_read_without_faults(copies: int, batch: int) -> None:
    """Each round of such a palm equals the one before, and does not count as its copy."""
    stream, steady = PalmStream(FINGERS), packets(1)
    for outage_ns in (0, 300 * MS):
        stream.interrupt()
        readings: list[Reading] = []
        for cycle, packet in enumerate(steady * 10):
            t_ns = outage_ns + cycle // batch * batch * MS
            for _ in range(copies):
                readings += stream.receive(packet.to_bytes(), t_ns) or ()
        assert len(readings) == 10
        assert [each.interrupted for each in readings] == [outage_ns > 0, *[False] * 9]
        assert not any(reading.faults.any() for reading in tactile(readings))
    assert stream.counters.duplicate_packets == 2 * 10 * ROUND * (copies - 1)
    assert stream.counters.unsynchronised_packets == 0


@pytest.mark.parametrize(
    ("position", "after_ns", "is_copy"),
    [
        (2, 1_500_000 - 1, True),
        (2, 1_500_000, False),  # the third of the next round
        (ROUND - 1, 8 * MS, True),
    ],
)
def test_an_equal_packet_too_soon_to_be_new_is_dropped(
    position: int, after_ns: int, is_copy: bool
) -> None:
    stream, steady = PalmStream(FINGERS), packets(1)
    for cycle, packet in enumerate(steady):
        stream.receive(packet.to_bytes(), cycle * MS)
    stream.receive(steady[position].to_bytes(), 13 * MS + after_ns)
    assert stream.counters.duplicate_packets == is_copy


def test_a_late_copy_in_its_round_begins_no_round() -> None:
    """A round has 14 packets, so a copy 8 to 12 ms late looks like a packet 6 to 2 ahead."""
    for late_ms in range(1, 13):
        stream = PalmStream(FINGERS)
        data = [packet.to_bytes() for packet in packets(2)]
        readings: list[Reading] = []
        for cycle in range(2 * ROUND + late_ms):
            for at in (cycle, cycle - late_ms):
                is_in_round = at == cycle or at // ROUND == cycle // ROUND
                if 0 <= at < len(data) and is_in_round:
                    readings += stream.receive(data[at], cycle * MS) or ()
        assert [reading.seq for reading in readings] == [0, 1], late_ms


LOOPBACK = "udp://127.0.0.1:0"
EXAMPLE = ROOT / "deploy" / "calibration" / "example_hand.toml"


@pytest.fixture
def driver(receiver: Receiver, clock: Clock) -> Iterator[PalmDriver]:
    with PalmDriver(LOOPBACK, clock=clock) as driver:
        yield driver


def test_packets_of_another_kind_of_palm_are_dropped(
    driver: PalmDriver, receiver: Receiver
) -> None:
    for one, two in zip(datagrams(2), datagrams(2, Palm.PALM_0230), strict=True):
        receiver.send(one, two)
    readings = tactile(driver.read_ready())
    assert np.array_equal([reading.counts for reading in readings], sweeps_of(2))
    assert driver.stream.counters.other_palms == 2 * ROUND


def test_the_driver_rests_until_two_cycles_before_a_rounds_end(
    driver: PalmDriver, receiver: Receiver, clock: Clock
) -> None:
    assert driver.fileno() is not None
    receiver.send(datagrams(1)[0])
    driver.read_ready()
    assert driver.fileno() is None  # 13 packets to go
    assert driver.due_ns() == clock.now_ns + 11 * MS
    clock.now_ns += 11 * MS
    assert driver.fileno() is not None
    assert driver.due_ns() == clock.now_ns + (10 * ROUND - 11) * MS
    clock.now_ns += (10 * ROUND - 12) * MS
    driver.read_ready()
    assert driver.due_ns() == clock.now_ns + MS, "it also wakes to notice silence"


def test_joint_readings_are_calibrated_and_come_every_10_ms(
    receiver: Receiver, clock: Clock
) -> None:
    readings = []
    with PalmDriver(LOOPBACK, calibration=EXAMPLE, clock=clock) as driver:
        for data in datagrams(72)[:1000]:
            receiver.send(data)
            readings += joints(driver.read_ready())
            clock.now_ns += MS
    counters = driver.stream.counters
    assert len(readings) == counters.joint_readings == pytest.approx(100, abs=1)
    assert counters.bad_angles == 0
    assert counters.impossible_angles == 2 * len(readings)  # another hand's raw values
    assert [reading.seq for reading in readings] == list(range(len(readings)))
    angles = dict(zip(readings[0].names, readings[0].position_rad, strict=True))
    # Raw 1303 of the snapshot, by hand from the table of hand 378, noise of one count.
    expected_deg = 45 + 22.5 * (1942 - 1303) / (1942 - 1247)
    assert np.degrees(angles["FFJ1"]) == pytest.approx(expected_deg, abs=0.05)
    assert np.isnan(angles["MFJ1"])


def test_raw_values_over_12_bits_are_counted_as_bad_angles() -> None:
    stream, packet = PalmStream(FINGERS, calibration=EXAMPLE), packets(1)[0]
    bad = dataclasses.replace(packet, sensors=(4096,) * len(packet.sensors))
    stream.receive(bad.to_bytes(), 0)
    assert stream.counters.bad_angles == 5, "those of all joints in the file"


def test_a_wrong_calibration_keeps_the_driver_from_opening(tmp_path: Path) -> None:
    path = tmp_path / "hand.toml"
    path.write_text("version = 1\n[joints]\nLFJ1 = [[22361, 0.0], [649, 90.0]]\n")
    driver = PalmDriver(LOOPBACK, calibration=path)
    with pytest.raises(CalibrationError, match=r"hand\.toml: LFJ1: raw 22361"):
        driver.open()
    assert driver.fileno() is None
