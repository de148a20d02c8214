"""Palm packets as a target of `tests.bench.fuzz`.

They have no checksum, so damage that leaves a plausible packet is a packet. What is promised: no
exception, no growth, no count outside 0..4095 in a reading, and the next good packet is read as it
was sent.
"""

from __future__ import annotations

import itertools
import random

from graspd.drivers.base import COUNT_MAX, FINGERS
from graspd.drivers.palm.packet import CAN_RECORD_BYTES, Palm, PalmPacket, parse_packet
from graspd.drivers.palm.stream import PalmStream
from graspd.drivers.twins.palm import PalmTwin
from tests.bench.fuzz import Target
from tests.drivers.twins.signals import GeneratedContact

CYCLE_NS = 1_000_000
ROUNDS = 4
PACKETS_KEPT = 14

_PACKETS = [
    (packet.to_bytes() + appended, packet)
    for palm, appended in itertools.product(Palm, (b"", bytes(CAN_RECORD_BYTES)))
    for packet in PalmTwin(itertools.islice(GeneratedContact(), ROUNDS), palm=palm).packets()
]


def _packet(rng: random.Random) -> tuple[bytes, PalmPacket]:
    return rng.choice(_PACKETS)


class _Palm:
    """Packets, and behind them the rounds, which must bear whatever the parser lets through."""

    def __init__(self) -> None:
        self._stream = PalmStream(FINGERS)
        self._t_ns = 0
        self._fed = 0

    def feed(self, chunk: bytes) -> list[PalmPacket]:
        self._fed += 1
        self._t_ns += CYCLE_NS * (40 if self._fed % 100 == 0 else 1)
        packet = parse_packet(chunk, self._stream.counters)
        if packet is None:
            return []
        for reading in self._stream.push(packet, self._t_ns):
            if reading.counts.max() > COUNT_MAX:
                raise ValueError(f"{reading.counts} has values that are no counts")
        if self._fed % 1000 == 0:
            self._stream.interrupt()
        return [packet]

    @property
    def held_bytes(self) -> int:
        return sum(packet is not None for packet in self._stream.packets)


def _is_a_packet(packet: PalmPacket) -> bool:
    return packet.command == 1 and len(packet.sensors) == 37 and len(packet.tactile) == 5


PALM = Target(
    name="palm",
    frame=_packet,
    parser=_Palm,
    held_max=PACKETS_KEPT,
    detects_damage=False,
    is_sound=_is_a_packet,
)
