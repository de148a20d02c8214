"""The palm status packet of a Shadow hand: the motor, joint and tactile record of one millisecond.

Bytes only. Little-endian and packed, as the palm's EtherCAT status memory holds it; its length
tells which palm sent it. Source: the palm protocol headers (0220, 0230, 0240, 0250) and tactile
protocol header published by Shadow Robot, and its driver, which reads a BioTac from the first 16
bytes of a finger's tactile slot on every palm.

A packet has neither checksum nor sequence number. Only `tactile_type` orders packets: it takes 14
values in turn.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from enum import StrEnum
from typing import Final, NamedTuple

from drivers.base import ELECTRODES
from drivers.udp.driver import DatagramCounters

CYCLE_NS = 1_000_000
"""The palm makes one packet per millisecond."""
SENSORS = 37
"""Words of `sensors`, of which 0..25 are Hall sensors (`drivers.palm.calibration`)."""
MOTORS = 10
"""Motor records per packet: the even ones or the odd ones of 20."""
TACTILE_FINGERS = 5
"""Tactile slots, in the order of `drivers.base.FINGERS`."""

COMMAND_EMPTY: Final = 0
"""`command` of a packet for which the palm was too late: all zeros."""
COMMAND_SENSOR_DATA: Final = 1
"""`command` of a packet with sensor data."""
COMMAND_MAX = 4
"""Largest known command. 2 to 4 are service modes, in which `sensors` holds other things."""

ROUND = 14
"""Packets until each channel of a BioTac has come once."""
TYPE_METADATA_FIRST: Final = 0xFFF9
TYPE_METADATA_LAST: Final = 0xFFFF
"""Range of types whose `tactile` holds serial numbers and versions instead of samples."""

VALID_OTHER_0, VALID_OTHER_1 = 4, 8
"""Bits of `TactileSlot.valid`; 1 and 2 are those of the PAC words."""
VALID_ALL = 0x0F

_CAN_RECORD: Final = struct.Struct("<BBH8s")


class Channel(NamedTuple):
    """Channel of one of a slot's two changing values; `electrode` is 0..23, or None for others."""

    name: str
    electrode: int | None


_IN_TURN = (
    *(Channel(name, None) for name in ("PDC", "TAC", "TDC")),
    *(Channel(f"E{electrode + 1}", electrode) for electrode in range(ELECTRODES)),
)
CHANNELS: tuple[tuple[Channel, Channel | None], ...] = tuple(
    zip(_IN_TURN[::2], (*_IN_TURN[1::2], None), strict=True)
)
"""By position in the round: the channels of `other_0` and `other_1`. The last has only one."""
_POSITIONS: Final = {2 * position + 1: position for position in range(ROUND)}


def position_of(tactile_type: int) -> int | None:
    """Return the position 0..13 in the round of a `tactile_type`, or None if it is no sample.

    0x0001 is (PDC, TAC), 0x0003 (TDC, E1), 0x0005 (E2, E3) ... 0x0019 (E22, E23), 0x001B (E24, -).
    """
    return _POSITIONS.get(tactile_type)


class Palm(StrEnum):
    """Kind of palm, known by the length of its packets."""

    PALM_0220 = "0220"
    """220 bytes; also the 0240, which differs in what its inertial words mean."""
    PALM_0230 = "0230"
    PALM_0250 = "0250"


class TactileSlot(NamedTuple):
    """One finger's BioTac in one packet; raw words, 0..65535."""

    pac_0: int
    pac_1: int
    other_0: int
    valid: int
    """`VALID_...` bits. Where one is not set, the word repeats something older."""
    other_1: int


class CanRecord(NamedTuple):
    """One message of the hand's motor buses, appended to the packet by the palm."""

    bus: int
    length: int
    identifier: int
    data: bytes
    """8 bytes, of which `length` count."""


@dataclass(frozen=True, slots=True)
class PalmPacket:
    """One packet. Middle and proximal tactile data and auxiliary words of a 0230 are not read."""

    palm: Palm
    command: int
    sensors: tuple[int, ...]
    """37 raw words, Hall sensors first."""
    motor_type: int
    which_motors: int
    """0 even, 1 odd."""
    motors_arrived: int
    motors_failed: int
    motor_words: tuple[int, ...]
    """20 words: of each of 10 motors raw torque, and a word that `motor_type` explains."""
    tactile_type: int
    """Which channels `other_0` and `other_1` are: see `position_of`."""
    tactile_valid: int
    """Bit 0 first finger ... bit 4 thumb."""
    tactile: tuple[TactileSlot, ...]
    """5 slots, in the order of `drivers.base.FINGERS`."""
    idle_time_us: int
    """What the palm had to spare of its millisecond; should stay above 50."""
    can_record: CanRecord | None = None

    def to_bytes(self) -> bytes:
        """Return the packet as the palm sends it, with zeros in what is not read. For twins.

        Raises `ValueError` for a value that its field cannot hold.
        """
        layout = _LAYOUTS[self.palm]
        motor = [self.motor_type, self.which_motors, self.motors_arrived, self.motors_failed]
        motor += self.motor_words
        tactile = [self.tactile_type, self.tactile_valid]
        tactile += [word for slot in self.tactile for word in slot]
        blocks = motor + tactile if layout.motors_first else tactile + motor
        try:
            packet = layout.format.pack(self.command, *self.sensors, *blocks, self.idle_time_us)
            record = b"" if self.can_record is None else _CAN_RECORD.pack(*self.can_record)
        except struct.error as error:
            raise ValueError(f"this is no palm packet: {error}") from error
        return packet + record


@dataclass(slots=True)
class PalmCounters(DatagramCounters):
    """Counters of packets, values and angles. `readings` are the tactile ones."""

    packets: int = 0
    """Packets with sensor data."""
    bad_lengths: int = 0
    """Datagrams of a length that no known palm sends."""
    empty_packets: int = 0
    """Packets that the palm was too late to fill."""
    service_packets: int = 0
    """Packets of a service mode of the palm."""
    nonsense_packets: int = 0
    """Packets with a field that no palm sends."""
    lost_packets: int = 0
    """Packets missing from rounds that were handed over."""
    duplicate_packets: int = 0
    """Packets that came again; the copy is dropped."""
    reordered_packets: int = 0
    """Packets that came after their successor and in time for their round."""
    late_packets: int = 0
    """Packets that came when their round was over; dropped."""
    conflicting_packets: int = 0
    """Packets for a place where another one already was; both are dropped."""
    unsynchronised_packets: int = 0
    """Packets dropped until a round began, after opening or an outage."""
    interrupted_rounds: int = 0
    """Rounds dropped because the link broke in the middle."""
    metadata_packets: int = 0
    """Packets whose tactile part is about the sensors themselves."""
    unknown_types: int = 0
    """Packets with an undocumented `tactile_type`."""
    held_values: int = 0
    """Electrode values that the palm marked as not fresh."""
    not_counts: int = 0
    """Electrode values outside 0..4095."""
    invalid_fingers: int = 0
    """Slots that the palm marked as not valid."""
    absent_fingers: int = 0
    """Fingers of rounds without a sensor: channels that are no counts, or only zeros."""
    joint_readings: int = 0
    """Joint readings handed over."""
    bad_angles: int = 0
    """Angles handed over as NaN although the joint is calibrated: its raw value is no count."""
    impossible_angles: int = 0
    """Angles handed over that are out of the joint's range by more than 10 degrees."""
    other_palms: int = 0
    """Packets of another kind of palm than the first since the link came up; dropped."""


class PalmParser:
    """Datagrams in, packets out."""

    def __init__(self, counters: PalmCounters) -> None:
        self._counters = counters

    def parse(self, data: bytes) -> PalmPacket | None:
        """Return the packet of a datagram; count and return None for one without sensor data.

        Damage to a value that stays in its range is not noticed, for want of a checksum.
        """
        palm = PALM_OF_LENGTH.get(len(data))
        if palm is None:
            self._counters.bad_lengths += 1
            return None
        packet = _unpack(data, _LAYOUTS[palm])
        if packet.command == COMMAND_EMPTY:
            self._counters.empty_packets += 1
            return None
        if packet.command > COMMAND_MAX or not _is_plausible(packet):
            self._counters.nonsense_packets += 1
            return None
        if packet.command != COMMAND_SENSOR_DATA:
            self._counters.service_packets += 1
            return None
        self._counters.packets += 1
        return packet


@dataclass(frozen=True, slots=True)
class _Layout:
    """How one palm's packet is laid out."""

    palm: Palm
    format: struct.Struct
    motors_first: bool
    """Whether the motor block stands before the tactile block."""


def _layout(palm: Palm, slot_bytes: int, *, motors_first: bool, middle: str, after: str) -> _Layout:
    """`middle` and `after` skip what stands before the tactile block, and after it."""
    motors = "IhII" + "hH" * MOTORS
    slot = f"HHHBxH{slot_bytes - 10}x"
    tactile = f"{middle}IH{slot * TACTILE_FINGERS}{after}"
    blocks = motors + tactile if motors_first else tactile + motors
    return _Layout(palm, struct.Struct(f"<I{SENSORS}H{blocks}H"), motors_first)


_LAYOUTS: Final = {
    layout.palm: layout
    for layout in (
        _layout(Palm.PALM_0220, 16, motors_first=True, middle="", after=""),
        _layout(Palm.PALM_0230, 32, motors_first=False, middle="80x", after="36x"),
        _layout(Palm.PALM_0250, 78, motors_first=False, middle="", after=""),
    )
}
PACKET_BYTES: Final = {palm: layout.format.size for palm, layout in _LAYOUTS.items()}
"""Length of a packet: 220, 416 and 530 bytes."""
CAN_RECORD_BYTES = _CAN_RECORD.size
"""Length of the CAN record that a relay may leave appended."""
PALM_OF_LENGTH: Final = {
    length + appended: palm
    for palm, length in PACKET_BYTES.items()
    for appended in (0, CAN_RECORD_BYTES)
}
"""All lengths that a packet can have."""
PACKET_BYTES_MAX = max(PALM_OF_LENGTH)

_MOTOR_WORDS = 4 + 2 * MOTORS
_SLOT_WORDS = len(TactileSlot._fields)
_TACTILE_WORDS = 2 + _SLOT_WORDS * TACTILE_FINGERS
_CAN_BYTES_MAX = 8


def _unpack(data: bytes, layout: _Layout) -> PalmPacket:
    words = layout.format.unpack_from(data)
    first = 1 + SENSORS
    motor_at, tactile_at = first, first + _MOTOR_WORDS
    if not layout.motors_first:
        motor_at, tactile_at = first + _TACTILE_WORDS, first
    records, slots = motor_at + 4, tactile_at + 2
    appended = len(data) > layout.format.size
    return PalmPacket(
        palm=layout.palm,
        command=words[0],
        sensors=words[1:first],
        motor_type=words[motor_at],
        which_motors=words[motor_at + 1],
        motors_arrived=words[motor_at + 2],
        motors_failed=words[motor_at + 3],
        motor_words=words[records : records + 2 * MOTORS],
        tactile_type=words[tactile_at],
        tactile_valid=words[tactile_at + 1],
        tactile=tuple(
            [
                TactileSlot(*words[at : at + _SLOT_WORDS])
                for at in range(slots, slots + _SLOT_WORDS * TACTILE_FINGERS, _SLOT_WORDS)
            ]
        ),
        idle_time_us=words[-1],
        can_record=(
            CanRecord(*_CAN_RECORD.unpack_from(data, layout.format.size)) if appended else None
        ),
    )


def _is_plausible(packet: PalmPacket) -> bool:
    """Return True if the fields of few values hold one of them."""
    if packet.can_record is not None and packet.can_record.length > _CAN_BYTES_MAX:
        return False
    return packet.which_motors in (0, 1)
