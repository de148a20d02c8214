"""The CAN bridge against its twin: count for count, fault for fault, and links that come back."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Mapping, Sequence
from typing import Any

import can
import numpy as np
import pytest

from drivers.base import Driver, DriverError, LinkError, TactileReading
from drivers.can_bridge import CanBridgeDriver
from drivers.can_formats import CanFormat
from drivers.link import LinkState
from drivers.sweep import SEQUENCES
from drivers.twins.can import SAMPLE_ID, CanTwin
from drivers.twins.faults import LinkFaults
from drivers.twins.grasps import Counts, GeneratedContact, recorded_counts
from tests.conftest import data_dir
from tests.drivers.can_standin import (
    bridge,
    channel,
    contact,
    message,
    sweep_messages,
    tactile,
)
from tests.drivers.can_words import Clock, truth

MS = 1_000_000
GROUP = "239.74.163.2"
"""The IPv4 group that python-can's documentation uses."""
FORMATS = list(CanFormat)


def assert_same(readings: Sequence[TactileReading], counts: Sequence[Counts]) -> None:
    assert len(readings) == len(counts)
    for reading, expected in zip(readings, counts, strict=True):
        assert not reading.faults.any()
        assert (reading.counts == expected).all()
    assert [reading.seq for reading in readings] == list(range(len(readings)))


class Link:
    """Driver and twins on one virtual bus and one clock that tests move, sweep by sweep."""

    def __init__(self, frame_format: str, sequence: str = "electrodes") -> None:
        self.clock = Clock()
        self.where, self.format, self.sequence = channel(), frame_format, sequence
        self.driver = bridge(
            self.where, frame_format, sequence=sequence, clock=self.clock, wall_clock=self.clock
        )
        self.readings: list[TactileReading] = []
        self.sweeps_sent = 65_500
        """The number of sweep frames wraps in the middle of the longer tests."""

    def send(self, counts: Sequence[Counts], faults: LinkFaults = LinkFaults()) -> CanTwin:  # noqa: B008
        """Send sweeps at 100 Hz; the frames of each arrive at once."""
        twin = CanTwin(
            "virtual",
            self.where,
            iter(counts),
            format=self.format,
            sequence=self.sequence,
            first_sweep=self.sweeps_sent,
            faults=faults,
            bus_options={"preserve_timestamps": True},
            clock=self.clock,
        )
        self.sweeps_sent += len(counts)
        with twin:
            for _ in counts:
                self.clock.now_ns += 10 * MS
                twin.send_sweep()
                self.readings += tactile(self.driver.read_ready())
            twin.flush()
            self.readings += tactile(self.driver.read_ready())
        assert twin.unsent == 0
        return twin


def test_the_bridge_is_a_driver() -> None:
    driver: Driver = bridge(channel())
    assert driver.name == "can"
    assert not driver.exhausted
    assert driver.fileno() is driver.due_ns() is driver.period_ns is None
    assert driver.describe()["link"] == "closed"
    driver.close()
    with pytest.raises(RuntimeError, match="not open"):
        driver.read_ready()


@pytest.mark.parametrize("frame_format", FORMATS)
@pytest.mark.parametrize("sequence", sorted(SEQUENCES))
def test_a_recording_arrives_count_for_count(frame_format: str, sequence: str) -> None:
    folder = data_dir()
    path = folder / "untouched" / "untouched.csv" if folder is not None else None
    if path is None or not path.exists():
        pytest.skip("the recording untouched.csv is neither in ../shared/data nor in $GRASPD_DATA")
    counts = list(recorded_counts(path))
    assert len(counts) == 977
    link = Link(frame_format, sequence)
    with link.driver:
        link.send(counts)
        assert_same(link.readings, counts)
        assert link.driver.period_ns == pytest.approx(10 * MS, abs=1000)
        assert link.driver.link_state is LinkState.UP
        assert link.driver.counters.missed_readings == 0
        assert link.driver.counters.frames == link.driver.counters.accepted_frames


@pytest.mark.parametrize("frame_format", FORMATS)
def test_a_recording_arrives_over_udp_multicast(frame_format: str) -> None:
    options = {"port": 43000 + os.getpid() % 2000}
    counts = contact(100)
    driver = CanBridgeDriver(
        "udp_multicast",
        GROUP,
        format=frame_format,
        arbitration_id=SAMPLE_ID,
        bus_options=options,
    )
    twin = CanTwin(
        "udp_multicast",
        GROUP,
        iter(counts),
        format=frame_format,
        arbitration_id=SAMPLE_ID,
        bus_options=options,
    )
    readings: list[TactileReading] = []
    with driver:
        if driver.link_state is LinkState.WAITING:
            pytest.skip(f"no multicast here: {driver.last_error}")
        with twin:
            for at in range(len(counts)):
                assert twin.send_sweep()
                deadline = time.monotonic() + 1.0
                while len(readings) <= at and time.monotonic() < deadline:
                    readings += tactile(driver.read_ready())
                if not driver.counters.frames:
                    pytest.skip("multicast does not come back on this machine")
        now_ns = time.monotonic_ns()
        assert all(0 <= now_ns - reading.t_ns < 5_000 * MS for reading in readings)
    assert len(readings) == len(counts)
    for reading, expected in zip(readings, counts, strict=True):
        assert (reading.counts == expected).all()


SOUND = LinkFaults()


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
    link = Link(frame_format)
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
    if frame_format == "syntouch":
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
    link = Link("syntouch")
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


@pytest.mark.parametrize("seed", range(3))
def test_flipped_bits_in_sweep_frames_are_recovered_from(seed: int) -> None:
    link = Link("sweep_fd")
    after = contact(20, 5)
    with link.driver:
        link.send(contact(2))
        link.send(contact(200), LinkFaults(bit_flip_probability=0.05, seed=seed))
        link.clock.now_ns += 3_000 * MS
        link.send(after)
    assert_same_tail(link.readings, after[1:])


@pytest.mark.parametrize("frame_format", FORMATS)
def test_an_unplugged_sensor_is_missing_and_the_others_are_not(frame_format: str) -> None:
    link = Link(frame_format)
    with link.driver:
        link.send(contact(20), LinkFaults(unplugged_fingers=(1,)))
    assert len(link.readings) == 20
    for reading, expected in zip(link.readings, contact(20), strict=True):
        assert (reading.faults[1] != 0).all()
        assert not reading.counts[1].any()
        assert not reading.faults[[0, 2]].any()
        assert (reading.counts[[0, 2]] == expected[[0, 2]]).all()
    assert link.driver.counters.unplugged_words == 20 * 24


@pytest.mark.parametrize("frame_format", FORMATS)
def test_a_dead_electrode_reads_zero(frame_format: str) -> None:
    link = Link(frame_format)
    with link.driver:
        link.send(contact(5), LinkFaults(dead_electrodes=((2, 17),)))
    for reading in link.readings:
        assert reading.counts[2, 17] == 0
        assert np.count_nonzero(reading.counts) == 3 * 24 - 1
        assert not reading.faults.any()


def test_another_version_of_the_layout_gives_no_reading() -> None:
    link = Link("sweep_fd")
    with link.driver:
        link.send(contact(5), LinkFaults(wrong_version=True))
        assert link.readings == []
        assert link.driver.counters.unknown_versions == 15
        assert link.driver.link_state is LinkState.GREETING


def test_a_stuck_clock_is_counted() -> None:
    link = Link("sweep_fd")
    with link.driver:
        link.send(contact(5), LinkFaults(stuck_clock=True))
    assert link.driver.counters.stuck_ticks == 3 * 4
    assert len(link.readings) == 5


@pytest.mark.parametrize("frame_format", FORMATS)
def test_sweeps_that_nobody_sent_in_between_are_missed(frame_format: str) -> None:
    link = Link(frame_format)
    with link.driver:
        link.send(contact(20))
        link.clock.now_ns += 30 * MS
        link.send(contact(1))
    counters = link.driver.counters
    missed = 3 if frame_format == "syntouch" else 0  # sweep frames say that none was made
    assert counters.missed_readings == missed
    assert link.readings[-1].seq == 20 + missed


def test_sweep_frames_that_start_anew_are_followed() -> None:
    link = Link("sweep_fd")
    with link.driver:
        link.send(contact(20))
        link.sweeps_sent = 5_000
        link.send(contact(3))
    assert len(link.readings) == 23
    assert link.driver.counters.restarts == 1


def test_frames_that_are_not_ours_are_counted_and_harm_nothing() -> None:
    where = channel()
    ours = sweep_messages()
    strange: list[tuple[can.Message, str]] = [
        (message(b"\1\2\3", 0x7FF), "foreign_frames"),
        (message(bytes(ours[5].data), 0x12345, is_extended_id=True), "foreign_frames"),
        (message(bytes(ours[5].data), is_extended_id=True), "foreign_frames"),
        (message(bytes(ours[5].data[:6])), "wrong_length_frames"),
        (message(bytes(ours[5].data) + b"\0"), "wrong_length_frames"),
        (message(), "wrong_length_frames"),
        (message(b"\xa1" + bytes(6)), "unknown_commands"),
        (message(is_remote_frame=True), "remote_frames"),
        (message(bytes(8), 0x80, is_error_frame=True), "error_frames"),
        (message(bytes(range(64)), is_fd=True), "malformed_frames"),
    ]
    driver = bridge(where)
    with driver, can.Bus(interface="virtual", channel=where, ignore_config=True) as bus:
        for at, (sent, _) in enumerate(strange):
            bus.send(ours[at])
            bus.send(sent)
        for sent in ours[len(strange) :]:
            bus.send(sent)
        (reading,) = tactile(driver.read_ready())
        assert (reading.counts == truth(0)).all()
        assert not reading.faults.any()
        counted = driver.counters.as_dict()
        names = [name for _, name in strange]
        assert {name: counted[name] for name in names} == {
            name: names.count(name) for name in names
        }
        assert counted["frames"] == len(ours) + len(strange)
        assert driver.link_state is LinkState.UP
        assert driver.last_error == "bus error"


@pytest.mark.parametrize(
    "options",
    [
        {"format": "brand_new"},
        {"fingers": ()},
        {"fingers": ("ff", "ff")},
        {"fingers": ("ff", "thumb")},
        {"fingers": ("ff", "mf", "rf", "th")},
        {"sequence": "backwards"},
        {"arbitration_id": -1},
        {"arbitration_id": 1 << 29},
        {"data_length": 6},
        {"data_length": 9},
        {"format": "sweep_fd", "data_length": 7},
        {"format": "sweep_fd", "arbitration_id": 0x7FE},
        {"data_bitrate": 5_000_000},
        {"format": "sweep_fd", "data_bitrate": 5_000_000},
    ],
)
def test_arguments_out_of_range_are_refused(options: Mapping[str, Any]) -> None:
    with pytest.raises(ValueError, match=r"\w"):
        CanBridgeDriver("virtual", "x", **options)


def test_a_bit_rate_that_socketcan_would_ignore_is_refused() -> None:
    with pytest.raises(ValueError, match="ip link set"):
        CanBridgeDriver("socketcan", "can0", bitrate=1_000_000)


def test_an_interface_that_python_can_does_not_have_is_no_matter_of_trying_again() -> None:
    driver = CanBridgeDriver("carrier_pigeon", "x")
    with pytest.raises(DriverError, match="carrier_pigeon") as raised:
        driver.open()
    assert not isinstance(raised.value, LinkError)
    assert driver.link_state is LinkState.CLOSED


@pytest.mark.parametrize(
    "options",
    [
        {"format": "brand_new"},
        {"sequence": "backwards"},
        {"rate_hz": 0.0},
        {"rate_hz": 1e6},
        {"faults": LinkFaults(one_byte_at_a_time=True)},
        {"faults": LinkFaults(stuck_clock=True)},
        {"faults": LinkFaults(wrong_version=True)},
    ],
)
def test_a_twin_refuses_what_its_format_cannot_show(options: Mapping[str, Any]) -> None:
    with pytest.raises(ValueError, match=r"\w"):
        CanTwin("virtual", "x", iter(()), **options)


def test_a_twin_serves_at_its_rate_until_stopped() -> None:
    where, stop = channel(), threading.Event()
    twin = CanTwin("virtual", where, GeneratedContact(), rate_hz=100.0, sequence="electrodes")
    readings: list[TactileReading] = []
    with bridge(where) as driver, twin:
        server = threading.Thread(target=twin.serve, args=(stop,))
        server.start()
        try:
            deadline_s = time.monotonic() + 10.0
            while len(readings) < 30 and time.monotonic() < deadline_s:
                time.sleep(0.001)
                readings += tactile(driver.read_ready())
        finally:
            stop.set()
            server.join()
        period_ns = driver.period_ns
    assert len(readings) >= 30
    assert period_ns == pytest.approx(10 * MS, rel=0.2)
    elapsed_ns = readings[29].t_ns - readings[0].t_ns
    assert elapsed_ns == pytest.approx(290 * MS, rel=0.2)


def test_a_twin_ends_with_its_counts_and_mends_its_link() -> None:
    faults = LinkFaults(disconnect_every_frames=30)
    where = channel()
    twin = CanTwin(
        "virtual", where, iter(contact(2)), sequence="electrodes", faults=faults, rate_hz=1000.0
    )
    with bridge(where) as driver, twin:
        twin.serve(threading.Event())
        readings = tactile(driver.read_ready())
    missing = [np.flatnonzero(reading.faults[0]).tolist() for reading in readings]
    assert missing == [[], list(range(5, 24)), list(range(6))]
    assert twin.injected["disconnect"] == 1
    assert twin.frames_sent == 47
