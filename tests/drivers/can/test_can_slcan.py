"""Adapters on a serial line, whose frames bear no trustworthy time: they are as old as can be."""

from __future__ import annotations

import os
import pty
import time
import tty
from collections.abc import Callable, Iterator

import can
import pytest

from graspd.drivers.base import Reading
from graspd.drivers.can.driver import (
    CanBridgeDriver,
)
from graspd.drivers.link import LinkState
from graspd.drivers.twins.can import SAMPLE_ID, CanTwin
from tests.drivers.can.can_standin import (
    ScriptedBus,
    contact,
    message,
    stand_in,
    sweep_messages,
    sweep_of_frames,
)
from tests.drivers.can.can_words import SLOT_NS, truth
from tests.drivers.one_sweep import tactile
from tests.kit.clock import Clock

MS = 1_000_000


@pytest.fixture
def slcan_line() -> Iterator[tuple[str, Callable[[bytes], None], Callable[[], None]]]:
    """Path of a terminal that plays an slcan adapter, a way to write to it and to unplug it."""
    near, far = pty.openpty()
    tty.setraw(far)
    path = os.ttyname(far)
    descriptors = [near, far]

    def unplug() -> None:
        while descriptors:
            os.close(descriptors.pop())

    yield path, lambda data: (os.write(near, data), None)[1], unplug
    unplug()


def test_an_slcan_adapter_is_read_and_its_unplugging_leaves_nothing_open(
    slcan_line: tuple[str, Callable[[bytes], None], Callable[[], None]],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    path, write, unplug = slcan_line
    driver = CanBridgeDriver(
        "slcan", path, arbitration_id=SAMPLE_ID, sequence="electrodes", bitrate=1_000_000
    )
    sleep, slept_s = time.sleep, []

    def noted(seconds: float) -> None:
        slept_s.append(seconds)
        sleep(seconds)

    monkeypatch.setattr(time, "sleep", noted)
    patient_until_s = time.monotonic() + 100.0
    with driver:
        assert driver.fileno() is not None
        readings: list[Reading] = []
        while not readings and time.monotonic() < patient_until_s:
            driver.read_ready()
            for frame in sweep_of_frames(0):
                write(f"t{frame.arbitration_id:03X}7{frame.data.hex().upper()}\r".encode())
                readings += driver.read_ready()
            readings = [reading for reading in tactile(readings) if not reading.faults.any()]
        assert (tactile(readings)[0].counts == truth(0)).all()
        assert sum(slept_s) < 1.5, "python-can's default sleeps two seconds"
        unplug()
        driver.read_ready()
        assert driver.stream.link.state is LinkState.WAITING
        assert driver.counters.link_losses == 1
        for _ in range(3):
            time.sleep(0.12)
            driver.read_ready()
        assert driver.counters.bus_faults >= 3


def test_data_bit_rates_reach_an_slcan_adapter(monkeypatch: pytest.MonkeyPatch) -> None:
    seen: dict[str, object] = {}
    monkeypatch.setattr("graspd.drivers.can.bus.can.Bus", lambda **options: seen.update(options))
    bus = CanBridgeDriver(
        "slcan", "/dev/null", format="sweep_fd", bitrate=1_000_000, data_bitrate=5_000_000
    )
    bus.open()
    timing = seen["timing"]
    assert isinstance(timing, can.BitTimingFd)
    assert (timing.nom_bitrate, timing.data_bitrate) == (1_000_000, 5_000_000)
    assert (timing.nom_sample_point, timing.data_sample_point) == (80.0, 81.25)  # 13 of 16
    assert timing.f_clock == 80_000_000  # CANable 2
    assert seen["sleep_after_open"] == 0.0


def paced(bus: ScriptedBus, clock: Clock, driver: CanBridgeDriver, sweeps: int) -> list[Reading]:
    """Sweeps from an adapter that is read after every sample."""
    readings: list[Reading] = []
    for sweep in range(sweeps):
        for sent in sweep_messages(sweep):
            clock.now_ns += SLOT_NS
            bus.script = [sent]
            readings += driver.read_ready()
    return readings


def unstamped(monkeypatch: pytest.MonkeyPatch, clock: Clock) -> tuple[ScriptedBus, CanBridgeDriver]:
    bus = ScriptedBus()
    stand_in(monkeypatch, lambda: bus)
    return bus, CanBridgeDriver(
        "pcan", "x", arbitration_id=SAMPLE_ID, sequence="electrodes", clock=clock
    )


def test_frames_without_a_time_are_as_old_as_they_can_be(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = Clock()
    bus, driver = unstamped(monkeypatch, clock)
    with driver:
        readings = tactile(paced(bus, clock, driver, 10))
        assert [reading.seq for reading in readings] == list(range(10))
        assert not any(reading.faults.any() for reading in readings)
        ends_ns = [10**12 + 24 * SLOT_NS * (n + 1) for n in range(10)]
        assert [end - r.t_ns for end, r in zip(ends_ns, readings, strict=True)] == [SLOT_NS] * 10


@pytest.mark.parametrize("frame_format", ["syntouch", "sweep_fd"])
def test_old_frames_make_no_fresh_reading(
    monkeypatch: pytest.MonkeyPatch, frame_format: str
) -> None:
    clock = Clock()
    bus = ScriptedBus()
    stand_in(monkeypatch, lambda: bus)
    driver = CanBridgeDriver("pcan", "x", format=frame_format, clock=clock, sequence="electrodes")
    twin = CanTwin("virtual", "x", iter(contact(3)), format=frame_format, sequence="electrodes")
    fd = frame_format == "sweep_fd"
    with driver:
        driver.read_ready()
        for _ in range(3):
            sent = twin.next_frames()
            opened_ns = clock.now_ns
            clock.now_ns += 800 * MS
            bus.script = [message(data, identifier, is_fd=fd) for identifier, data in sent]
            for reading in driver.read_ready():
                assert reading.t_ns == opened_ns
        assert driver.counters.readings == (3 if fd else 0)


def test_an_adapters_own_words_are_not_the_end_of_what_it_has(
    slcan_line: tuple[str, Callable[[bytes], None], Callable[[], None]],
) -> None:
    """python-can returns nothing for them although frames are behind them."""
    path, write, _ = slcan_line
    with CanBridgeDriver("slcan", path, arbitration_id=SAMPLE_ID) as driver:
        time.sleep(0.01)
        driver.read_ready()
        frame = sweep_of_frames(0)[0]
        write(b"z\r\a" + f"t{SAMPLE_ID:03X}7{frame.data.hex()}\r".encode())
        driver.read_ready()
        assert driver.counters.frames == 1
