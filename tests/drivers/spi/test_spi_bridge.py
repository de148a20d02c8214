"""The driver of the serial bridge: what becomes of sweeps, words, damage and time."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest

from drivers.base import ElectrodeFault
from drivers.biotac import E1, PAC, SEQUENCE_ALL, SEQUENCE_INTERLEAVED, TDC
from drivers.link import LinkState
from drivers.spi.driver import SpiBridgeDriver
from drivers.spi.messages import DIGEST, Stop, encode_frame
from tests.drivers.spi.bridge_bench import FINGERS, Rig, ScriptedBridge, hello, sweep, take, words
from tests.kit.clock import Clock


@pytest.fixture
def rig() -> Iterator[Rig]:
    clock = Clock()
    with ScriptedBridge() as bridge:
        driver = SpiBridgeDriver(bridge.port, FINGERS, clock=clock)
        yield Rig(bridge, driver, clock)
        driver.close()


def test_a_sweep_becomes_a_reading_by_slot_and_sensor(rig: Rig) -> None:
    rig.greet()
    rig.wait(10)
    rig.bridge.send(sweep(0, 100))
    (reading,) = take(rig.driver, rig.bridge)
    assert rig.driver.link_state is LinkState.UP
    assert rig.driver.conversation.link.reason is None
    described = {name: fact.text for name, fact in rig.driver.describe().items()}
    assert described["board"] == "b"
    assert described["sensors"] == "BTSP-1, BTSP-1, BTSP-1"
    assert described["sequence"] == "24 samples at 100.0 Hz"
    assert rig.driver.serials == dict.fromkeys(("ff", "mf", "th"), "BTSP-1")
    assert described["clock"] == "trusted"
    assert reading.seq == 0
    assert not reading.faults.any()
    expected = [[1000 + 10 * electrode + finger for electrode in range(24)] for finger in range(3)]
    assert reading.counts.tolist() == expected


@pytest.mark.parametrize(
    ("sensors", "columns"),
    [(("th", "mf", "ff"), [2, 1, 0]), (("mf", "th", "ff"), [2, 0, 1])],
)
def test_the_order_of_the_wiring_does_not_matter_to_the_reading(
    sensors: tuple[str, ...], columns: list[int]
) -> None:
    clock = Clock()
    with ScriptedBridge() as bridge:
        driver = SpiBridgeDriver(bridge.port, FINGERS, sensors=sensors, clock=clock)
        rig = Rig(bridge, driver, clock)
        rig.greet()
        absent = columns[2]
        bridge.send(sweep(0, 100, present=7 & ~(1 << absent)))
        (reading,) = take(driver, bridge)
        driver.close()
    assert reading.counts[:2, 0].tolist() == [1000 + column for column in columns[:2]]
    assert (reading.faults[2] == ElectrodeFault.MISSING).all()
    assert not reading.faults[:2].any()


@pytest.mark.parametrize("sensors", [("ff", "mf"), ("ff", "ff", "mf", "th"), ("ff", "mf", "toe")])
def test_sensors_that_do_not_hold_the_fingers_are_refused(sensors: tuple[str, ...]) -> None:
    with pytest.raises(ValueError, match="fingers"):
        SpiBridgeDriver("/dev/null", FINGERS, sensors=sensors)


@pytest.mark.parametrize("channels", [SEQUENCE_ALL, SEQUENCE_INTERLEAVED])
def test_any_sequence_finds_its_electrodes(rig: Rig, channels: tuple[int, ...]) -> None:
    rig.greet(hello(0, channels=channels))
    read = words(1000, len(channels))
    rig.bridge.send(sweep(0, 100, read=read))
    (reading,) = take(rig.driver, rig.bridge)
    assert not reading.faults.any()
    for electrode in range(24):
        slot = channels.index(E1 + electrode)
        assert reading.counts[:, electrode].tolist() == [1000 + 10 * slot + i for i in range(3)]


def test_electrodes_that_are_not_in_the_sequence_are_missing(rig: Rig) -> None:
    rig.greet(hello(0, channels=(PAC, E1 + 5, TDC, E1)))
    rig.bridge.send(sweep(0, 100, read=words(1000, 4)))
    (reading,) = take(rig.driver, rig.bridge)
    there = [0, 5]
    assert reading.counts[1, there].tolist() == [1031, 1011]
    assert not reading.faults[:, there].any()
    missing = np.delete(reading.faults, there, axis=1)
    assert (missing == ElectrodeFault.MISSING).all()
    counters = rig.driver.counters
    assert (counters.faulty_readings, counters.unplugged_words) == (1, 0)


def test_an_absent_sensor_is_missing_whatever_its_words_say(rig: Rig) -> None:
    rig.greet()
    rig.bridge.send(sweep(0, 100, present=0b101))
    (reading,) = take(rig.driver, rig.bridge)
    assert (reading.faults[1] == ElectrodeFault.MISSING).all()
    assert not reading.faults[[0, 2]].any()
    assert not reading.counts[1].any()
    counters = rig.driver.counters
    assert (counters.absent_sensors, counters.unplugged_words) == (1, 0)


def test_bad_words_are_flagged_and_counted_and_never_a_count(rig: Rig) -> None:
    read = words()
    read[3, 0] = 0xA52D  # insufficient sampling delay
    read[4, 1] ^= 0x0100
    read[5, 2] = 0xFFFF
    read[6, 2] = 0x0000
    rig.greet()
    rig.bridge.send(sweep(0, 100, read=read))
    (reading,) = take(rig.driver, rig.bridge)
    assert reading.faults[0, 3] == ElectrodeFault.ERROR_WORD
    assert reading.faults[1, 4] == ElectrodeFault.PARITY
    assert reading.faults[2, [5, 6]].tolist() == [ElectrodeFault.MISSING] * 2
    assert np.count_nonzero(reading.faults) == 4
    assert not reading.counts[reading.faults != 0].any()
    counters = rig.driver.counters
    assert (counters.error_words, counters.parity_words, counters.unplugged_words) == (1, 1, 2)


def test_a_board_may_have_more_sensors_than_fingers_are_named(rig: Rig) -> None:
    rig.greet(hello(0, sensors=5))
    rig.bridge.send(sweep(0, 100, present=31, read=words(1000, 24, 5)))
    (reading,) = take(rig.driver, rig.bridge)
    assert reading.counts[:, 0].tolist() == [1000, 1001, 1002]
    assert not reading.faults.any()


def test_the_sweep_that_was_under_way_at_stop_is_not_taken_for_a_new_one(rig: Rig) -> None:
    rig.greet(hello(0, tick=50_000))
    rig.bridge.send(sweep(4711, 49_000), sweep(0, 51_000), sweep(1, 61_000))
    assert [reading.seq for reading in take(rig.driver, rig.bridge)] == [0, 1]
    counters = rig.driver.counters
    assert (counters.stale_sweeps, counters.missed_readings) == (1, 0)


def test_whole_frames_that_make_no_sense_are_counted(rig: Rig) -> None:
    rig.greet()
    rig.bridge.send(
        encode_frame(0x02, b"short", DIGEST),
        encode_frame(0x77, b"of another kind", DIGEST),
        Stop(),
        sweep(0, 10_000, read=words(slots=23)),
    )
    assert take(rig.driver, rig.bridge) == []
    counters = rig.driver.counters
    assert (counters.bad_frames, counters.unknown_frames) == (2, 2)
