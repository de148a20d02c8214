"""Palm packets for tests: made by the twin or by hand, passed through a `PalmStream`."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

import numpy as np

from graspd.drivers.base import ElectrodeFault, JointReading, Reading, TactileReading
from graspd.drivers.palm.packet import Palm, PalmCounters, PalmPacket
from graspd.drivers.palm.stream import PalmStream
from graspd.drivers.twins.datagrams import PalmTwin
from tests.drivers.one_sweep import sweeps_of, tactile

FINGERS = ("ff", "mf", "th")
MS = 1_000_000
ROUND = 14
SNAPSHOT = [
    *(1303, 1574, 3205, 1780, 1382, 1523, 3164, 1938, 904, 1332, 2977, 1706, 1730, 1434, 3060),
    *(1853, 1955, 1814, 2132, 2294, 2496, 4029, 1668, 2931, 1768, 1377, *range(26, 37)),
]
"""One record of a real hand's `sensors`, from Shadow's documentation."""


@dataclass
class Played:
    """Readings that a stream returned, and its counters."""

    counters: PalmCounters
    readings: list[TactileReading] = field(default_factory=list)


def play(cycles: Iterable[Sequence[bytes]], fingers: Sequence[str] = FINGERS) -> Played:
    """Pass the datagrams of each millisecond through a new stream, as the driver does."""
    stream = PalmStream(fingers)
    played = Played(stream.counters)
    for cycle, datagrams in enumerate(cycles):
        for data in datagrams:
            played.readings += tactile(stream.receive(data, cycle * MS) or ())
    return played


def packets(number: int) -> list[PalmPacket]:
    """Packets of `number` rounds, with the counts of `sweeps_of`."""
    return list(PalmTwin(sweeps_of(number)).packets())


def datagrams(rounds: int, palm: Palm = Palm.PALM_0220) -> list[bytes]:
    return [packet.to_bytes() for packet in PalmTwin(sweeps_of(rounds), palm=palm).packets()]


def play_packets(stream: Iterable[PalmPacket | None]) -> Played:
    """Pass one packet per millisecond through a new stream; None: a packet is lost."""
    return play([] if packet is None else [packet.to_bytes()] for packet in stream)


def flags(reading: TactileReading, fault: ElectrodeFault) -> list[list[int]]:
    """(finger, electrode) pairs, from 0, with this fault."""
    found: list[list[int]] = np.argwhere(reading.faults & np.uint8(fault) != 0).tolist()
    return found


def joints(readings: Iterable[Reading]) -> list[JointReading]:
    return [reading for reading in readings if isinstance(reading, JointReading)]
