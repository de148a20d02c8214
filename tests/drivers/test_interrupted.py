"""After a restart of the sender or a loss of the link, a reading says that it does not follow."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from graspd.drivers.base import Reading, TactileReading
from graspd.drivers.biotac import SEQUENCES, encode_word
from graspd.drivers.can.frames import CanCounters
from graspd.drivers.can.samples import SampleAssembler
from graspd.drivers.datagrams.joints import JointMessage, JointStream
from graspd.drivers.datagrams.messages import Stamp, write_message
from graspd.drivers.datagrams.tactile import TactileStream
from graspd.drivers.recordings.csv_player import ReplayDriver
from graspd.drivers.spi.sweeps import BridgeCounters, DeviceClock, SweepDecoder
from tests.drivers.spi.bridge_bench import hello, sweep

PERIOD_NS = 10_000_000
WORDS = encode_word(2602).to_bytes(2, "big")


def interrupted(readings: list[Reading]) -> list[int]:
    """Places of the readings that do not follow the one before."""
    return [place for place, reading in enumerate(readings) if reading.interrupted]


def test_samples_after_a_lost_bus_interrupt() -> None:
    order = SEQUENCES["electrodes"]
    assembler = SampleAssembler(1, order, CanCounters(), (0,))
    readings: list[Reading] = []
    assembler.interrupt()
    for number in range(12):
        if number == 6:
            assembler.interrupt()
        for place, channel in enumerate(order):
            t_ns = number * PERIOD_NS + place * PERIOD_NS // 24
            readings += assembler.push(channel, WORDS, t_ns)
    assert interrupted(readings) == [6]


def test_a_bridge_that_is_started_again_interrupts() -> None:
    counters, readings = BridgeCounters(), []
    for _ in range(2):
        decoder = SweepDecoder(hello(0), (0, 1, 2), counters, DeviceClock(1_000_000, 0, 0, 0))
        for number in range(3):
            reading = decoder.reading(sweep(number, number * 10_000), (number + 1) * PERIOD_NS)
            assert reading is not None
            readings.append(reading)
    assert interrupted(list(readings)) == [3]


def test_joint_messages_of_a_new_start_interrupt() -> None:
    stream, readings = JointStream(), []
    for seq in (*range(50, 60), *range(20), 5000):
        message = JointMessage(Stamp(seq, None), ("FFJ3",), np.zeros(1))
        readings += stream.receive(message.to_bytes(), 0) or []
    # Ten of the old numbers are dropped; 5000 is more than a thousand ahead.
    assert interrupted(list(readings)) == [10, 20]


def test_counts_after_a_new_start_or_loss_interrupt() -> None:
    stream, readings = TactileStream(("ff",), "right"), list[Reading]()
    for place, seq in enumerate((*range(50, 60), *range(20), 5000, 5001)):
        if place == 31:
            stream.interrupt()
        data = write_message(Stamp(seq, None), counts={"ff": [2602] * 24})
        readings += stream.receive(data, 0) or []
    assert interrupted(readings) == [10, 20, 21]
    assert stream.counters.restarts == 2


def test_each_turn_of_a_looped_stream_interrupts(tmp_path: Path) -> None:
    table = tmp_path / "stream.csv"
    columns = ",".join(f"ff_biotac_{electrode}" for electrode in range(1, 25))
    rows = "".join(f"{row / 100}," + ",".join(["2000"] * 24) + "\n" for row in range(4))
    table.write_text(f"t,{columns}\n{rows}")
    readings: list[Reading] = []
    with ReplayDriver([table], ("ff",), speed=None, loop=True) as driver:
        while len(readings) < 10:
            readings += driver.read_ready()
    assert all(isinstance(reading, TactileReading) for reading in readings)
    assert interrupted(readings) == [4, 8]
