"""Each link's assembler: no reading mixes sweeps, none looks newer than it is, no loss is hidden.

`deploy/bridge/PROTOCOL.md`, `deploy/can/PROTOCOL.md` and, for palms, `deploy/CONNECT.md` say what
boards must number and how long links may hold frames back, so that this holds.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from numpy.typing import NDArray

from graspd.drivers.base import DriverCounters, ElectrodeFault, Reading, TactileReading
from graspd.drivers.biotac import E1, SEQUENCES
from graspd.drivers.can.frames import CanFrame, encode_sample
from graspd.drivers.can.stream import CanStream
from graspd.drivers.datagrams.joints import JointMessage, JointStream
from graspd.drivers.datagrams.messages import Stamp, write_message
from graspd.drivers.datagrams.tactile import TactileStream
from graspd.drivers.link import LinkState
from graspd.drivers.palm.stream import PalmStream
from graspd.drivers.recordings.can_log import CanLog, line_of
from graspd.drivers.recordings.candump import parse
from graspd.drivers.recordings.serial_log import SerialLog, encode_records, parse_records
from graspd.drivers.spi.conversation import LineEvent
from graspd.drivers.spi.messages import FrameParser, Ping, Sweep, encode
from graspd.drivers.twins.datagrams import PalmTwin
from tests.drivers.can.can_words import SLOT_NS, word
from tests.drivers.one_sweep import FINGERS as WIDTH
from tests.drivers.one_sweep import (
    NUMBERS,
    Step,
    Unit,
    arrivals,
    counts_of,
    losses,
    number_in,
    plans,
    tactile,
)
from tests.drivers.spi.bridge_bench import T0, greeted, hello

FINGERS = ("ff", "mf", "th")
MS = 1_000_000
BASE_ID = 0x100
SILENT_NS = 110 * MS
"""How long a board says nothing after a reset, as deploy/can/PROTOCOL.md asks."""
WORDS = [word(count) for count in range(4096)]
SEQ_FIRST = (1 << 32) - 9
"""Number of a bridge's first sweep, soon before it wraps."""
SWEEPS_PER_BOOT = 700
"""Number that each restart of a board adds to the numbers of its sweeps."""

Feed = Callable[[Unit, int, int], Sequence[Reading]]
"""Give a driver a unit, with the number of its sweep and the time, ns; return the readings."""
Link = tuple[Feed, DriverCounters]
COPIES = ("duplicates", "duplicate_frames", "duplicate_packets", "old_messages")
"""Names of the links' counters of repeated units."""


@cache
def packets() -> list[bytes]:
    """Packets of a palm, in more rounds than the longest plan has."""
    twin = PalmTwin(counts_of(number) for number in range(600))
    return [packet.to_bytes() for packet in twin.packets()]


def words_of(number: int) -> NDArray[np.uint16]:
    """Response words of a sweep, shape (24, 3)."""
    words = [[int.from_bytes(WORDS[count]) for count in row] for row in counts_of(number).T]
    return np.array(words, dtype=np.uint16)


def sample(number: int, slot: int, channels: Sequence[int]) -> CanFrame:
    """The frame of a slot: one channel of three sensors. `channels`: the sampling sequence."""
    channel = channels[slot % len(channels)]
    words = WORDS[2050] * WIDTH
    if channel >= E1:
        words = b"".join(WORDS[count] for count in counts_of(number)[:, channel - E1])
    return CanFrame(BASE_ID, encode_sample(channel, words))


def palm() -> Link:
    stream = PalmStream(FINGERS)

    def feed(unit: Unit, _number: int, t_ns: int) -> Sequence[Reading]:
        data = packets()[unit.index + PALM_SHIFT * unit.boot]
        return stream.receive(data, t_ns) or ()

    return feed, stream.counters


def samples(sequence: str) -> Callable[[], Link]:
    def begin() -> Link:
        stream = CanStream("bus", FINGERS, arbitration_id=BASE_ID, sequence=sequence)
        channels = SEQUENCES[sequence]

        def feed(unit: Unit, number: int, t_ns: int) -> Sequence[Reading]:
            return stream.push(sample(number, unit.index, channels), t_ns)

        return feed, stream.counters

    return begin


def bus_log() -> Link:
    """A CAN link through the lines of a log, which must give the readings of the bus."""
    log = CanLog([Path("bus.log")], FINGERS, arbitration_id=BASE_ID, sequence="electrodes")

    def feed(unit: Unit, number: int, t_ns: int) -> Sequence[Reading]:
        frame = sample(number, unit.index, SEQUENCES["electrodes"])
        logged = parse(line_of(frame, t_ns, "can0"))
        assert logged is not None
        assert logged.t_ns is not None
        assert logged.frame is not None
        return log.feed(logged.t_ns, logged.frame)

    return feed, log.counters


def spi_sweep(unit: Unit, number: int) -> bytes:
    tick = 2000 + unit.index * 1000
    return encode(
        Sweep((SEQ_FIRST + unit.index) % (1 << 32), tick, tick + 1900, 7, words_of(number))
    )


def bridge() -> Link:
    """A serial link through a `Conversation`."""
    conversation = greeted()

    def feed(unit: Unit, number: int, t_ns: int) -> Sequence[Reading]:
        nonlocal conversation
        if conversation.link.state is LinkState.WAITING:  # the clock of a new start falls back
            conversation = greeted()
        return conversation.receive(spi_sweep(unit, number), t_ns)

    return feed, conversation.counters


def bridge_log() -> Link:
    """A serial link through the records of a log, which must give the readings of the line."""
    log = SerialLog([Path("line.serial")], FINGERS)

    def play(event: LineEvent, data: bytes, t_ns: int) -> list[Reading]:
        records = parse_records(FrameParser(), encode_records(event, t_ns, data))
        return [reading for record in records for reading in log.feed(*record)]

    for nonce in (1, 2):
        play(LineEvent.SENT, encode(Ping(nonce)), T0)
        play(LineEvent.RECEIVED, encode(hello(nonce, 1000)), T0)

    def feed(unit: Unit, number: int, t_ns: int) -> Sequence[Reading]:
        return play(LineEvent.RECEIVED, spi_sweep(unit, number), t_ns)

    return feed, log.counters


def messages() -> Link:
    stream = TactileStream(FINGERS, "right")

    def feed(unit: Unit, number: int, t_ns: int) -> Sequence[Reading]:
        by_finger = dict(zip(FINGERS, counts_of(number).tolist(), strict=True))
        return stream.receive(write_message(Stamp(unit.index, None), counts=by_finger), t_ns) or ()

    return feed, stream.counters


@dataclass(frozen=True)
class Assembler:
    """A link whose driver assembles sweeps from units."""

    begin: Callable[[], Link]
    places: Sequence[Sequence[int]]
    """Electrodes, from 0, of each unit of a sweep."""
    silent: int
    """Time, in units, for which a board is silent after a restart."""
    unit_ns: int = MS
    start_ns: int = T0 + 10 * MS
    age_ns: int = 0
    """Most by which a reading's time is before the arrival of its last unit."""
    boot_units: int | None = None
    """Units by which each restart raises sweep numbers; None: those of `SWEEPS_PER_BOOT` sweeps."""
    examples: int = 80
    steady_sweeps: int = 1
    """Undisturbed sweeps at the beginning."""

    def number(self, unit: Unit) -> int:
        units = len(self.places)
        skipped = SWEEPS_PER_BOOT * units if self.boot_units is None else self.boot_units
        return (unit.index + skipped * unit.boot) // units

    def t_ns(self, unit: Unit) -> int:
        return self.start_ns + unit.at * self.unit_ns


ALL = [range(24)]
PALM_SHIFT = 37
"""Packets that a restart of the palm skips: no multiple of 14, so it begins within a round."""
PAIRS = [[], [0], *([first, first + 1] for first in range(1, 22, 2)), [23]]
"""Electrodes of each request of a round (tactile_data_type 0x0001, 0x0003 ... 0x001B)."""


def of_samples(sequence: str) -> Assembler:
    """A board on a CAN bus that samples a sequence without a pause between sweeps."""
    channels = SEQUENCES[sequence]
    places = [[channel - E1] if channel >= E1 else [] for channel in channels]
    begin, silent = samples(sequence), len(channels)
    return Assembler(begin, places, silent, SLOT_NS, steady_sweeps=3, examples=40)


ASSEMBLERS = {
    "bridge": Assembler(bridge, ALL, silent=11, age_ns=10_000 * MS),
    "log of a bridge": Assembler(bridge_log, ALL, silent=11, age_ns=10_000 * MS),
    "datagrams": Assembler(messages, ALL, silent=11),
    "palm": Assembler(palm, PAIRS, silent=25, boot_units=PALM_SHIFT, steady_sweeps=2),
    "log of samples": Assembler(
        bus_log,
        [[electrode] for electrode in range(24)],
        silent=SILENT_NS // SLOT_NS + 1,
        unit_ns=SLOT_NS,
        steady_sweeps=3,
        examples=20,  # its stream is that of samples
    ),
    **{f"samples, {sequence}": of_samples(sequence) for sequence in SEQUENCES},
}


@pytest.mark.parametrize("name", ASSEMBLERS)
def test_no_reading_mixes_sweeps_or_is_dated_after_its_data(name: str) -> None:
    assembler = ASSEMBLERS[name]

    @settings(max_examples=assembler.examples, derandomize=True)
    @given(plans(len(assembler.places), assembler.steady_sweeps))
    def holds(plan: list[Step]) -> None:
        feed, _ = assembler.begin()
        arrived_ns, sound = dict[int, list[int]](), 0
        for unit in arrivals(plan, assembler.silent):
            number, t_ns = assembler.number(unit), assembler.t_ns(unit)
            arrived_ns.setdefault(number % NUMBERS, []).append(t_ns)
            for reading in tactile(feed(unit, number, t_ns)):
                found = number_in(reading)
                if found is not None:
                    sound += 1
                    ages_ns = [at_ns - reading.t_ns for at_ns in arrived_ns[found]]
                    assert any(0 <= age_ns <= assembler.age_ns for age_ns in ages_ns)
        assert sound, "the undisturbed sweeps at the beginning are read"

    holds()


@dataclass
class Came:
    """Units and electrodes of a sweep that have arrived."""

    units: set[int] = field(default_factory=set)
    places: set[int] = field(default_factory=set)
    end_ns: int = 0
    """When the last new unit with electrodes came."""
    given_ns: int = 0
    """When the driver returned the sweep's reading."""


@pytest.mark.parametrize("name", ASSEMBLERS)
def test_each_loss_flags_its_electrodes_and_no_others(name: str) -> None:
    assembler = ASSEMBLERS[name]
    units = len(assembler.places)

    @settings(max_examples=assembler.examples, derandomize=True)
    @given(losses(units))
    def holds(plan: list[Step]) -> None:
        feed, counters = assembler.begin()
        readings, copies = list[TactileReading](), list[bool]()
        sweeps = defaultdict[int, Came](Came)
        for unit in arrivals(plan, assembler.silent):
            number, t_ns = assembler.number(unit), assembler.t_ns(unit)
            places, sweep = assembler.places[unit.index % units], sweeps[number]
            if unit.index in sweep.units:
                copies.append(bool(places))
            elif places:
                sweep.end_ns = t_ns
            sweep.units.add(unit.index)
            sweep.places.update(places)
            for reading in tactile(feed(unit, number, t_ns)):
                sweeps[reading.seq].given_ns = t_ns
                readings.append(reading)
        begun = [number for number in sorted(sweeps) if sweeps[number].places]
        read = [reading.seq for reading in readings if sweeps[reading.seq].places]
        assert read == begun[: len(read)]
        assert len(begun) - len(read) <= 1, "all but the last are over"
        for reading in readings:
            sweep = sweeps[reading.seq]
            if len(sweep.units) == units:
                assert sweep.given_ns == sweep.end_ns, "its last electrode ends a sweep"
                assert 0 <= sweep.end_ns - reading.t_ns <= assembler.age_ns
            lost = [place for place in range(24) if place not in sweep.places]
            truth = counts_of(reading.seq)
            truth[:, lost] = 0
            assert (reading.counts == truth).all()
            assert (reading.faults[:, lost] == ElectrodeFault.MISSING).all()
            assert np.count_nonzero(reading.faults) == WIDTH * len(lost)
        counted, number = counters.as_dict(), readings[-1].seq + 1
        assert counted["readings"] == len(readings)
        assert counted["missed_readings"] == number - len(readings)
        assert counted["faulty_readings"] == sum(bool(each.faults.any()) for each in readings)
        assert sum(copies) <= sum(counted.get(name, 0) for name in COPIES) <= len(copies)
        flagged = sum(np.count_nonzero(each.faults[0]) for each in readings)
        assert counted.get("lost_frames", flagged) == flagged
        lost_units = sum(units - len(sweeps[each].units) for each in range(number))
        assert counted.get("lost_packets", lost_units) == lost_units

    holds()


@settings(max_examples=60)
@given(plans(1))
def test_joint_readings_mix_no_messages_and_never_go_back(
    plan: list[Step],
) -> None:
    stream = JointStream()
    last: tuple[int, int] = (0, -1)
    for unit in arrivals(plan, silent=5):
        angle = 0.001 * (unit.index % 1000) + unit.boot / 2**20
        message = JointMessage(Stamp(unit.index, None), ("FFJ3", "MFJ3"), np.full(2, angle))
        for reading in stream.receive(message.to_bytes(), unit.at) or ():
            assert set(reading.position_rad.tolist()) == {angle}
            assert (unit.boot, unit.index) > last
            last = unit.boot, unit.index
