"""The palm stream of a Shadow hand as a driver: joints and BioTacs from one packet per millisecond.

The packets come as UDP datagrams from a relay that reads the palm's EtherCAT status memory, one
packet per datagram, or from a file of packets. Palm packets have neither checksum nor sequence
number. UDP's own checksum covers the way from the relay; what is damaged before it cannot be seen
where it stays plausible, and two hands of one kind that share a relay's socket look like one: one
port per hand. Checked are: length, command, which motors, finger bits, tactile type and
its turn, sensors present, values in 0..4095, validity bits, one sender at a time, the same packet
again, silence. See `drivers.palm.packet` and `drivers.palm.rounds`.
"""

from __future__ import annotations

import dataclasses
import ipaddress
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np

from drivers.base import JointReading, Opened, Reading
from drivers.link import LinkState
from drivers.palm.file import PalmFile
from drivers.palm.packet import CYCLE_NS, PACKET_BYTES_MAX, SENSORS, Palm, PalmPacket, PalmParser
from drivers.palm.rounds import ROUND_NS, PalmSweeps, RoundCounters
from drivers.udp.link import DRAIN_MAX, DatagramLink
from drivers.udp.receiver import SCHEME, Endpoint

if TYPE_CHECKING:
    from drivers.palm.hall import Calibration

SILENCE_NS: Final = 10 * ROUND_NS
"""Without a packet for ten periods the link is lost."""
JOINT_PERIOD_S = 0.01
"""A joint reading at 100 Hz: the position of a hand has no more in it, and 1000 would be work."""
SPARE_CYCLES: Final = 2
"""The driver asks to be woken by packets again so many cycles before a round can end."""
JOINT_PERIOD_MIN_S, JOINT_PERIOD_MAX_S = 0.001, 10.0


@dataclass(slots=True)
class PalmCounters(RoundCounters):
    """What the palm driver counts. `readings` and `faulty_readings` are the tactile ones."""

    joint_readings: int = 0
    """Joint readings handed over."""
    bad_angles: int = 0
    """Angles handed over as NaN although the joint is calibrated: its raw value is no count."""
    impossible_angles: int = 0
    """Angles handed over that are out of the joint's range by more than 10 degrees."""
    other_palms: int = 0
    """Packets of another kind of palm than the first since the link came up; dropped."""
    foreign_datagrams: int = 0
    """Datagrams from another sender than the one that is listened to; dropped."""
    kernel_drops: int = 0
    """Datagrams that the kernel dropped because nobody took them in time."""
    link_losses: int = 0
    """Times that packets came and then none for ten periods."""


class PalmDriver(Opened):
    """Gives a `TactileReading` per round of 14 packets and a `JointReading` per `joint_period_s`.

    `source` is `udp://ADDRESS:PORT` to listen on, or the path of a file of packets, which is
    played in real time or, without `realtime`, at once. `fingers` picks the fingers and their
    order. Joint readings need a `calibration`, and can be switched off by `joints`. `only_from` is
    the relay's IP address, if no other may be heard. Without `heed_finger_bits` the packet's
    `tactile_valid` is ignored, for a palm that does not set it (Shadow's own driver ignores it).

    Packets must come as the palm makes them, one a millisecond. Of a relay that sends them in
    batches longer than 10 ms, rounds are flagged or counted as missed that were not.

    The constructor raises `ValueError` for an argument out of range. `open` raises `LinkError` if
    it cannot listen, `RecordingError` for a file that holds no packets and `CalibrationError` for
    a calibration with mistakes. `read_ready` raises `RecordingError` only.
    """

    name = "palm"
    period_ns: int | None = ROUND_NS

    def __init__(
        self,
        source: str | Path,
        fingers: Sequence[str] = ("ff", "mf", "th"),
        *,
        calibration: Path | None = None,
        joints: bool = True,
        joint_period_s: float = JOINT_PERIOD_S,
        only_from: str | None = None,
        heed_finger_bits: bool = True,
        realtime: bool = True,
        clock: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        if not JOINT_PERIOD_MIN_S <= joint_period_s <= JOINT_PERIOD_MAX_S:
            limits = f"{JOINT_PERIOD_MIN_S}..{JOINT_PERIOD_MAX_S}"
            raise ValueError(f"joint_period_s is {joint_period_s}, must be in {limits}")
        is_udp = str(source).startswith(SCHEME)
        self._endpoint = Endpoint.parse(str(source)) if is_udp else None
        self._path = Path(source)
        self._only_from = None if only_from is None else str(ipaddress.ip_address(only_from))
        self._fingers = tuple(fingers)
        self._heed_finger_bits = heed_finger_bits
        self._calibration_path = calibration if joints else None
        self._joint_period_ns = round(joint_period_s * 1e9)
        self._realtime = realtime
        self._clock = clock
        self._link: DatagramLink | None = None
        self._described: dict[str, str] = {}
        self._file: PalmFile | None = None
        self._reset()

    def _reset(self) -> None:
        self.counters = PalmCounters()
        self.exhausted = False
        """True when a file has been played to its end, until `open`."""
        self._parser = PalmParser(self.counters)
        self._sweeps = PalmSweeps(
            self._fingers, self.counters, heed_finger_bits=self._heed_finger_bits
        )
        self._previous = b""
        self._palm: Palm | None = None
        self._calibration: Calibration | None = None
        self._uncalibrated = 0
        self._joint_due_ns = 0
        self._joint_seq = 0
        self._next_packet_ns = self._clock()
        self._attention_ns = self._next_packet_ns

    @property
    def live(self) -> bool:
        """Whether it is a palm, and no file."""
        return self._endpoint is not None

    @property
    def link_state(self) -> LinkState | None:
        """What the link is doing; None for a file."""
        return None if self._link is None else self._link.state

    @property
    def port(self) -> int | None:
        """The port that is listened on, or None."""
        return None if self._link is None else self._link.port

    @property
    def serials(self) -> dict[str, str]:
        """The palm does not pass them on in its samples."""
        return {}

    def describe(self) -> dict[str, str]:
        """Source, link, which palm is heard from whom; after `close` as it was then."""
        if self._link is not None:
            return self._link.describe()
        return self._described or {"source": str(self._endpoint or self._path)}

    def open(self) -> None:
        """Read the calibration, then listen or open the file."""
        self.close()
        self._reset()
        if self._calibration_path is not None:
            self._calibrate(self._calibration_path)
        if self._endpoint is None:
            self._file = PalmFile(self._path)
            return
        link = DatagramLink(
            self.name,
            self._endpoint,
            self.counters,
            self._clock,
            bytes_max=PACKET_BYTES_MAX,
            silence_ns=SILENCE_NS,
            only_from=self._only_from,
        )
        link.open()
        self._link = link

    def close(self) -> None:
        """Release the socket or the file."""
        if self._link is not None:
            self._described = self._link.describe()
            self._link.close()
            self._link = None
        if self._file is not None:
            self._file.close()
            self._file = None

    def fileno(self) -> int | None:
        """The socket, but None for a file and while no round can end.

        The kernel collects packets and notes their times. A loop that woke for each of them would
        wake a thousand times a second for 71 readings.
        """
        if self._link is None or self._clock() < self._attention_ns:
            return None
        return self._link.fileno()

    def due_ns(self) -> int | None:
        """When a round is about to end, silence is to be noticed, or a file's packet is due."""
        if self._link is None:
            if self._file is None or self.exhausted:
                return None
            return self._next_packet_ns if self._realtime else self._clock()
        due_ns, now_ns = self._link.due_ns(), self._clock()
        if now_ns < self._attention_ns:
            return self._attention_ns if due_ns is None else min(due_ns, self._attention_ns)
        return due_ns

    def read_ready(self) -> Sequence[Reading]:
        """Readings that are complete, from `DRAIN_MAX` packets at most. Raises `RecordingError`."""
        readings: list[Reading] = []
        if self._link is not None:
            for data, t_ns in self._link.receive():
                self._take(data, t_ns, readings)
            if self._link.fell_silent():
                self._sweeps.interrupt()
                self._palm = None
            self._attention_ns = self._clock() + self._nothing_for_ns()
        elif self._file is not None:
            self._play(self._file, readings)
        else:
            raise RuntimeError("the palm driver is not open")
        return readings

    def _nothing_for_ns(self) -> int:
        """How long the round at hand cannot be complete, ns, with some time to spare."""
        return max(0, self._sweeps.cycles_to_go - SPARE_CYCLES) * CYCLE_NS

    def _play(self, file: PalmFile, readings: list[Reading]) -> None:
        now_ns = self._clock()
        played: list[Reading] = []
        for _ in range(DRAIN_MAX):
            if self.exhausted or (self._realtime and self._next_packet_ns > now_ns):
                break
            data = file.next_packet()
            self.exhausted = not data
            if data:
                # A cycle apart as they were recorded, however late or early they are read.
                self._take(data, self._next_packet_ns, played)
            self._next_packet_ns += CYCLE_NS
        if not self._realtime:
            played = [dataclasses.replace(reading, t_ns=now_ns) for reading in played]
        readings.extend(played)

    def _take(self, data: bytes, t_ns: int, readings: list[Reading]) -> None:
        packet = self._parser.parse(data)
        if packet is None:
            return
        self._palm = self._palm or packet.palm
        if packet.palm is not self._palm:
            self.counters.other_palms += 1
            return
        if data == self._previous or self._sweeps.repeats(packet):
            self.counters.duplicate_packets += 1
            return
        self._previous = data
        if self._link is not None:
            self._link.confirm(f"palm {packet.palm}")
        joints = self._joint_reading(packet, t_ns)
        if joints is not None:
            readings.append(joints)
        readings.extend(self._sweeps.push(packet, t_ns))

    def _calibrate(self, path: Path) -> None:
        # Imported here: a scene without joints carries no joint code.
        from drivers.palm.calibration import load_calibration

        self._calibration = load_calibration(path)
        middle = [2000] * SENSORS
        self._uncalibrated = int(np.isnan(self._calibration.angles_rad(middle)).sum())

    def _joint_reading(self, packet: PalmPacket, t_ns: int) -> JointReading | None:
        if self._calibration is None or t_ns < self._joint_due_ns - CYCLE_NS // 2:
            return None
        from drivers.palm.hall import JOINTS, impossible_angles

        self._joint_due_ns += self._joint_period_ns
        if self._joint_due_ns <= t_ns:
            self._joint_due_ns = t_ns + self._joint_period_ns
        angles = self._calibration.angles_rad(packet.sensors)
        self.counters.joint_readings += 1
        self.counters.bad_angles += int(np.isnan(angles).sum()) - self._uncalibrated
        self.counters.impossible_angles += impossible_angles(angles)
        reading = JointReading(t_ns, self._joint_seq, JOINTS, angles)
        self._joint_seq += 1
        return reading
