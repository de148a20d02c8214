"""Palm packets for tests: made by the twin or by hand, played through the parts that judge them."""

from __future__ import annotations

import socket
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np
import pytest

from graspd.drivers.base import ElectrodeFault, JointReading, Reading, TactileReading
from graspd.drivers.datagrams.joints import JointStreamDriver
from graspd.drivers.datagrams.tactile import TactileStreamDriver
from graspd.drivers.palm.packet import Palm, PalmCounters, PalmPacket
from graspd.drivers.palm.stream import PalmDriver, PalmStream
from graspd.drivers.twins.datagrams import PalmTwin
from graspd.drivers.udp import Datagram, DatagramReceiver
from tests.drivers.one_sweep import sweeps_of, tactile
from tests.kit.clock import Clock

FINGERS = ("ff", "mf", "th")
MS = 1_000_000
ROUND = 14


class DatagramClock(Clock):
    """A clock that also says how old datagrams are."""

    def __init__(self) -> None:
        super().__init__()
        self.age_ns = 0
        """Age of each datagram that is received, ns."""

    def rule(self, patch: pytest.MonkeyPatch) -> None:
        """Let datagrams be as old as this clock says: the kernel's stamps tell when a busy machine
        sent them."""
        receive = DatagramReceiver.receive

        def aged(receiver: DatagramReceiver, most: int) -> Iterator[Datagram]:
            for datagram in receive(receiver, most):
                yield datagram._replace(age_ns=self.age_ns)

        patch.setattr(DatagramReceiver, "receive", aged)


@dataclass
class Played:
    """What came out of a stream."""

    counters: PalmCounters
    readings: list[TactileReading] = field(default_factory=list)

    def sound(self) -> list[TactileReading]:
        return [reading for reading in self.readings if not reading.faults.any()]


def play(cycles: Iterable[Sequence[bytes]], fingers: Sequence[str] = FINGERS) -> Played:
    """Datagrams by the millisecond through a stream, as the driver does it."""
    stream = PalmStream(fingers)
    played = Played(stream.counters)
    for cycle, datagrams in enumerate(cycles):
        for data in datagrams:
            played.readings += tactile(stream.receive(data, cycle * MS) or ())
    return played


def packets(number: int) -> list[PalmPacket]:
    """Packets of rounds of `sweeps_of`."""
    return list(PalmTwin(sweeps_of(number)).packets())


def datagrams(rounds: int, palm: Palm = Palm.PALM_0220) -> list[bytes]:
    return [packet.to_bytes() for packet in PalmTwin(sweeps_of(rounds), palm=palm).packets()]


def play_packets(stream: Iterable[PalmPacket | None]) -> Played:
    """One packet per millisecond; None is one that does not come."""
    return play([] if packet is None else [packet.to_bytes()] for packet in stream)


def flags(reading: TactileReading, fault: ElectrodeFault) -> list[list[int]]:
    """(finger, electrode) pairs, from 0, with this fault."""
    found: list[list[int]] = np.argwhere(reading.faults & np.uint8(fault) != 0).tolist()
    return found


class Sender:
    """Sends datagrams to a driver from a socket of its own."""

    def __init__(self, driver: PalmDriver | JointStreamDriver | TactileStreamDriver) -> None:
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        assert driver.port is not None
        self.target = ("127.0.0.1", driver.port)

    @property
    def port(self) -> int:
        """Its own, once it has sent."""
        port: int = self.socket.getsockname()[1]
        return port

    def send(self, *datagrams: bytes) -> None:
        for data in datagrams:
            self.socket.sendto(data, self.target)

    def __enter__(self) -> Sender:
        return self

    def __exit__(self, *_: object) -> None:
        self.socket.close()


def joints(readings: Iterable[Reading]) -> list[JointReading]:
    return [reading for reading in readings if isinstance(reading, JointReading)]
