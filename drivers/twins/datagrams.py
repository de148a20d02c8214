"""Twins that send UDP datagrams: a Shadow hand's palm, and streams of counts and of angles."""

from __future__ import annotations

import itertools
import math
import socket
import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator, Sequence

import numpy as np

from graspd.biotac import FINGERS
from graspd.drivers.datagrams.joints import JointMessage
from graspd.drivers.datagrams.messages import Stamp, write_message
from graspd.drivers.palm.packet import (
    CHANNELS,
    COMMAND_SENSOR_DATA,
    CYCLE_NS,
    ROUND,
    VALID_ALL,
    Channel,
    Palm,
    PalmPacket,
    TactileSlot,
)
from graspd.drivers.twins import NAP_MAX_NS
from graspd.drivers.twins.faults import LinkFaultInjector, LinkFaults
from graspd.drivers.twins.grasps.grasps import Counts
from graspd.drivers.udp import Endpoint

SENSORS_AT_REST = (
    *(1303, 1574, 3205, 1780, 1382, 1523, 3164, 1938, 904, 1332, 2977, 1706),
    *(1730, 1434, 3060, 1853, 1955, 1814, 2132, 2294, 2496, 4029, 1668, 2931, 1768, 1377),
    *range(26, 37),
)
"""Raw sensor words of a real hand at rest (Shadow's documentation)."""
HALL_WORDS = 26
"""Number of Hall sensors, the first words, which get noise of up to one count."""
OTHER_COUNTS = {"PDC": 2779, "TAC": 2006, "TDC": 2247}
PAC_COUNT = 2048
ABSENT_WORDS = {"PDC": -22072 & 0xFFFF, "TAC": 32570, "TDC": 0}
"""Words of a finger without a sensor, from a real recording; its electrodes are 0."""
OUTAGE_NS = 600_000_000
"""Time that a broken link is silent, ns; the sender continues meanwhile."""
LATER_VERSION_BYTES = 4
"""Bytes by which packets of a later kind of palm are longer."""

JOINTS = ("FFJ3", "MFJ3", "THJ5")
RATE_HZ = 100.0
"""Messages of joints a second, and by default of counts."""
SWING_S = 4.0
SWING_RAD = 0.2
MIDDLE_RAD = 0.4
"""Middle of each joint's swing, rad. Each joint lags a little behind the one before it."""

BEHIND_MAX_NS = 100_000_000
"""Longest delay that a sender makes up for, ns; after a longer one its schedule starts again."""


class DatagramTwin(ABC):
    """Base of twins that send UDP datagrams at a steady pace, one a cycle."""

    period_ns: int
    """Time between two cycles, ns."""

    def __init__(self, faults: LinkFaults) -> None:
        self._faults = faults
        self._injector = LinkFaultInjector(faults)
        self.injected = self._injector.injected
        """Number of faults by name; `silenced`: datagrams made while the link was broken."""
        self._stalled_ns = 0
        """Time for which the twin did not run, ns, as on a busy computer; its sender's clock did
        run."""

    @abstractmethod
    def datagrams(self) -> Iterator[bytes]:
        """Yield the datagram of each cycle, without faults of the link."""

    def cycles(self) -> Iterator[list[bytes]]:
        """Yield the datagrams of each cycle, with faults of the link; last those held back."""
        silent = 0
        for data in self.datagrams():
            if silent:
                silent -= 1
                self.injected["silenced"] += 1
                yield []
            elif self._injector.breaks_here():
                silent = OUTAGE_NS // self.period_ns
                yield [*self._injector.flush(), data[: len(data) // 2]]
            else:
                yield self._injector.spoil(data)
        yield self._injector.flush()

    def serve(self, target: str, stop: threading.Event) -> None:
        """Send until `stop` is set or the data end. `target`: `udp://ADDRESS:PORT`, anything else
        raises `ValueError`."""
        endpoint = Endpoint.parse(target)
        with socket.socket(endpoint.family, socket.SOCK_DGRAM) as sender:
            due_ns, cycles = time.monotonic_ns(), self.cycles()
            while not stop.is_set():
                behind_ns = time.monotonic_ns() - due_ns
                if behind_ns < 0:
                    time.sleep(min(-behind_ns, NAP_MAX_NS) / 1e9)
                    continue
                if behind_ns > BEHIND_MAX_NS:
                    due_ns += behind_ns
                    self._stalled_ns += behind_ns
                due_ns += self.period_ns
                datagrams = next(cycles, None)
                if datagrams is None:
                    return
                for datagram in datagrams:
                    sender.sendto(datagram, (endpoint.address, endpoint.port))


class PalmTwin(DatagramTwin):
    """Send counts, shape (fingers, 24) for each round of 14 packets, as a palm does.

    `stuck_clock`: the palm always answers the same request. Fingers that are not in `fingers`, or
    unplugged by a fault, have the words of an absent sensor; only the former are marked invalid.
    """

    period_ns = CYCLE_NS

    def __init__(
        self,
        counts: Iterable[Counts],
        fingers: Sequence[str] = ("ff", "mf", "th"),
        *,
        palm: Palm = Palm.PALM_0220,
        faults: LinkFaults = LinkFaults(),  # noqa: B008 (immutable)
        seed: int = 0,
    ) -> None:
        """`fingers`: finger of each row of the counts. `seed`: of the noise of the Hall sensors.
        Raises `ValueError` for a fault that datagrams cannot have."""
        faults.refuse("the palm", "one_byte_at_a_time")
        super().__init__(faults)
        self._counts = iter(counts)
        self._rows = {finger: row for row, finger in enumerate(fingers)}
        self._palm = palm
        self._random = np.random.default_rng(seed)
        self._dead = frozenset(faults.dead_electrodes)

    def packets(self) -> Iterator[PalmPacket]:
        """Yield the palm's packets, without faults of the link."""
        for counts in self._counts:
            for position in range(ROUND):
                yield self._packet(position, counts)

    def datagrams(self) -> Iterator[bytes]:
        later = bytes(LATER_VERSION_BYTES) if self._faults.wrong_version else b""
        for packet in self.packets():
            yield packet.to_bytes() + later

    def _packet(self, position: int, counts: Counts) -> PalmPacket:
        sensors = np.array(SENSORS_AT_REST)
        sensors[:HALL_WORDS] += self._random.integers(-1, 2, HALL_WORDS)
        asked = 0 if self._faults.stuck_clock else position
        fitted = sum(1 << FINGERS.index(finger) for finger in self._rows)
        return PalmPacket(
            palm=self._palm,
            command=COMMAND_SENSOR_DATA,
            sensors=tuple(sensors.tolist()),
            which_motors=position % 2,
            tactile_type=2 * asked + 1,
            tactile_valid=fitted,
            tactile=tuple(self._slot(finger, asked, counts) for finger in FINGERS),
        )

    def _slot(self, finger: str, position: int, counts: Counts) -> TactileSlot:
        first, second = (self._value(finger, channel, counts) for channel in CHANNELS[position])
        valid = VALID_ALL if finger in self._rows else 0
        pac_0, pac_1 = (PAC_COUNT + self._random.integers(-12, 13, 2)).tolist() if valid else (0, 0)
        return TactileSlot(pac_0, pac_1, first, valid, second)

    def _value(self, finger: str, channel: Channel | None, counts: Counts) -> int:
        row = self._rows.get(finger)
        absent = row is None or row in self._faults.unplugged_fingers
        if channel is None:
            return 0
        if channel.electrode is None:
            return (ABSENT_WORDS if absent else OTHER_COUNTS)[channel.name]
        if row is None or absent or (row, channel.electrode) in self._dead:
            return 0
        return int(counts[row, channel.electrode])


class MessageTwin(DatagramTwin):
    """Base of twins that send JSON messages; `stuck_clock`: all have one number and time."""

    period_ns = round(1e9 / RATE_HZ)

    def _stamps(self) -> Iterator[Stamp]:
        if self._faults.stuck_clock:
            yield from itertools.repeat(Stamp(0, 0.0))
        for number in itertools.count():
            yield Stamp(number, (number * self.period_ns + self._stalled_ns) / 1e9)


class JointTwin(MessageTwin):
    """Send messages of joints that swing slowly."""

    def __init__(self, faults: LinkFaults = LinkFaults()) -> None:  # noqa: B008 (immutable)
        """Raises `ValueError` for a fault that messages of joints cannot have."""
        faults.refuse("the joint stream", "burst_frames", "one_byte_at_a_time", "wrong_version")
        faults.refuse("the joint stream", "dead_electrodes", "unplugged_fingers")
        super().__init__(faults)

    def datagrams(self) -> Iterator[bytes]:
        behind = 0.1 * np.arange(len(JOINTS))
        for seq, stamp in enumerate(self._stamps()):
            phase = 2.0 * math.pi * seq / RATE_HZ / SWING_S
            angles = MIDDLE_RAD + SWING_RAD * np.sin(phase - behind)
            yield JointMessage(stamp, JOINTS, angles).to_bytes()


class TactileTwin(MessageTwin):
    """Send counts, shape (fingers, 24) for each message; an unplugged finger has all counts 0."""

    def __init__(
        self,
        counts: Iterable[Counts],
        fingers: Sequence[str] = ("ff", "mf", "th"),
        *,
        rate_hz: float = RATE_HZ,
        faults: LinkFaults = LinkFaults(),  # noqa: B008 (immutable)
    ) -> None:
        """`fingers`: finger of each row of the counts. `rate_hz`: messages per second. Raises
        `ValueError` for a fault that messages of counts cannot have."""
        faults.refuse("the tactile stream", "one_byte_at_a_time", "wrong_version")
        super().__init__(faults)
        self.period_ns = round(1e9 / rate_hz)
        self._counts = iter(counts)
        self._fingers = tuple(fingers)

    def datagrams(self) -> Iterator[bytes]:
        dead = tuple(zip(*self._faults.dead_electrodes, strict=True))
        for stamp, sound in zip(self._stamps(), self._counts, strict=False):
            counts = sound.copy()
            counts[list(self._faults.unplugged_fingers)] = 0
            if dead:
                counts[dead] = 0
            by_finger = dict(zip(self._fingers, counts.tolist(), strict=True))
            yield write_message(stamp, counts=by_finger)
