"""The palm status packet against an independent description of its layout; what is not a packet."""

from __future__ import annotations

import ctypes
import itertools
from typing import Any

import pytest

from graspd.drivers.palm.packet import (
    CHANNELS,
    Palm,
    PalmCounters,
    PalmPacket,
    TactileSlot,
    parse_packet,
    position_of,
)
from tests.drivers.palm.palm_stream import SNAPSHOT

# The layouts as C structures, written down from Shadow's protocol headers.


class Biotac(ctypes.LittleEndianStructure):
    _pack_ = 1
    _fields_ = (
        ("pac", ctypes.c_uint16 * 2),
        ("other_0", ctypes.c_uint16),
        ("data_valid", ctypes.c_uint8),
        ("padding", ctypes.c_uint8),
        ("other_1", ctypes.c_uint16),
    )


class MotorData(ctypes.LittleEndianStructure):
    _pack_ = 1
    _fields_ = (("torque", ctypes.c_int16), ("misc", ctypes.c_uint16))


class CanBridge(ctypes.LittleEndianStructure):
    _pack_ = 1
    _fields_ = (
        ("can_bus", ctypes.c_uint8),
        ("length", ctypes.c_uint8),
        ("identifier", ctypes.c_uint16),
        ("data", ctypes.c_uint8 * 8),
    )


def slot(size: int) -> type[ctypes.LittleEndianStructure]:
    fields = (("biotac", Biotac), ("rest", ctypes.c_uint8 * (size - ctypes.sizeof(Biotac))))
    return type(f"Slot{size}", (ctypes.LittleEndianStructure,), {"_pack_": 1, "_fields_": fields})


HEAD = [("command", ctypes.c_uint32), ("sensors", ctypes.c_uint16 * 37)]
MOTORS = [
    ("motor_data_type", ctypes.c_uint32),
    ("which_motors", ctypes.c_int16),
    ("arrived", ctypes.c_uint32),
    ("had_errors", ctypes.c_uint32),
    ("motors", MotorData * 10),
]


def tactile(size: int) -> list[tuple[str, Any]]:
    return [
        ("tactile_data_type", ctypes.c_uint32),
        ("tactile_data_valid", ctypes.c_uint16),
        ("tactile", slot(size) * 5),
    ]


def structure(fields: list[tuple[str, Any]]) -> type[ctypes.LittleEndianStructure]:
    fields = [*HEAD, *fields, ("idle_time_us", ctypes.c_uint16)]
    base = (ctypes.LittleEndianStructure,)
    return type("Status", base, {"_pack_": 1, "_fields_": tuple(fields)})


STRUCTURES = {
    Palm.PALM_0220: structure([*MOTORS, *tactile(16)]),
    Palm.PALM_0230: structure(
        [
            ("middle_and_proximal", ctypes.c_uint8 * 16 * 5),
            *tactile(32),
            ("aux_type", ctypes.c_uint32),
            ("aux", ctypes.c_uint8 * 32),
            *MOTORS,
        ]
    ),
    Palm.PALM_0250: structure([*tactile(78), *MOTORS]),
}
palms = pytest.mark.parametrize("palm", list(Palm))


def filled(palm: Palm) -> ctypes.LittleEndianStructure:
    """A palm's packet as a C structure, with different values in the fields that are read."""
    numbers = itertools.count(7)
    status = STRUCTURES[palm]()
    status.command = 1
    status.sensors[:] = SNAPSHOT
    status.motor_data_type, status.which_motors = 5, 1
    status.arrived, status.had_errors = 0xAAAAA, 0x00400
    for motor in status.motors:
        motor.torque, motor.misc = -next(numbers), next(numbers) + 0x8000
    status.tactile_data_type, status.tactile_data_valid = 0x0019, 0x13
    for finger in status.tactile:
        finger.biotac.pac[:] = [next(numbers), next(numbers)]
        finger.biotac.other_0, finger.biotac.other_1 = next(numbers), next(numbers)
        finger.biotac.data_valid, finger.biotac.padding = next(numbers), 0xEE
        finger.rest[:] = [0xDD] * len(finger.rest)
    status.idle_time_us = 430
    return status


def parse(data: bytes) -> PalmPacket | None:
    return parse_packet(data, PalmCounters())


@pytest.mark.parametrize("appended", [b"", bytes(CanBridge(1, 8, 0x215, (1, 2, 3)))])
@palms
def test_every_field_is_read_from_its_place(palm: Palm, appended: bytes) -> None:
    status = filled(palm)
    packet = parse(bytes(status) + appended)
    assert packet is not None
    assert packet.palm is palm
    assert list(packet.sensors) == SNAPSHOT
    assert (packet.command, packet.which_motors) == (1, 1)
    assert (packet.tactile_type, packet.tactile_valid) == (0x0019, 0x13)
    biotacs = [finger.biotac for finger in status.tactile]
    assert packet.tactile == tuple(
        TactileSlot(biotac.pac[0], biotac.pac[1], biotac.other_0, biotac.data_valid, biotac.other_1)
        for biotac in biotacs
    )


@pytest.mark.parametrize(
    ("offset", "value", "counter"),
    [
        (0, 2, "service_packets"),
        (0, 4, "service_packets"),
        (0, 5, "nonsense_packets"),
        (3, 1, "nonsense_packets"),
        (82, 2, "nonsense_packets"),
        (83, 0xFF, "nonsense_packets"),
        (221, 9, "nonsense_packets"),
    ],
)
def test_service_packets_and_wrong_fields_are_counted_and_dropped(
    offset: int, value: int, counter: str
) -> None:
    data = bytearray(bytes(filled(Palm.PALM_0220)) + bytes(12))
    counters = PalmCounters()
    assert parse_packet(bytes(data), counters) is not None
    data[offset] = value
    assert parse_packet(bytes(data), counters) is None
    assert getattr(counters, counter) == 1
    assert counters.packets == 1


@pytest.mark.parametrize(
    ("data", "counter"),
    [
        *((b"\x01" * length, "bad_lengths") for length in (219, 233, 543)),
        (b"", "bad_lengths"),
        *((bytes(length), "empty_packets") for length in (220, 416, 542)),
    ],
)
def test_wrong_lengths_and_empty_packets_are_counted_and_dropped(data: bytes, counter: str) -> None:
    counters = PalmCounters()
    assert parse_packet(data, counters) is None
    assert (getattr(counters, counter), counters.packets) == (1, 0)


def test_a_round_has_fourteen_types_and_every_electrode_once() -> None:
    positions = [position for kind in range(0x10000) if (position := position_of(kind)) is not None]
    assert positions == list(range(14))
    channels = [channel for pair in CHANNELS for channel in pair if channel is not None]
    electrodes = [channel.electrode for channel in channels if channel.electrode is not None]
    assert electrodes == list(range(24))
    assert len(channels) == 27
