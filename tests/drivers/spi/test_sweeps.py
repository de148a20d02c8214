"""Sweeps of the serial bridge: what becomes of words, sensors and numbers."""

from __future__ import annotations

import numpy as np
import pytest

from graspd.drivers.base import ElectrodeFault
from graspd.drivers.biotac import E1, PAC, SEQUENCES, TDC
from graspd.drivers.spi.sweeps import BridgeCounters, DeviceClock, SweepDecoder
from tests.drivers.spi.bridge_bench import T0, greeted, hear, hello, opened, sweep, words


@pytest.mark.parametrize(
    "channels", [SEQUENCES["electrodes"], SEQUENCES["all"], SEQUENCES["interleaved"]]
)
def test_a_sweep_becomes_a_reading_by_slot_and_sensor(channels: tuple[int, ...]) -> None:
    conversation = greeted(hello(0, channels=channels))
    read = words(1000, len(channels))
    (reading,) = hear(conversation, sweep(0, 100, read=read), T0)
    assert reading.seq == 0
    assert not reading.faults.any()
    for electrode in range(24):
        slot = channels.index(E1 + electrode)
        assert reading.counts[:, electrode].tolist() == [1000 + 10 * slot + i for i in range(3)]


@pytest.mark.parametrize(
    ("sensors", "columns"),
    [(("th", "mf", "ff"), [2, 1, 0]), (("mf", "th", "ff"), [2, 0, 1])],
)
def test_the_wiring_order_changes_no_reading(sensors: tuple[str, ...], columns: list[int]) -> None:
    conversation = greeted(sensors=sensors)
    present = 7 & ~(1 << columns[2])
    (reading,) = hear(conversation, sweep(0, 100, present), T0)
    assert reading.counts[:2, 0].tolist() == [1000 + column for column in columns[:2]]
    assert (reading.faults[2] == ElectrodeFault.MISSING).all()
    assert not reading.faults[:2].any()
    assert not reading.counts[2].any(), "whatever its words say"
    counters = conversation.counters
    assert (counters.absent_sensors, counters.unplugged_words) == (1, 0)


def test_electrodes_that_are_not_in_the_sequence_are_missing() -> None:
    conversation = greeted(hello(0, channels=(PAC, E1 + 5, TDC, E1)))
    (reading,) = hear(conversation, sweep(0, 100, read=words(1000, 4)), T0)
    there = [0, 5]
    assert reading.counts[1, there].tolist() == [1031, 1011]
    assert not reading.faults[:, there].any()
    missing = np.delete(reading.faults, there, axis=1)
    assert (missing == ElectrodeFault.MISSING).all()
    counters = conversation.counters
    assert (counters.faulty_readings, counters.unplugged_words) == (1, 0)


def test_a_board_may_have_more_sensors_than_fingers_are_named() -> None:
    conversation = greeted(hello(0, sensors=5))
    (reading,) = hear(conversation, sweep(0, 100, 31, words(1000, 24, 5)), T0)
    assert reading.counts[:, 0].tolist() == [1000, 1001, 1002]
    assert not reading.faults.any()


def test_a_sweep_from_before_stop_is_stale() -> None:
    conversation = greeted(hello(0, tick=50_000))
    sent = (sweep(4711, 49_000), sweep(0, 51_000), sweep(1, 61_000))
    made = [reading.seq for each in sent for reading in hear(conversation, each, T0)]
    assert made == [0, 1]
    counters = conversation.counters
    assert (counters.stale_sweeps, counters.missed_readings) == (1, 0)
    never_started = opened()
    assert hear(never_started, sweep(0, 51_000), T0) == []
    assert never_started.counters.stale_sweeps == 1


def test_a_sweep_unlike_the_hello_is_bad() -> None:
    conversation = greeted()
    assert hear(conversation, sweep(0, 10_000, read=words(slots=23)), T0) == []
    assert conversation.counters.bad_frames == 1


def test_a_bridge_that_is_started_again_interrupts() -> None:
    counters, interrupted = BridgeCounters(), []
    for _ in range(2):
        decoder = SweepDecoder(hello(0), (0, 1, 2), counters, DeviceClock(1_000_000, 0, 0, 0))
        for number in range(3):
            reading = decoder.reading(sweep(number, number * 10_000), (number + 1) * 10_000_000)
            assert reading is not None
            interrupted.append(reading.interrupted)
    assert interrupted == [False, False, False, True, False, False]
