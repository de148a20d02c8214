"""The CAN bridge: options that it refuses, foreign frames, and flipped bits of its twin."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from typing import Any

import can
import pytest

from graspd.drivers.base import DriverError
from graspd.drivers.can.driver import CanBridgeDriver
from graspd.drivers.link import LinkState
from graspd.drivers.twins.can import SAMPLE_ID
from tests.drivers.can.can_standin import (
    channel,
    message,
    sweep_messages,
)
from tests.drivers.one_sweep import counts_of, tactile
from tests.kit.clock import Clock


def test_a_package_that_is_missing_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("can.interfaces.udp_multicast.utils.msgpack", None)
    says = rf"more packages: run {sys.executable} -m pip install 'python-can\[multicast\]'$"
    with pytest.raises(DriverError, match=says) as raised:
        CanBridgeDriver("udp_multicast", "239.74.163.2").open()
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize(
    ("interface", "says"),
    [
        ("remote", r"pip install 'python-can\[remote\]'$"),
        ("gs_usb", r"'gs_usb' needs more packages: run .* -m pip install 'python-can\[gs-usb\]'$"),
        ("slcan", r"pip install 'python-can\[serial\]'$"),
    ],
)
def test_an_interface_without_its_package_is_refused(
    monkeypatch: pytest.MonkeyPatch, interface: str, says: str
) -> None:
    monkeypatch.setattr("graspd.drivers.can.interfaces.find_spec", lambda _name: None)
    with pytest.raises(ValueError, match=says):
        CanBridgeDriver(interface, "can0")


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
    options: dict[str, Any] = {"arbitration_id": SAMPLE_ID, "sequence": "electrodes"}
    driver = CanBridgeDriver("virtual", where, clock=clock, wall_clock=clock, **options)
    with driver, can.Bus(interface="virtual", channel=where, ignore_config=True) as bus:
        for at, (sent, _) in enumerate(strange):
            bus.send(ours[at])
            bus.send(sent)
        for sent in ours[len(strange) :]:
            bus.send(sent)
        (reading,) = tactile(driver.read_ready())
        assert (reading.counts == counts_of(0)).all()
        assert not reading.faults.any()
        counted = driver.counters.as_dict()
        names = [name for _, name in strange]
        assert {name: counted[name] for name in names} == {
            name: names.count(name) for name in names
        }
        assert counted["frames"] == len(ours) + len(strange) - 1  # one is not classic
        assert driver.stream.link.state is LinkState.UP
        assert driver.stream.last_error == "bus error"


@pytest.mark.parametrize(
    ("interface", "options", "says"),
    [
        ("virtual", {"fingers": ("ff", "mf", "rf", "th")}, "cannot carry 4 sensors"),
        ("virtual", {"data_length": 6}, "6 bytes"),
        ("virtual", {"data_length": 9}, "9 bytes"),
        ("virtual", {"options": {"no_such_option": 1}}, "no_such_option"),
        ("socketcan", {"bitrate": 1_000_000}, "ip link set"),
    ],
)
def test_arguments_that_can_never_be_are_refused(
    interface: str, options: Mapping[str, Any], says: str
) -> None:
    with pytest.raises(ValueError, match=says):
        CanBridgeDriver(interface, "can0", **options)
