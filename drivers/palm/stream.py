"""A Shadow hand's palm: its packets, by UDP from a relay, become tactile and joint readings.

A packet carries two channels of each BioTac; its `tactile_type` names them. Packets have no number,
so the place of a packet follows from its type and the furthest packet before it:

- A lost packet leaves its one or two electrodes `MISSING` in this round, and moves no others. A
  round that lacks packets is handed over when the first packet of the next round arrives.
- A packet up to half a round late takes its place while its round is the current one.
- Two different packets for one place contradict each other (a damaged `tactile_type`, or a request
  that stands still). Both are dropped, and the place is `MISSING`; after its round only the second.
- Lost whole rounds are noticed by time alone, `LATE_MAX` cycles after a packet was due.

Packets have no checksum; UDP's own covers only the way from the relay. Two kinds of earlier damage
are not noticed: a changed value in 0..4095 whose validity bit is set, and a changed `tactile_type`
that names the place of a packet lost in the same round. Two hands of one kind that share a relay's
socket look like one, so use one port for each hand.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Final

import numpy as np
from numpy.typing import NDArray

from graspd.biotac import COUNT_MAX, ELECTRODES, FINGERS
from graspd.drivers.base import JOINTS, ElectrodeFault, JointReading, Reading, TactileReading
from graspd.drivers.link import OUTAGE_NS, LinkState, longest_silence_ns
from graspd.drivers.palm.packet import (
    CHANNELS,
    CYCLE_NS,
    PACKET_BYTES_MAX,
    ROUND,
    SENSORS,
    TYPE_METADATA_FIRST,
    TYPE_METADATA_LAST,
    VALID_OTHER_0,
    VALID_OTHER_1,
    Palm,
    PalmCounters,
    PalmPacket,
    parse_packet,
    position_of,
)
from graspd.drivers.udp import DatagramDriver

if TYPE_CHECKING:
    from pathlib import Path

    from graspd.drivers.palm.calibration import JointCalibration

ROUND_NS: Final = ROUND * CYCLE_NS
"""Time between two samples of an electrode, ns (71.43 Hz)."""
JOINT_PERIOD_NS: Final = 10_000_000
"""Time between joint readings, ns: 100 Hz is enough for a hand, and 1000 Hz costs more."""
LATE_MAX: Final = 10
"""Most cycles by which a packet may be late; after that a whole round counts as lost."""

SPARE_CYCLES: Final = 2
"""Number of cycles before the end of a round at which the driver waits for packets again."""

_COMPLETE: Final = (1 << ROUND) - 1
_TELLING: Final = 0b11
"""Bits of the round's positions with pressure and temperature, which show an absent sensor."""


class PalmStream:
    """Make a `TactileReading` of each round of 14 packets, and a `JointReading` every 10 ms.

    It does no I/O. Packets must arrive one a millisecond, as the palm makes them. If a relay sends
    batches longer than 10 ms, sound rounds are flagged or counted as missed. If it delays packets
    by more than 3 ms, the loss of a whole round may go unnoticed.
    """

    period_ns: int | None = ROUND_NS

    def __init__(
        self,
        fingers: Sequence[str],
        *,
        calibration: Path | None = None,
        heed_finger_bits: bool = True,
    ) -> None:
        """Raises `CalibrationError`.

        `fingers`: the rows of a reading. `calibration`: the hand's file; None: no joint readings.
        `heed_finger_bits`: False ignores `tactile_valid`, as Shadow's driver does; some palms do
        not set it.
        """
        self.counters = PalmCounters()
        self.palm: Palm | None = None
        """Kind of palm; None before the first packet, and after `interrupt`."""
        self._slots = tuple(FINGERS.index(finger) for finger in fingers)
        self._heed_finger_bits = heed_finger_bits
        shape = (len(fingers), ELECTRODES)
        self._counts = np.zeros(shape, dtype=np.uint16)
        self._faults = np.zeros(shape, dtype=np.uint8)
        self._latest = np.zeros(shape, dtype=np.uint16)
        self._known = np.zeros(shape, dtype=np.bool_)
        self._was_absent = np.zeros(len(fingers), dtype=np.bool_)
        self._place: int | None = None
        """Furthest place so far, counted over all rounds; None: no round since `interrupt`."""
        self._place_t_ns: int | None = None
        self._interrupted = False
        self._begin(0)
        self._calibration: JointCalibration | None = None
        self._joint_due_ns = 0
        self._joint_seq = 0
        if calibration is not None:
            # Imported here so that a scene without joints does not load joint code.
            from graspd.drivers.palm.calibration import load_calibration

            self._calibration = load_calibration(calibration)
            counts = range(SENSORS)  # any valid raw values
            self._uncalibrated = int(np.isnan(self._calibration.angles_rad(counts)).sum())

    @property
    def sender_kind(self) -> str:
        return f"palm {self.palm}"

    @property
    def cycles_to_go(self) -> int:
        """Fewest packets until the current round is complete; 0 if none has begun."""
        return 0 if self._place is None else (ROUND - 1 - self._place) % ROUND

    def receive(self, data: bytes, t_ns: int) -> Sequence[Reading] | None:
        """Return the readings that a packet completes; None if it comes again, is of another kind
        of palm, or is not a packet with sensor data."""
        packet = parse_packet(data, self.counters)
        if packet is None:
            return None
        self.palm = self.palm or packet.palm
        if packet.palm is not self.palm:
            self.counters.other_palms += 1
            return None
        position = position_of(packet.tactile_type)
        if position is not None and self._is_duplicate(packet, position, t_ns):
            self.counters.duplicate_packets += 1
            return None
        readings = self.push(packet, t_ns)
        joints = self._joint_reading(packet, t_ns)
        return readings if joints is None else (joints, *readings)

    def interrupt(self) -> None:
        """Drop the current round; another palm may come next. Call after an outage."""
        self.palm = None
        self.counters.interrupted_rounds += not self._finished and self._have != 0
        self._place = None
        self._interrupted = self.counters.readings > 0
        self._known[:] = False

    def push(self, packet: PalmPacket, t_ns: int) -> Sequence[TactileReading]:
        """Add a packet that arrived at `t_ns`; return the tactile readings that it completes."""
        position = position_of(packet.tactile_type)
        if position is None:
            is_metadata = TYPE_METADATA_FIRST <= packet.tactile_type <= TYPE_METADATA_LAST
            self.counters.metadata_packets += is_metadata
            self.counters.unknown_types += not is_metadata
            return ()
        place = self._place_of(position, t_ns)
        if place is None:
            self.counters.unsynchronised_packets += 1
            return ()
        is_behind = self._place is not None and place < self._place
        if not is_behind:
            self._place, self._place_t_ns = place, t_ns
        if place // ROUND < self._round:
            self.counters.late_packets += 1
            return ()
        finished: Sequence[TactileReading] = ()
        if place // ROUND > self._round:
            finished = self._move_on(place // ROUND)
        elif self.packets[position] is not None:
            self._contradict(position)
            return ()
        elif is_behind:
            self.counters.reordered_packets += 1
        self._store(position, packet, t_ns)
        return (*finished, self._finish()) if self._have == _COMPLETE else finished

    def _is_duplicate(self, packet: PalmPacket, position: int, t_ns: int) -> bool:
        """Return True for a copy of a packet of this round, False for a packet that differs, or
        arrives when an equal one of the next round may."""
        if self.packets[position] != packet or self._place is None or self._place_t_ns is None:
            return False
        elapsed_ns = t_ns - self._place_t_ns
        step = _step(self._place, position, elapsed_ns)
        is_in_time = step == 1 or (step < ROUND and elapsed_ns >= step * CYCLE_NS // 2)
        return not is_in_time or (self._place + step) // ROUND == self._round

    def _place_of(self, position: int, t_ns: int) -> int | None:
        if self._place is not None and self._place_t_ns is not None:
            return self._place + _step(self._place, position, t_ns - self._place_t_ns)
        if position != 0:
            return None
        if self._place_t_ns is None:
            return 0
        outage_ns = t_ns - self._place_t_ns
        missed = outage_ns // ROUND_NS if outage_ns <= OUTAGE_NS else 1
        self._miss(missed)
        self._begin(self._round + 1)
        return self._round * ROUND

    def _move_on(self, to_round: int) -> Sequence[TactileReading]:
        finished = () if self._finished else (self._finish(),)
        self._miss(to_round - self._round - 1)
        self._begin(to_round)
        return finished

    def _miss(self, rounds: int) -> None:
        self.counters.missed_readings += rounds
        self.counters.lost_packets += rounds * ROUND

    def _begin(self, at_round: int) -> None:
        self._round = at_round
        self._have = 0
        """Bit i is set if a packet of position i arrived, also if it was in conflict."""
        self._finished = False
        self.packets: list[PalmPacket | None] = [None] * ROUND
        """Packets of this round by position; None: not arrived."""
        self._counts[:] = 0
        self._faults[:] = ElectrodeFault.MISSING
        self._absent = [False] * len(self._slots)

    def _store(self, position: int, packet: PalmPacket, t_ns: int) -> None:
        self.packets[position] = packet
        self._have |= 1 << position
        self._t_ns = t_ns
        first, second = CHANNELS[position]
        for row, slot in enumerate(self._slots):
            if self._heed_finger_bits and not packet.tactile_valid >> slot & 1:
                self.counters.invalid_fingers += 1
                continue
            values = packet.tactile[slot]
            fresh = values.valid & VALID_OTHER_0 != 0
            self._put(row, first.electrode, values.other_0, fresh=fresh)
            if second is not None:
                fresh = values.valid & VALID_OTHER_1 != 0
                self._put(row, second.electrode, values.other_1, fresh=fresh)

    def _put(self, row: int, electrode: int | None, value: int, *, fresh: bool) -> None:
        if electrode is None:  # pressure or temperature: shows if a sensor is present
            self._absent[row] |= fresh and value > COUNT_MAX
        elif not fresh:
            self.counters.held_values += 1
            if self._known[row, electrode]:
                self._counts[row, electrode] = self._latest[row, electrode]
                self._faults[row, electrode] = ElectrodeFault.HELD
        elif value > COUNT_MAX:
            self.counters.not_counts += 1
            self._faults[row, electrode] = ElectrodeFault.NOT_A_COUNT
        else:
            self._counts[row, electrode] = self._latest[row, electrode] = value
            self._faults[row, electrode] = ElectrodeFault.NONE
            self._known[row, electrode] = True

    def _contradict(self, position: int) -> None:
        self.counters.conflicting_packets += 1
        if self._finished:
            return
        for channel in CHANNELS[position]:
            if channel is not None and channel.electrode is not None:
                self._counts[:, channel.electrode] = 0
                self._faults[:, channel.electrode] = ElectrodeFault.MISSING
                self._known[:, channel.electrode] = False

    def _finish(self) -> TactileReading:
        self._finished = True
        self.counters.lost_packets += ROUND - self._have.bit_count()
        self._drop_absent_fingers()
        faults = self._faults.copy()
        self.counters.readings += 1
        self.counters.faulty_readings += bool(faults.any())
        interrupted, self._interrupted = self._interrupted, False
        counts = self._counts.copy()
        return TactileReading(self._t_ns, self._round, counts, faults, interrupted=interrupted)

    def _drop_absent_fingers(self) -> None:
        """Flag fingers without a sensor `MISSING`: their words are unwritten memory, with pressure
        or temperature over 4095, or all electrodes 0."""
        silent: NDArray[np.bool_] = ((self._counts == 0) & (self._faults == 0)).all(axis=1)
        absent = np.array(self._absent)
        if self._have & _TELLING != _TELLING:
            absent |= self._was_absent
        self._was_absent = absent
        for row in np.flatnonzero(silent | absent):
            self.counters.absent_fingers += 1
            self._counts[row] = 0
            self._faults[row] = ElectrodeFault.MISSING
            self._known[row] = False

    def _joint_reading(self, packet: PalmPacket, t_ns: int) -> JointReading | None:
        if self._calibration is None or t_ns < self._joint_due_ns:
            return None
        from graspd.drivers.palm.calibration import impossible_angles

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


class PalmDriver(DatagramDriver[PalmStream]):
    """Driver of the readings of a `PalmStream`. `open` also raises `CalibrationError`."""

    name = "palm"
    bytes_max = PACKET_BYTES_MAX
    silence_ns = longest_silence_ns(ROUND_NS)
    period_ns: int | None = ROUND_NS

    def __init__(
        self,
        source: str,
        fingers: Sequence[str] = ("ff", "mf", "th"),
        *,
        calibration: Path | None = None,
        only_from: str | None = None,
        heed_finger_bits: bool = True,
        clock: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        self._fingers = tuple(fingers)
        self._heed_finger_bits = heed_finger_bits
        self._calibration: Path | None = None  # `open` reads it
        super().__init__(source, only_from=only_from, clock=clock)
        self._calibration = calibration
        self._attention_ns = clock()

    def _new_stream(self) -> PalmStream:
        return PalmStream(
            self._fingers, calibration=self._calibration, heed_finger_bits=self._heed_finger_bits
        )

    def fileno(self) -> int | None:
        """Return the socket; None while no round can end, for 71 instead of 1000 wakes a second."""
        return None if self._clock() < self._attention_ns else super().fileno()

    def due_ns(self) -> int | None:
        due_ns = super().due_ns()
        if self.link.state is LinkState.CLOSED or self._clock() >= self._attention_ns:
            return due_ns
        return self._attention_ns if due_ns is None else min(due_ns, self._attention_ns)

    def read_ready(self) -> Sequence[Reading]:
        readings = super().read_ready()
        cycles = max(0, self.stream.cycles_to_go - SPARE_CYCLES)
        self._attention_ns = self._clock() + cycles * CYCLE_NS
        return readings


def _step(place: int, position: int, elapsed_ns: int) -> int:
    """Return by how many places a packet of `position` is after the furthest, which is at `place`.

    0 or less: it is late. `elapsed_ns`: time since the furthest packet.
    """
    step = (position - place) % ROUND or ROUND
    if step > ROUND // 2 and elapsed_ns < step * CYCLE_NS // 2:
        return step - ROUND
    overdue_ns = elapsed_ns - (step + LATE_MAX) * CYCLE_NS
    return step + max(0, overdue_ns // ROUND_NS + 1) * ROUND
