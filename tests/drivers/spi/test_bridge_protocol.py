"""Messages of the serial bridge, against the protocol's own document."""

from __future__ import annotations

import dataclasses
import random
import re
import struct
import zlib

import msgspec
import numpy as np
import pytest

from drivers.biotac import SEQUENCE_ELECTRODES, SEQUENCE_INTERLEAVED, sample_command
from drivers.spi.messages import (
    DIGEST,
    SCHEMA,
    BridgeStatus,
    Hello,
    HelloHead,
    Message,
    Ping,
    Start,
    Stop,
    Sweep,
    decode,
    encode,
    frame_parser,
)
from tests.conftest import ROOT
from tests.drivers.spi.test_framing import slow_crc32, slow_frame

DOCUMENT = ROOT / "deploy" / "bridge" / "PROTOCOL.md"
COMMANDS = tuple(sample_command(channel) for channel in SEQUENCE_ELECTRODES)
HELLO = Hello(
    nonce=0x11223344,
    tick=5_000_000,
    tick_hz=1_000_000,
    period_ticks=10_000,
    serials=("BTSP-0001", "", "BTTB-0003"),
    commands=COMMANDS,
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


def test_schema_and_digest_are_those_of_the_document() -> None:
    document = DOCUMENT.read_text(encoding="utf-8")
    _, schema, _ = re.split(r"^-{60,}\n", document, flags=re.MULTILINE)
    assert schema == SCHEMA
    assert slow_crc32(schema.encode()) == DIGEST == zlib.crc32(schema.encode())
    assert f"**0x{DIGEST:08X}**" in document


# Written down by hand from the document.
GOLDEN: list[tuple[Message, str]] = [
    (
        HELLO,
        "01 D6E4990D 44332211 404B4C0000000000 40420F00 0201 62656E63682D37000000000000000000"
        " 10270000 03 18"
        " 425453502D3030303100000000000000 00000000000000000000000000000000"
        " 425454422D3030303300000000000000"
        " A2A4A7A8ABADAEB0 B3B5B6B9BABCBFC1 C2C4C7C8CBCDCED0",
    ),
    (SWEEP, "07000000 E803000000000000 540B000000000000 05 03 02 A251FFFF94B9 01010000FEF8"),
    (STATUS, "0000000000010000 70110100 01000000 02000000 03000000 03 04000000 05000000 06000000"),
    (Ping(0x04030201), "01020304"),
    (Start(), ""),
    (Stop(), ""),
]
TYPES = {Hello: 0x01, Sweep: 0x02, BridgeStatus: 0x03, Ping: 0x81, Start: 0x82, Stop: 0x83}


@pytest.mark.parametrize(("message", "payload"), GOLDEN, ids=lambda value: type(value).__name__)
def test_a_message_has_its_golden_bytes_and_comes_back(message: Message, payload: str) -> None:
    wire = bytes.fromhex(payload)
    kind = TYPES[type(message)]
    assert message.to_bytes() == wire
    back = decode(kind, wire)
    assert back is not None
    assert type(back) is type(message)
    assert back.to_bytes() == wire
    if not isinstance(message, Sweep):
        assert back == message
    seed = 0 if kind in (0x01, 0x81) else DIGEST
    assert encode(message) == slow_frame(kind, wire, seed)
    assert frame_parser().feed(encode(message)) == [(kind, wire)]


def test_words_come_back_in_the_order_of_slots_and_sensors() -> None:
    back = Sweep.from_bytes(SWEEP.to_bytes())
    assert back is not None
    assert back.words.tolist() == SWEEP.words.tolist()
    assert (back.seq, back.tick_start, back.tick_end, back.present) == (7, 1000, 2900, 5)


# The document's own numbers.
@pytest.mark.parametrize(
    ("slots", "payload_bytes", "line_bytes"),
    [(len(SEQUENCE_ELECTRODES), 167, 174), (len(SEQUENCE_INTERLEAVED), 347, 355)],
)
def test_a_sweep_is_as_long_as_the_document_says(
    slots: int, payload_bytes: int, line_bytes: int
) -> None:
    words = np.full((slots, 3), 0xA251, dtype=np.uint16)
    sweep = Sweep(0x01010101, 0x0101010101010101, 0x0101010101010102, 7, words)
    assert len(sweep.to_bytes()) == payload_bytes
    assert len(encode(sweep)) == line_bytes


def test_every_message_fits_into_a_frame_at_its_largest() -> None:
    words = np.full((64, 5), 0xFFFF, dtype=np.uint16)
    largest = Sweep((1 << 32) - 1, (1 << 64) - 1, (1 << 64) - 1, 31, words)
    assert len(encode(largest)) == 672
    hello = dataclasses.replace(HELLO, serials=("X" * 16,) * 5, commands=(0xA2,) * 64)
    assert decode(0x01, hello.to_bytes()) == hello


@pytest.mark.parametrize("message", [HELLO, SWEEP, STATUS, Ping(1)], ids=lambda m: type(m).__name__)
def test_a_payload_of_any_other_length_is_nothing(message: Message) -> None:
    payload = message.to_bytes()
    for length in range(len(payload)):
        assert type(message).from_bytes(payload[:length]) is None
    assert type(message).from_bytes(payload + b"\0") is None
    assert decode(0x82, b"x") is None
    assert decode(0x83, b"x") is None
    assert decode(0x04, b"") is None


@pytest.mark.parametrize(
    "changes",
    [
        {"version": 2},
        {"tick_hz": 0},
        {"tick_hz": 999},
        {"period_ticks": 0},
        {"sensors": 0},
        {"sensors": 6},
        {"slots": 0},
        {"slots": 65},
        {"command": 0xA1},
    ],
)
def test_a_hello_that_makes_no_sense_is_nothing(changes: dict[str, int]) -> None:
    fields = {"version": 1, "tick_hz": 1_000_000, "period_ticks": 9, "sensors": 2, "slots": 3}
    fields = {**fields, "command": 0xA2, **changes}
    payload = struct.pack("<BIIQ", fields["version"], DIGEST, 1, 2)
    payload += struct.pack("<IH16sI", fields["tick_hz"], 0, b"b", fields["period_ticks"])
    payload += bytes([fields["sensors"], fields["slots"]]) + bytes(16 * fields["sensors"])
    payload += bytes([fields["command"]]) * fields["slots"]
    assert Hello.from_bytes(payload) is None


@pytest.mark.parametrize(
    ("offset", "value"),
    [(20, 0b1000), (21, 0), (21, 6), (22, 0), (22, 65), (12, 0)],
    ids=[
        "a fourth sensor",
        "no sensor",
        "six sensors",
        "no slot",
        "65 slots",
        "ends before it begins",
    ],
)
def test_a_sweep_that_makes_no_sense_is_nothing(offset: int, value: int) -> None:
    payload = bytearray(SWEEP.to_bytes())
    if offset == 12:
        payload[12:20] = bytes(8)
    else:
        payload[offset] = value
    assert Sweep.from_bytes(bytes(payload)) is None


@pytest.mark.parametrize(
    ("sensors", "slots", "sense"),
    [(1, 1, True), (5, 64, True), (0, 1, False), (1, 0, False), (6, 1, False), (1, 65, False)],
)
def test_a_sweep_has_1_to_5_sensors_and_1_to_64_slots(
    sensors: int, slots: int, sense: bool
) -> None:
    """However well its length fits."""
    payload = struct.pack("<IQQBBB", 7, 1, 2, 0, sensors, slots) + bytes(2 * sensors * slots)
    assert (Sweep.from_bytes(payload) is not None) == sense


@pytest.mark.parametrize(("sensors", "sense"), [(0, False), (1, True), (5, True), (6, False)])
def test_a_status_has_1_to_5_sensors(sensors: int, sense: bool) -> None:
    payload = struct.pack("<QIIIIB", 1, 2, 3, 4, 5, sensors) + bytes(4 * sensors)
    assert (BridgeStatus.from_bytes(payload) is not None) == sense


def test_the_head_of_a_later_version_can_be_read() -> None:
    later = struct.pack("<BII", 2, 0xCAFEF00D, 99) + b"anything"
    assert HelloHead.from_bytes(later) == HelloHead(2, 0xCAFEF00D, 99)
    assert Hello.from_bytes(later) is None
    assert HelloHead.from_bytes(later[:8]) is None


def test_a_serial_number_of_odd_bytes_does_not_break_the_hello() -> None:
    payload = bytearray(HELLO.to_bytes())
    start = payload.index(b"BTSP")
    payload[start : start + 5] = b"B\xff\n\x80P"
    back = Hello.from_bytes(bytes(payload))
    assert back is not None
    assert back.serials[0] == "B???P0001"


U8, U16, U32, U64 = 0xFF, 0xFFFF, 0xFFFFFFFF, 0xFFFFFFFFFFFFFFFF
# The smallest HELLO, by hand from the document; a board needs no name and no firmware's version.
LEAST = Hello(0, 0, 1000, 1, ("",), (0xA2,), version=0, digest=0)
LEAST_BYTES = (
    "00 00000000 00000000 0000000000000000 E8030000 0000"
    + "00" * 16
    + ("01000000 01 01" + "00" * 16 + "A2")
)
MOST = Hello(
    *(U32, U64, U32, U32, ("S" * 16,) * 5, (0xD0,) * 64, U16, "B" * 16),
    version=U8,
    digest=U32,
)
ONE_WORD, ALL_WORDS = np.full((1, 1), 0x0101, np.uint16), np.full((64, 5), 0xFEF8, np.uint16)
SWEEPS = Sweep(0, 0, 0, 0, ONE_WORD), Sweep(U32, U64, U64, 0b11111, ALL_WORDS)
STATES = BridgeStatus(0, 0, 0, 0, 0, (0,)), BridgeStatus(U64, U32, U32, U32, U32, (U32,) * 5)
EDGES: list[Message] = [LEAST, MOST, *SWEEPS, *STATES, Ping(0), Ping(U32)]
BEYOND: list[Message] = [
    *(
        dataclasses.replace(message, **{field: value})
        for message, step in ((LEAST, -1), (MOST, 1))
        for field in ("version", "digest", "nonce", "tick", "tick_hz", "firmware", "period_ticks")
        for value in [getattr(message, field) + step]
    ),
    *(dataclasses.replace(LEAST, serials=()), dataclasses.replace(MOST, serials=("S",) * 6)),
    *(dataclasses.replace(LEAST, commands=()), dataclasses.replace(MOST, commands=(0xD0,) * 65)),
    *(msgspec.structs.replace(SWEEPS[0], seq=-1), msgspec.structs.replace(SWEEPS[1], seq=U32 + 1)),
    *(
        msgspec.structs.replace(SWEEPS[0], present=-1),
        msgspec.structs.replace(SWEEPS[0], present=2),
    ),
    *(
        msgspec.structs.replace(SWEEPS[0], tick_start=-1),
        msgspec.structs.replace(SWEEPS[0], tick_end=-1),
    ),
    msgspec.structs.replace(SWEEPS[1], tick_end=U64 + 1),
    *(
        msgspec.structs.replace(SWEEPS[0], words=np.zeros(shape, np.uint16))
        for shape in ((0, 1), (1, 0), (65, 1), (1, 6), (1,), (1, 1, 1))
    ),
    *(
        dataclasses.replace(message, **{field: getattr(message, field) + step})
        for message, step in ((STATES[0], -1), (STATES[1], 1))
        for field in ("tick", "sweeps", "overruns", "tx_dropped", "rx_errors")
    ),
    *(
        BridgeStatus(0, 0, 0, 0, 0, (0, -1)),
        BridgeStatus(0, 0, 0, 0, 0, (0,) * 6),
        Ping(-1),
        Ping(U32 + 1),
    ),
]


@pytest.mark.parametrize("message", EDGES, ids=lambda message: type(message).__name__)
def test_the_largest_and_smallest_messages_are_written(message: Message) -> None:
    payload = message.to_bytes()
    back = type(message).from_bytes(payload)
    if isinstance(message, Hello):
        assert back is None, "of another version"
        message = dataclasses.replace(message, version=1)
        assert Hello.from_bytes(message.to_bytes()) == message
    else:
        assert back is not None
        assert back.to_bytes() == payload


def test_the_smallest_hello_has_its_golden_bytes() -> None:
    assert LEAST.to_bytes() == bytes.fromhex(LEAST_BYTES)
    assert MOST.to_bytes()[:45] == b"\xff" * 23 + b"B" * 16 + b"\xff" * 4 + bytes([5, 64])


@pytest.mark.parametrize("message", BEYOND, ids=lambda message: type(message).__name__)
def test_what_is_beyond_a_fields_range_is_not_written(message: Message) -> None:
    with pytest.raises(ValueError, match=r"must be in|words are"):
        message.to_bytes()


@pytest.mark.parametrize(
    "message",
    [
        dataclasses.replace(HELLO, nonce=1 << 32),
        dataclasses.replace(HELLO, tick=-1),
        dataclasses.replace(HELLO, serials=()),
        dataclasses.replace(HELLO, serials=("S" * 17,)),
        dataclasses.replace(HELLO, board="für"),
        dataclasses.replace(HELLO, commands=(0xA2, 0xA1)),
        dataclasses.replace(HELLO, commands=(0xA2,) * 65),
        msgspec.structs.replace(SWEEP, present=8),
        msgspec.structs.replace(SWEEP, tick_start=3000),
        msgspec.structs.replace(SWEEP, words=np.zeros((2, 6), np.uint16)),
        msgspec.structs.replace(SWEEP, words=np.zeros((2, 3), np.int64)),
        dataclasses.replace(STATUS, spi_errors=()),
        dataclasses.replace(STATUS, sweeps=1 << 32),
        Ping(-1),
    ],
    ids=str,
)
def test_encoding_refuses_what_is_out_of_range(message: Message) -> None:
    with pytest.raises(ValueError, match=r"must be|at most|never|words are"):
        encode(message)


def test_random_payloads_never_raise() -> None:
    seed = random.SystemRandom().randrange(1 << 32)
    rng = random.Random(seed)
    for _ in range(20_000):
        payload = rng.randbytes(rng.randrange(200))
        for kind in (0x01, 0x02, 0x03, 0x81, 0x82, 0x83):
            message = decode(kind, payload)
            if message is not None:
                assert message.to_bytes() == payload or isinstance(message, Hello), seed
