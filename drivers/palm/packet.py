"""The palm status packet of a Shadow hand: joints and tactile data of one millisecond. Bytes only.

The packet is packed and little-endian. Its length tells the kind of palm. It has no checksum and no
sequence number. Source: the palm protocol headers (0220, 0230, 0240, 0250) and the tactile protocol
header published by Shadow Robot, and its driver, which reads a BioTac from the first 16 bytes of a
finger's tactile slot on every palm.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from enum import StrEnum
from typing import Final, NamedTuple

from graspd.biotac import ELECTRODES
from graspd.drivers.udp import DatagramCounters

CYCLE_NS = 1_000_000
"""Time between two packets of a palm, ns."""
SENSORS = 37
"""Number of words in `sensors`; 0..25 are Hall sensors (`graspd.drivers.palm.calibration`)."""
MOTOR_BYTES: Final = 8 + 10 * 4
"""Bytes after `which_motors`: two masks, and records of the 10 even or 10 odd motors."""
TACTILE_FINGERS = 5
"""Number of tactile slots, in the order of `graspd.biotac.FINGERS`."""

COMMAND_EMPTY: Final = 0
"""`command` of a packet that the palm was too late to fill; all its bytes are zero."""
COMMAND_SENSOR_DATA: Final = 1
COMMAND_MAX = 4
"""Largest known `command`. 2 to 4 are service modes, whose `sensors` are not joints."""

ROUND = 14
"""Packets of a round, in which each channel of a BioTac is sent once."""
TYPE_METADATA_FIRST: Final = 0xFFF9
TYPE_METADATA_LAST: Final = 0xFFFF
"""Last `tactile_type` whose `tactile` has serial numbers and versions instead of samples."""

VALID_OTHER_0, VALID_OTHER_1 = 4, 8
"""Masks of `TactileSlot.valid` for `other_0` and `other_1`; masks 1 and 2 are for PAC words."""
VALID_ALL = 0x0F


class Channel(NamedTuple):
    """Channel of `other_0` or `other_1`; `electrode` is 0..23, None for other channels."""

    name: str
    electrode: int | None


_IN_TURN = (
    *(Channel(name, None) for name in ("PDC", "TAC", "TDC")),
    *(Channel(f"E{electrode + 1}", electrode) for electrode in range(ELECTRODES)),
)
CHANNELS: tuple[tuple[Channel, Channel | None], ...] = tuple(
    zip(_IN_TURN[::2], (*_IN_TURN[1::2], None), strict=True)
)
"""Channels of `other_0` and `other_1` by position in the round; the last has only one."""
_POSITIONS: Final = {2 * position + 1: position for position in range(ROUND)}


def position_of(tactile_type: int) -> int | None:
    """Return the position in the round, 0..13, of a `tactile_type`; None if it has no samples."""
    return _POSITIONS.get(tactile_type)


class Palm(StrEnum):
    """Kind of palm, known by the length of its packets."""

    PALM_0220 = "0220"
    """Packets of 220 bytes; also the 0240, whose inertial words have another meaning."""
    PALM_0230 = "0230"
    PALM_0250 = "0250"


class TactileSlot(NamedTuple):
    """One finger's BioTac in one packet; raw words, 0..65535."""

    pac_0: int
    pac_1: int
    other_0: int
    valid: int
    """`VALID_...` bits; a word whose bit is not set repeats an older value."""
    other_1: int


@dataclass(frozen=True, slots=True)
class PalmPacket:
    """The fields of a packet that graspd reads; motors, middle and proximal slots are skipped."""

    palm: Palm
    command: int
    sensors: tuple[int, ...]
    """37 raw words, Hall sensors first."""
    which_motors: int
    """Motors in this packet: 0 the even ones, 1 the odd ones."""
    tactile_type: int
    """Type of the tactile data; `position_of` returns the packet's position in the round for it."""
    tactile_valid: int
    """Bit i is set if slot i is valid: 0 first finger ... 4 thumb."""
    tactile: tuple[TactileSlot, ...]
    """Five slots, in the order of `graspd.biotac.FINGERS`."""

    def to_bytes(self) -> bytes:
        """Return the packet as bytes; skipped fields are zero."""
        layout = _LAYOUTS[self.palm]
        tactile = [self.tactile_type, self.tactile_valid]
        tactile += [word for slot in self.tactile for word in slot]
        motors = [self.which_motors]
        blocks = motors + tactile if layout.motors_first else tactile + motors
        return layout.format.pack(self.command, *self.sensors, *blocks)


@dataclass(slots=True)
class PalmCounters(DatagramCounters):
    """Counters of packets, values and angles. `readings` are the tactile ones."""

    packets: int = 0
    bad_lengths: int = 0
    """Datagrams of a length that no known palm sends."""
    empty_packets: int = 0
    """Packets that the palm was too late to fill."""
    service_packets: int = 0
    nonsense_packets: int = 0
    """Packets with a field that has a value which no palm sends."""
    lost_packets: int = 0
    """Packets missing from rounds that were handed over, and all 14 of each missed round."""
    duplicate_packets: int = 0
    """Packets that arrived twice; the copy is dropped."""
    reordered_packets: int = 0
    """Packets that arrived after a later one, but in time for their round."""
    late_packets: int = 0
    """Packets that arrived when their round was over; dropped."""
    conflicting_packets: int = 0
    """Packets for a place that another packet had taken; dropped, and that other one too unless its
    round was handed over."""
    unsynchronised_packets: int = 0
    """Packets dropped until a round began, after opening or an outage."""
    interrupted_rounds: int = 0
    """Rounds dropped because the link broke in the middle."""
    metadata_packets: int = 0
    """Packets whose tactile part describes the sensors: serial numbers, versions."""
    unknown_types: int = 0
    held_values: int = 0
    """Electrode values that the palm marked as not fresh."""
    not_counts: int = 0
    """Electrode values outside 0..4095."""
    invalid_fingers: int = 0
    """Slots that the palm marked as not valid."""
    absent_fingers: int = 0
    """Fingers without a sensor: pressure or temperature over 4095, or all electrodes 0. Each counts
    once in each round."""
    joint_readings: int = 0
    bad_angles: int = 0
    """Angles of calibrated joints handed over as NaN, because the raw value is not a count."""
    impossible_angles: int = 0
    """Angles handed over that are more than 10 degrees out of the joint's range."""
    other_palms: int = 0
    """Packets of another kind of palm than the link began with; dropped."""


def parse_packet(data: bytes, counters: PalmCounters) -> PalmPacket | None:
    """Return the packet of a datagram; None, and count it, if it has no sensor data."""
    palm = PALM_OF_LENGTH.get(len(data))
    if palm is None:
        counters.bad_lengths += 1
        return None
    packet = _unpack(palm, data)
    if packet.command == COMMAND_EMPTY:
        counters.empty_packets += 1
        return None
    is_sound = packet.which_motors in (0, 1) and _record_is_sound(palm, data)
    if packet.command > COMMAND_MAX or not is_sound:
        counters.nonsense_packets += 1
        return None
    if packet.command != COMMAND_SENSOR_DATA:
        counters.service_packets += 1
        return None
    counters.packets += 1
    return packet


class _Layout(NamedTuple):
    format: struct.Struct
    motors_first: bool
    """True if the motor block stands before the tactile block."""


def _layout(slot_bytes: int, *, motors_first: bool, middle: str = "", after: str = "") -> _Layout:
    """Return the layout of a palm. `slot_bytes`: length of a finger's tactile slot. `middle`,
    `after`: formats of `struct` for the padding before and after the tactile block."""
    motors = f"4xh{MOTOR_BYTES}x"
    slot = f"HHHBxH{slot_bytes - 10}x"
    tactile = f"{middle}IH{slot * TACTILE_FINGERS}{after}"
    blocks = motors + tactile if motors_first else tactile + motors
    return _Layout(struct.Struct(f"<I{SENSORS}H{blocks}2x"), motors_first)


_LAYOUTS: Final = {
    Palm.PALM_0220: _layout(16, motors_first=True),
    Palm.PALM_0230: _layout(32, motors_first=False, middle="80x", after="36x"),
    Palm.PALM_0250: _layout(78, motors_first=False),
}
CAN_RECORD_BYTES = 12
"""Bytes of a CAN message that a relay may append to a packet: bus, length, id and data."""
PALM_OF_LENGTH: Final = {
    layout.format.size + appended: palm
    for palm, layout in _LAYOUTS.items()
    for appended in (0, CAN_RECORD_BYTES)
}
"""Palm by length of a packet: 220, 416 and 530 bytes, each with and without the CAN message."""
PACKET_BYTES_MAX = max(PALM_OF_LENGTH)

_SLOT_WORDS = len(TactileSlot._fields)
_CAN_BYTES_MAX = 8


def _unpack(palm: Palm, data: bytes) -> PalmPacket:
    layout = _LAYOUTS[palm]
    command, *words = layout.format.unpack_from(data)
    sensors, blocks = words[:SENSORS], words[SENSORS:]
    motors_at = 0 if layout.motors_first else -1
    which_motors = blocks.pop(motors_at)
    tactile_type, tactile_valid, *slots = blocks
    return PalmPacket(
        palm=palm,
        command=command,
        sensors=tuple(sensors),
        which_motors=which_motors,
        tactile_type=tactile_type,
        tactile_valid=tactile_valid,
        tactile=tuple(
            [TactileSlot(*slots[at : at + _SLOT_WORDS]) for at in range(0, len(slots), _SLOT_WORDS)]
        ),
    )


def _record_is_sound(palm: Palm, data: bytes) -> bool:
    """Return False if an appended CAN message has an impossible length."""
    record = data[_LAYOUTS[palm].format.size :]
    return not record or record[1] <= _CAN_BYTES_MAX
