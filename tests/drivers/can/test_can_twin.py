"""The CAN twin: what it refuses, how it paces, and how it says that it cannot work here."""

from __future__ import annotations

import sys
import threading
from collections.abc import Callable, Mapping
from typing import Any

import can
import pytest

from graspd.drivers.base import DriverError, TactileReading
from graspd.drivers.can.driver import CanBridgeDriver
from graspd.drivers.twins.can import CanTwin
from graspd.drivers.twins.faults import LinkFaults
from tests.drivers.can.can_standin import bridge, channel
from tests.drivers.one_sweep import tactile
from tests.drivers.twins.signals import GeneratedContact
from tests.kit.clock import Clock

MS = 1_000_000


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


def test_a_twin_serves_at_its_rate_until_stopped(monkeypatch: pytest.MonkeyPatch) -> None:
    where, stop, clock = channel(), threading.Event(), Clock()
    twin = CanTwin(
        "virtual", where, GeneratedContact(), rate_hz=100.0, sequence="electrodes", clock=clock
    )
    readings: list[TactileReading] = []
    with bridge(where, clock=clock, wall_clock=clock) as driver, twin:

        def sleep(seconds: float) -> None:
            readings.extend(tactile(driver.read_ready()))
            clock.now_ns += round(seconds * 1e9)
            if len(readings) >= 30:
                stop.set()

        monkeypatch.setattr("graspd.drivers.twins.can.time.sleep", sleep)
        twin.serve(stop)
        period_ns = driver.period_ns
    assert 30 <= len(readings) <= 31
    assert period_ns == pytest.approx(10 * MS, rel=0.2)
    elapsed_ns = readings[29].t_ns - readings[0].t_ns
    assert elapsed_ns == pytest.approx(290 * MS, rel=0.2)


@pytest.mark.parametrize("make", [CanTwin, CanBridgeDriver], ids=["twin", "driver"])
def test_a_package_that_is_missing_is_named(
    monkeypatch: pytest.MonkeyPatch, make: Callable[..., CanTwin | CanBridgeDriver]
) -> None:
    monkeypatch.setattr("can.interfaces.udp_multicast.utils.msgpack", None)
    arguments = (iter(()),) if make is CanTwin else ()
    with pytest.raises(
        DriverError,
        match=rf"needs the package msgpack: run {sys.executable} -m pip install msgpack$",
    ) as raised:
        make("udp_multicast", "239.74.163.2", *arguments).open()
    assert "\n" not in str(raised.value)
    assert not isinstance(raised.value, NotImplementedError)


@pytest.mark.parametrize(
    ("says", "package"),
    [
        ("Cannot import module x for CAN interface 'x': No module named 'nican'", "nican"),
        ("The serial module is not installed", "pyserial"),
        ("No module named 'gs_usb.gs_usb'", "gs_usb"),
    ],
)
def test_packages_are_named_as_they_are_installed(
    monkeypatch: pytest.MonkeyPatch, says: str, package: str
) -> None:
    def refuse(**_: object) -> object:
        raise can.CanInterfaceNotImplementedError(says)

    monkeypatch.setattr("graspd.drivers.can.bus.can.Bus", refuse)
    with pytest.raises(DriverError, match=f"-m pip install {package}$"):
        CanTwin("slcan", "/dev/null", iter(())).open()
