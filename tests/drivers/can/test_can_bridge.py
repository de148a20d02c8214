"""The CAN bridge against its twin: count for count, fault for fault, and links that come back."""

from __future__ import annotations

import socket
import time
from collections.abc import Mapping, Sequence
from typing import Any

import can
import pytest

from drivers.base import Driver, DriverError, LinkError, TactileReading
from drivers.biotac import SEQUENCES
from drivers.can.driver import CanBridgeDriver
from drivers.can.formats import CanFormat
from drivers.link import LinkState
from drivers.twins.can import SAMPLE_ID, CanTwin
from drivers.twins.grasps.grasps import Counts, recorded_counts
from tests.conftest import data_dir
from tests.drivers.can.can_standin import (
    TwinLink,
    bridge,
    bus_options,
    channel,
    contact,
    message,
    sweep_messages,
    tactile,
)
from tests.drivers.can.can_words import Clock, truth
from tests.ports import free_port

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


def test_the_bridge_is_a_driver() -> None:
    driver: Driver = bridge(channel())
    assert driver.name == "can"
    assert not driver.exhausted
    assert driver.fileno() is driver.due_ns() is driver.period_ns is None
    assert driver.describe()["link"].text == "closed"
    driver.close()
    with pytest.raises(RuntimeError, match="not open"):
        driver.read_ready()


@pytest.mark.parametrize("frame_format", FORMATS)
@pytest.mark.parametrize("sequence", sorted(SEQUENCES))
def test_a_recording_arrives_count_for_count(frame_format: str, sequence: str) -> None:
    folder = data_dir()
    path = folder / "untouched" / "untouched.csv" if folder is not None else None
    if path is None or not path.exists():
        pytest.skip("the recording untouched.csv is not there: set $GRASPD_DATA")
    counts = list(recorded_counts(path))
    assert len(counts) == 977
    link = TwinLink(frame_format, sequence)
    with link.driver:
        link.send(counts)
        assert_same(link.readings, counts)
        assert link.driver.period_ns == pytest.approx(10 * MS, abs=1000)
        assert link.driver.link_state is LinkState.UP
        assert link.driver.counters.missed_readings == 0
        assert link.driver.counters.frames == link.driver.counters.accepted_frames


@pytest.mark.parametrize("frame_format", FORMATS)
def test_a_recording_arrives_over_udp_multicast(frame_format: str) -> None:
    counts, clock = contact(100), Clock()
    with bus_options(port=free_port(socket.SOCK_DGRAM)):
        readings = over_multicast(counts, frame_format, clock=clock, wall_clock=clock)
        began_ns = time.monotonic_ns()
        timed = over_multicast(counts[:3], frame_format)
    assert len(readings) == len(counts)
    for reading, expected in zip(readings, counts, strict=True):
        assert (reading.counts == expected).all()
    # Here a busy machine may cut sweeps.
    assert all(began_ns <= reading.t_ns <= time.monotonic_ns() for reading in timed)


def over_multicast(
    counts: Sequence[Counts],
    frame_format: str,
    **clocks: Any,  # noqa: ANN401
) -> list[TactileReading]:
    """At least as many readings as counts, each sent when the one before has come."""
    options: dict[str, Any] = {"format": frame_format, "arbitration_id": SAMPLE_ID}
    twin = CanTwin("udp_multicast", GROUP, iter(counts), **options)
    readings: list[TactileReading] = []
    with CanBridgeDriver("udp_multicast", GROUP, **options, **clocks) as driver:
        if driver.link_state is LinkState.WAITING:
            pytest.skip(f"no multicast here: {driver.stream.last_error}")
        with twin:
            for at in range(len(counts)):
                assert twin.send_sweep()
                deadline_s = time.monotonic() + (100.0 if driver.counters.frames else 1.0)
                while len(readings) <= at and time.monotonic() < deadline_s:
                    readings += tactile(driver.read_ready())
                if not driver.counters.frames:
                    pytest.skip("multicast does not come back on this machine")
    return readings


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
    clock = Clock()  # a stalled machine would cut the sweep
    driver = bridge(where, clock=clock, wall_clock=clock)
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
        assert driver.stream.last_error == "bus error"


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
        {"format": "sweep_fd", "arbitration_id": 0x7FC},
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
