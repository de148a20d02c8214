"""Packets of one palm with their times in, tactile and joint readings out. No I/O.

Palm packets have neither checksum nor sequence number. UDP's checksum covers the way from the
relay; plausible damage before it is not noticed. Two hands of one kind that share a relay's socket
look like one: use one port per hand.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Final

import numpy as np

from drivers.base import JointReading, Reading
from drivers.palm.packet import SENSORS, Palm, PalmCounters, PalmPacket, PalmParser
from drivers.palm.rounds import ROUND_NS, RoundAssembler

if TYPE_CHECKING:
    from pathlib import Path

    from drivers.palm.calibration import JointCalibration

JOINT_PERIOD_NS: Final = 10_000_000
"""100 Hz, which is enough for the position of a hand; 1000 Hz would cost processor time."""


class PalmStream:
    """Makes a `TactileReading` of each round of 14 packets, and a `JointReading` every 10 ms.

    Packets must come one a millisecond, as the palm makes them. With a relay that sends batches
    longer than 10 ms, sound rounds are flagged or counted as missed. With one that holds packets
    back for more than 3 ms, the loss of a whole round may go unnoticed.
    """

    period_ns: int | None = ROUND_NS
    """Time between tactile readings, ns."""

    def __init__(
        self,
        fingers: Sequence[str],
        *,
        calibration: Path | None = None,
        heed_finger_bits: bool = True,
    ) -> None:
        """`fingers`: the rows of a reading; raises `ValueError` for unknown fingers.

        Joint readings need the hand's `calibration` file; raises `CalibrationError` for one with
        mistakes. Without `heed_finger_bits` the packet's `tactile_valid` is ignored, for a palm
        that does not set it (Shadow's own driver ignores it).
        """
        self.counters = PalmCounters()
        self.palm: Palm | None = None
        """Kind of palm; None until a packet came, and after `interrupt`."""
        self._parser = PalmParser(self.counters)
        self._rounds = RoundAssembler(fingers, self.counters, heed_finger_bits=heed_finger_bits)
        self._previous = b""
        self._calibration: JointCalibration | None = None
        self._joint_due_ns = 0
        self._joint_seq = 0
        if calibration is not None:
            # Imported here: a scene without joints carries no joint code.
            from drivers.palm.calibration import load_calibration

            self._calibration = load_calibration(calibration)
            counts = range(SENSORS)  # any will do
            self._uncalibrated = int(np.isnan(self._calibration.angles_rad(counts)).sum())

    @property
    def sender_kind(self) -> str:
        """Kind of palm, for people."""
        return f"palm {self.palm}"

    @property
    def cycles_to_go(self) -> int:
        """See `RoundAssembler.cycles_to_go`."""
        return self._rounds.cycles_to_go

    def receive(self, data: bytes, t_ns: int) -> Sequence[Reading] | None:
        """Return the readings that a packet completes, or None if it is dropped: no packet of
        this palm, or the same again. `t_ns`: monotonic time of its arrival."""
        packet = self._parser.parse(data)
        if packet is None:
            return None
        self.palm = self.palm or packet.palm
        if packet.palm is not self.palm:
            self.counters.other_palms += 1
            return None
        if data == self._previous or self._rounds.repeats(packet):
            self.counters.duplicate_packets += 1
            return None
        self._previous = data
        readings = self._rounds.push(packet, t_ns)
        joints = self._joint_reading(packet, t_ns)
        return readings if joints is None else (joints, *readings)

    def interrupt(self) -> None:
        """Drop the current round; another palm may come next."""
        self._rounds.interrupt()
        self.palm = None

    def _joint_reading(self, packet: PalmPacket, t_ns: int) -> JointReading | None:
        if self._calibration is None or t_ns < self._joint_due_ns:
            return None
        from drivers.palm.calibration import JOINTS, impossible_angles

        self._joint_due_ns += JOINT_PERIOD_NS
        if self._joint_due_ns <= t_ns:
            self._joint_due_ns = t_ns + JOINT_PERIOD_NS
        angles = self._calibration.angles_rad(packet.sensors)
        self.counters.joint_readings += 1
        self.counters.bad_angles += int(np.isnan(angles).sum()) - self._uncalibrated
        self.counters.impossible_angles += impossible_angles(angles)
        reading = JointReading(t_ns, self._joint_seq, JOINTS, angles)
        self._joint_seq += 1
        return reading
