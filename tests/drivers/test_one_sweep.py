"""No reading of any driver mixes two sweeps, whatever is lost, doubled, late, or begins anew.

What boards must number and how long links may hold frames back, so that this holds, say
`deploy/bridge/PROTOCOL.md`, `deploy/can/PROTOCOL.md` and, of palms, `deploy/CONNECT.md`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from graspd.drivers.base import Reading
from graspd.drivers.biotac import SEQUENCES
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
from tests.drivers.one_sweep import (
    Step,
    Unit,
    arrivals,
    counts_of,
    expect_one_sweep,
    number_of,
    plans,
)
from tests.drivers.spi.bridge_bench import T0, greeted, hello

FINGERS = ("ff", "mf", "th")
MS = 1_000_000
BASE_ID = 0x100
SILENT_NS = 110 * MS
"""How long a board says nothing after a reset, as deploy/can/PROTOCOL.md asks."""
WORDS = [word(count) for count in range(4096)]
ROUND = 14
PACKETS = [
    packet.to_bytes()
    for packet in PalmTwin(counts_of(number_of(at)) for at in range(600)).packets()
]
"""More rounds than the longest plan has, and some for other starts."""


def sample(unit: Unit, channels: Sequence[int]) -> CanFrame:
    """One channel of three sensors, in the order of a sequence."""
    sweep, slot = divmod(unit.index, len(channels))
    words = WORDS[number_of(sweep, unit.boot)] * 3
    return CanFrame(BASE_ID, encode_sample(channels[slot], words))


Feed = Callable[[Unit], Sequence[Reading]]


def palm(first: int) -> Feed:
    """A relay that was started again goes on in any round."""
    stream = PalmStream(FINGERS)

    def feed(unit: Unit) -> Sequence[Reading]:
        at = first + unit.index + 37 * unit.boot
        return stream.receive(PACKETS[at % len(PACKETS)], unit.at * MS) or ()

    return feed


def samples(sequence: str) -> Callable[[int], Feed]:
    def begin(_first: int) -> Feed:
        stream = CanStream("bus", FINGERS, arbitration_id=BASE_ID, sequence=sequence)
        return lambda unit: stream.push(sample(unit, SEQUENCES[sequence]), unit.at * SLOT_NS)

    return begin


def bus_log(_first: int) -> Feed:
    """Through the lines of a log, which must tell no other story than the bus."""
    log = CanLog([Path("bus.log")], FINGERS, arbitration_id=BASE_ID, sequence="electrodes")

    def feed(unit: Unit) -> Sequence[Reading]:
        frame = sample(unit, SEQUENCES["electrodes"])
        logged = parse(line_of(frame, unit.at * SLOT_NS, "can0"))
        assert logged is not None
        assert logged.t_ns is not None
        assert logged.frame is not None
        return log.feed(logged.t_ns, logged.frame)

    return feed


def spi_sweep(unit: Unit) -> bytes:
    words = np.full((24, 3), int.from_bytes(WORDS[number_of(unit.index, unit.boot)]), np.uint16)
    tick = 2000 + unit.index * 1000
    return encode(Sweep(unit.index, tick, tick + 1900, 7, words))


def bridge(_first: int) -> Feed:
    """Through a conversation."""
    conversation = greeted()

    def feed(unit: Unit) -> Sequence[Reading]:
        nonlocal conversation
        if conversation.link.state is LinkState.WAITING:  # the clock of a new start falls back
            conversation = greeted()
        return conversation.receive(spi_sweep(unit), T0 + (unit.at + 10) * MS)

    return feed


def bridge_log(_first: int) -> Feed:
    """Through the records of a log, which must tell no other story than the line."""
    log = SerialLog([Path("line.serial")], FINGERS)

    def feed(event: LineEvent, data: bytes, t_ns: int) -> list[Reading]:
        records = parse_records(FrameParser(), encode_records(event, t_ns, data))
        return [reading for record in records for reading in log.feed(*record)]

    for nonce in (1, 2):
        feed(LineEvent.SENT, encode(Ping(nonce)), T0)
        feed(LineEvent.RECEIVED, encode(hello(nonce, 1000)), T0)
    return lambda unit: feed(LineEvent.RECEIVED, spi_sweep(unit), T0 + (unit.at + 10) * MS)


def messages(_first: int) -> Feed:
    stream = TactileStream(FINGERS, "right")

    def feed(unit: Unit) -> Sequence[Reading]:
        counts = counts_of(number_of(unit.index, unit.boot)).tolist()
        by_finger = dict(zip(FINGERS, counts, strict=True))
        data = write_message(Stamp(unit.index, None), counts=by_finger)
        return stream.receive(data, unit.at * MS) or ()

    return feed


@dataclass(frozen=True)
class Assembler:
    """A link whose driver assembles sweeps of units."""

    begin: Callable[[int], Feed]
    units: int
    """Units of a sweep."""
    silent: int
    """Units that a board is silent after a start."""
    late_max: int = 3
    examples: int = 80
    steady_sweeps: int = 1
    """Undisturbed sweeps at the beginning."""


ASSEMBLERS = {
    "bridge": Assembler(bridge, 1, silent=11),
    "log of a bridge": Assembler(bridge_log, 1, silent=11),
    "datagrams": Assembler(messages, 1, silent=11),
    "palm": Assembler(palm, ROUND, silent=25, steady_sweeps=2),  # it may begin within a round
    "log of samples": Assembler(
        bus_log,
        24,
        silent=SILENT_NS // SLOT_NS + 1,
        steady_sweeps=3,
        examples=20,  # its stream is that of samples
    ),
    # A board without a pause, of which two sweeps in a row have come.
    **{
        f"samples, {sequence}": Assembler(
            samples(sequence),
            len(channels),
            silent=len(channels),
            steady_sweeps=3,
            examples=40,
        )
        for sequence, channels in SEQUENCES.items()
    },
}


@pytest.mark.parametrize("name", ASSEMBLERS)
def test_no_reading_mixes_two_sweeps(name: str) -> None:
    assembler = ASSEMBLERS[name]

    @settings(max_examples=assembler.examples)
    @given(
        plans(assembler.units, assembler.steady_sweeps),
        st.sampled_from([0, 5 * ROUND + 3, (1 << 16) - 9]),
    )
    def holds(plan: list[Step], first: int) -> None:
        feed, sound = assembler.begin(first), 0
        for unit in arrivals(plan, assembler.silent, assembler.late_max):
            sound += expect_one_sweep(feed(unit))
        assert sound, "the undisturbed sweeps at the beginning are read"

    holds()


@settings(max_examples=60)
@given(plans(1))
def test_joint_messages_are_whole_and_never_go_back(
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
