"""Frames and messages of the serial bridge, against the protocol's own document."""

from __future__ import annotations

import struct

import numpy as np
import pytest

from graspd.drivers.biotac import SEQUENCES, sample_command
from graspd.drivers.spi.messages import (
    DIGEST,
    BridgeStatus,
    FrameParser,
    Hello,
    Message,
    Ping,
    Start,
    Stop,
    Sweep,
    decode,
    encode,
    encode_frame,
    layout_of,
)
from tests.drivers.spi.bridge_c import frame

ENCODED_MAX_BYTES = 1024
"""Largest encoded frame by deploy/bridge/PROTOCOL.md, bytes."""
HELLO = Hello(
    nonce=0x11223344,
    tick=5_000_000,
    tick_hz=1_000_000,
    period_ticks=10_000,
    serials=("BTSP-0001", "", "BTTB-0003"),
    commands=tuple(sample_command(channel) for channel in SEQUENCES["electrodes"]),
    firmware=0x0102,
    board="bench-7",
)
SWEEP = Sweep(
    seq=7,
    tick_start=1000,
    tick_end=2900,
    present=0b101,
    words=np.array([[0xA251, 0xFFFF, 0x94B9], [0x0101, 0x0000, 0xFEF8]], dtype=np.uint16),
)
STATUS = BridgeStatus(1 << 40, 70_000, 1, 2, 3, (4, 5, 6))


# The check value of CRC-32 is that of "123456789"; the other bytes are COBS by hand.
@pytest.mark.parametrize(
    ("kind", "payload", "wire"),
    [
        (0x31, b"23456789", "0E 31 32 33 34 35 36 37 38 39 26 39 F4 CB 00"),
        (0x00, b"", "01 05 8D EF 02 D2 00"),  # CRC-32 of one zero byte is D202EF8D
        (0x00, b"\0\0\0", "01 01 01 01 05 1C DF 44 21 00"),  # of four: 2144DF1C
    ],
)
def test_a_frame_has_its_golden_bytes(kind: int, payload: bytes, wire: str) -> None:
    assert encode_frame(kind, payload) == bytes.fromhex(wire)
    assert FrameParser().feed(bytes.fromhex(wire)) == [(kind, payload)]


def test_a_frame_of_another_digest_fails_the_checksum() -> None:
    parser = FrameParser(0x1234)
    assert parser.feed(encode_frame(0x02, b"abc", 0x1235)) == []
    assert parser.feed(encode_frame(0x02, b"abc")) == []
    assert parser.counters.bad_crc == 2
    for kind in (0x01, 0x81):
        assert parser.feed(frame(kind, b"abc")) == [(kind, b"abc")]
    assert parser.feed(encode_frame(0x02, b"abc", 0x1234)) == [(0x02, b"abc")]


@pytest.mark.parametrize(
    ("wire", "counter"),
    [
        ("05 11 22 33 00", "bad_cobs"),  # says four bytes and has three
        ("02 31 00", "bad_crc"),  # no room for a checksum
        ("05 11 22 33 44 00", "bad_crc"),
        ("01 01 01 01 01 00", "bad_crc"),  # of nothing, the right one
        ("0E 31 32 33 34 35 36 37 38 39 26 39 F4 CA 00", "bad_crc"),
    ],
)
def test_damage_is_counted_and_the_next_frame_is_found(wire: str, counter: str) -> None:
    parser = FrameParser()
    assert parser.feed(bytes.fromhex(wire)) == []
    assert getattr(parser.counters, counter) == 1
    assert parser.feed(encode_frame(0x31, b"next")) == [(0x31, b"next")]


def test_a_frame_one_byte_too_long_is_never_held() -> None:
    parser = FrameParser()
    parser.feed(b"\xff" * ENCODED_MAX_BYTES + b"\0")
    assert parser.counters.too_long == 0
    parser.feed(b"\xff" * (ENCODED_MAX_BYTES + 1) + b"\0")
    assert parser.counters.too_long == 1
    for _ in range(3):
        assert parser.feed(b"\x55" * 1000) == []
        assert parser.held_bytes <= ENCODED_MAX_BYTES
    assert parser.counters.too_long == 2
    assert parser.feed(b"\0" + encode_frame(1, b"x")) == [(1, b"x")]
    longest = bytes(1019)  # each zero takes one byte, type and checksum five
    assert len(encode_frame(1, longest[:-1])) == ENCODED_MAX_BYTES + 1
    with pytest.raises(ValueError, match="1025 bytes, more than 1024"):
        encode_frame(1, longest)


def test_after_a_reset_the_rest_of_a_frame_is_forgotten() -> None:
    parser = FrameParser()
    parser.feed(b"\x05\x11\x22")
    parser.reset()
    assert parser.feed(encode_frame(9, b"fresh")) == [(9, b"fresh")]


# Written down by hand from the document. The smallest HELLO has neither name nor firmware.
LEAST = Hello(0, 0, 1000, 1, ("",), (0xA2,))
GOLDEN: list[tuple[int, Message, str]] = [
    (
        0x01,
        HELLO,
        "01 D6E4990D 44332211 404B4C0000000000 40420F00 0201 62656E63682D37000000000000000000"
        " 10270000 03 18"
        " 425453502D3030303100000000000000 00000000000000000000000000000000"
        " 425454422D3030303300000000000000"
        " A2A4A7A8ABADAEB0 B3B5B6B9BABCBFC1 C2C4C7C8CBCDCED0",
    ),
    (
        0x01,
        LEAST,
        "01 D6E4990D 00000000 0000000000000000 E8030000 0000 00000000000000000000000000000000"
        " 01000000 01 01 00000000000000000000000000000000 A2",
    ),
    (0x02, SWEEP, "07000000 E803000000000000 540B000000000000 05 03 02 A251FFFF94B9 01010000FEF8"),
    (
        0x03,
        STATUS,
        "0000000000010000 70110100 01000000 02000000 03000000 03 04000000 05000000 06000000",
    ),
    (0x81, Ping(0x04030201), "01020304"),
    (0x82, Start(), ""),
    (0x83, Stop(), ""),
]


@pytest.mark.parametrize(("kind", "message", "payload"), GOLDEN)
def test_a_message_has_its_golden_bytes_and_comes_back(
    kind: int, message: Message, payload: str
) -> None:
    wire = bytes.fromhex(payload)
    back = decode(kind, wire)
    assert back is not None
    assert type(back) is type(message)
    assert back.to_bytes() == wire
    if not isinstance(message, Sweep):
        assert back == message
    assert encode(message) == frame(kind, wire)
    assert FrameParser(DIGEST).feed(encode(message)) == [(kind, wire)]
    for length in range(len(wire)):
        assert decode(kind, wire[:length]) is None
    assert decode(kind, wire + b"\0") is None
    assert decode(0x04, wire) is None


@pytest.mark.parametrize(
    "changes",
    [
        *({"version": 2}, {"tick_hz": 999}, {"period_ticks": 0}, {"sensors": 0}, {"sensors": 6}),
        *({"slots": 0}, {"slots": 65}, {"command": 0xA1}),
    ],
    ids=str,
)
def test_a_hello_with_a_forbidden_field_decodes_to_none(changes: dict[str, int]) -> None:
    fields = {"version": 1, "tick_hz": 1_000_000, "period_ticks": 9, "sensors": 2, "slots": 3}
    fields = {**fields, "command": 0xA2, **changes}
    payload = struct.pack("<BIIQ", fields["version"], DIGEST, 1, 2)
    payload += struct.pack("<IH16sI", fields["tick_hz"], 0, b"b", fields["period_ticks"])
    payload += bytes([fields["sensors"], fields["slots"]]) + bytes(16 * fields["sensors"])
    payload += bytes([fields["command"]]) * fields["slots"]
    assert decode(0x01, payload) is None


@pytest.mark.parametrize(
    ("sensors", "slots", "present", "ticks", "sense"),
    [
        (1, 1, 1, (2, 2), True),
        (5, 64, 31, (1, 2), True),
        (0, 1, 0, (1, 2), False),
        (1, 0, 0, (1, 2), False),
        (6, 1, 0, (1, 2), False),
        (1, 65, 0, (1, 2), False),
        (3, 1, 0b1000, (1, 2), False),
        (3, 1, 0, (2, 1), False),
    ],
)
def test_only_a_sweep_within_the_limits_is_decoded(
    sensors: int, slots: int, present: int, ticks: tuple[int, int], sense: bool
) -> None:
    """The length of the payload fits `sensors` and `slots` in all cases."""
    payload = struct.pack("<IQQBBB", 7, *ticks, present, sensors, slots)
    assert (decode(0x02, payload + bytes(2 * sensors * slots)) is not None) == sense


@pytest.mark.parametrize(("sensors", "sense"), [(0, False), (1, True), (5, True), (6, False)])
def test_a_status_has_1_to_5_sensors(sensors: int, sense: bool) -> None:
    payload = struct.pack("<QIIIIB", 1, 2, 3, 4, 5, sensors) + bytes(4 * sensors)
    assert (decode(0x03, payload) is not None) == sense


def test_the_layout_of_a_later_version_can_be_read() -> None:
    later = struct.pack("<BI", 2, 0xCAFEF00D)
    assert layout_of(later + b"anything") == layout_of(later) == (2, 0xCAFEF00D)
    assert layout_of(later[:4]) is None


def test_unprintable_bytes_in_a_serial_number_become_question_marks() -> None:
    payload = bytearray(HELLO.to_bytes())
    start = payload.index(b"BTSP")
    payload[start : start + 5] = b"B\xff\n\x80P"
    back = decode(0x01, bytes(payload))
    assert isinstance(back, Hello)
    assert back.serials[0] == "B???P0001"
