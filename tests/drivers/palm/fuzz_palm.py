"""Palm packets and joint messages as targets of `tests.bench.fuzz`.

Neither has a checksum, so damage that leaves a plausible packet is a packet. What is promised: no
exception, no growth, no count outside 0..4095 in a reading, no angle that is not one, and the next
good packet or message is read as it was sent.
"""

from __future__ import annotations

import itertools
import math
import random

from graspd.drivers.base import COUNT_MAX, FINGERS
from graspd.drivers.hand import JOINTS
from graspd.drivers.joints.message import (
    ANGLE_MAX_RAD,
    JointMessage,
    JointStream,
)
from graspd.drivers.palm.packet import CAN_RECORD_BYTES, Palm, PalmPacket, parse_packet
from graspd.drivers.palm.stream import PalmStream
from graspd.drivers.twins.palm import PalmTwin
from tests.bench.fuzz import Target
from tests.drivers.twins.signals import GeneratedContact

CYCLE_NS = 1_000_000
ROUNDS = 4
PACKETS_KEPT = 14
MESSAGES = 2000
"""To draw from: to make one up takes longer than all that is tried with it."""
NAMES = sorted(JOINTS)

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

Angles = tuple[int | None, float | None, tuple[tuple[str, float | None], ...]]


def _comparable(message: JointMessage) -> Angles:
    angles = [None if math.isnan(angle) else angle for angle in message.position_rad.tolist()]
    return message.seq, message.t_s, tuple(zip(message.names, angles, strict=True))


def _made_up(rng: random.Random) -> tuple[bytes, Angles]:
    names = tuple(rng.sample(NAMES, rng.randint(1, 28)))
    angles = [rng.uniform(-1.5, 1.5) for _ in names]
    seq = rng.choice([None, rng.getrandbits(20)])
    t_s = rng.choice([None, rng.uniform(0.0, 1e6)])
    text = ",".join(f'"{name}": {angle!r}' for name, angle in zip(names, angles, strict=True))
    head = "" if seq is None else f'"seq": {seq}, '
    head += "" if t_s is None else f'"t": {t_s!r}, '
    wire = f'{{{head}"joints": {{{text}}}}}'.encode()
    return wire, (seq, t_s, tuple(zip(names, angles, strict=True)))


_MESSAGES = [_made_up(random.Random(seed)) for seed in range(MESSAGES)]


def _message(rng: random.Random) -> tuple[bytes, Angles]:
    return rng.choice(_MESSAGES)


class _Joints:
    """Messages, and behind them their order."""

    def __init__(self) -> None:
        self._stream = JointStream()

    def feed(self, chunk: bytes) -> list[Angles]:
        message = self._stream.parse(chunk)
        if message is None:
            return []
        self._stream.admits(message)
        return [_comparable(message)]

    @property
    def held_bytes(self) -> int:
        return 0


def _are_angles(message: Angles) -> bool:
    return all(
        name in JOINTS and (angle is None or abs(angle) <= ANGLE_MAX_RAD)
        for name, angle in message[2]
    )


JOINT_STREAM = Target(
    name="joints",
    frame=_message,
    parser=_Joints,
    held_max=64,
    detects_damage=False,
    is_sound=_are_angles,
)
