"""The CAN bridge against its twin: count for count, fault for fault, and links that come back."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import can
import pytest

from graspd.drivers.base import DriverError, LinkError, TactileReading
from graspd.drivers.biotac import SEQUENCES
from graspd.drivers.can.driver import CanBridgeDriver
from graspd.drivers.can.formats import CanFormat
from graspd.drivers.link import LinkState
from graspd.drivers.twins.grasps.grasps import Counts
from tests.drivers.can.can_standin import (
    TwinLink,
    bridge,
    channel,
    contact,
    message,
    sweep_messages,
)
from tests.drivers.can.can_words import truth
from tests.drivers.one_sweep import tactile
from tests.kit.clock import Clock

MS = 1_000_000
FORMATS = list(CanFormat)


def assert_same(readings: Sequence[TactileReading], counts: Sequence[Counts]) -> None:
    assert len(readings) == len(counts)
    for reading, expected in zip(readings, counts, strict=True):
        assert not reading.faults.any()
        assert (reading.counts == expected).all()
    assert [reading.seq for reading in readings] == list(range(len(readings)))


@pytest.mark.parametrize("frame_format", FORMATS)
@pytest.mark.parametrize("sequence", sorted(SEQUENCES))
def test_every_sweep_arrives_count_for_count(frame_format: str, sequence: str) -> None:
    counts = contact(200)
    link = TwinLink(frame_format, sequence)
    with link.driver:
        link.send(counts)
        assert_same(link.readings, counts)
        assert link.driver.period_ns == pytest.approx(10 * MS, abs=1000)
        assert link.driver.stream.link.state is LinkState.UP
        assert link.driver.counters.missed_readings == 0
        assert link.driver.counters.frames == link.driver.counters.accepted_frames


def test_frames_that_are_not_ours_are_counted_and_harm_nothing() -> None:
    where = channel()
    ours = sweep_messages()
    strange: list[tuple[can.Message, str]] = [
        (message(bytes(ours[5].data), is_extended_id=True), "foreign_frames"),
        (message(), "wrong_length_frames"),
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
        assert driver.stream.link.state is LinkState.UP
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


@pytest.mark.parametrize("identifier", [0, (1 << 29) - 1])
def test_the_lowest_and_the_highest_id_are_taken(identifier: int) -> None:
    assert CanBridgeDriver("virtual", "x", arbitration_id=identifier).name == "can"


def test_a_bit_rate_that_socketcan_would_ignore_is_refused() -> None:
    with pytest.raises(ValueError, match="ip link set"):
        CanBridgeDriver("socketcan", "can0", bitrate=1_000_000)


def test_an_interface_that_python_can_does_not_have_is_no_matter_of_trying_again() -> None:
    driver = CanBridgeDriver("carrier_pigeon", "x")
    with pytest.raises(DriverError, match="carrier_pigeon") as raised:
        driver.open()
    assert not isinstance(raised.value, LinkError)
    assert driver.stream.link.state is LinkState.CLOSED
