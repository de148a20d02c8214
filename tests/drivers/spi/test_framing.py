"""Frames on the serial line: golden bytes, damage, bounds."""

from __future__ import annotations

import random

import pytest

from drivers.spi.framing import FrameParser, encode_frame

ENCODED_MAX_BYTES = 1024
"""As the document of the bridge says."""


def slow_crc32(data: bytes, start: int = 0) -> int:
    """CRC-32 bit by bit, from its definition."""
    crc = start ^ 0xFFFFFFFF
    for byte in data:
        crc ^= byte
        for _ in range(8):
            crc = crc >> 1 ^ (0xEDB88320 if crc & 1 else 0)
    return crc ^ 0xFFFFFFFF


def slow_cobs(data: bytes) -> bytes:
    """COBS from its definition (Cheshire and Baker 1999): blocks of at most 254 bytes."""
    encoded, block, block_open = bytearray(), bytearray(), True
    for byte in data:
        block_open = True
        if byte:
            block.append(byte)
        if not byte or len(block) == 254:
            encoded += bytes([len(block) + 1]) + block
            block.clear()
            block_open = not byte
    if block_open:
        encoded += bytes([len(block) + 1]) + block
    return bytes(encoded)


def slow_frame(kind: int, payload: bytes, digest: int = 0) -> bytes:
    body = bytes([kind]) + payload
    return slow_cobs(body + slow_crc32(body, digest).to_bytes(4, "little")) + b"\0"


# The check value of CRC-32 is that of "123456789"; the other bytes are COBS by hand.
GOLDEN = [
    (0x31, b"23456789", 0, "0E 31 32 33 34 35 36 37 38 39 26 39 F4 CB 00"),
    (0x00, b"", 0, "01 05 8D EF 02 D2 00"),  # CRC-32 of one zero byte is D202EF8D
    (0x00, b"\0\0\0", 0, "01 01 01 01 05 1C DF 44 21 00"),  # of four: 2144DF1C
]


@pytest.mark.parametrize(("kind", "payload", "digest", "wire"), GOLDEN)
def test_a_frame_has_its_golden_bytes(kind: int, payload: bytes, digest: int, wire: str) -> None:
    assert encode_frame(kind, payload, digest) == bytes.fromhex(wire)
    assert FrameParser(digest).feed(bytes.fromhex(wire)) == [(kind, payload)]


@pytest.mark.parametrize("length", [0, 1, 3, 100, 248, 249, 250, 251, 252, 500, 1000])
@pytest.mark.parametrize("digest", [0, 0x0D99E4D6])
def test_frames_are_those_of_an_independent_encoder(length: int, digest: int) -> None:
    rng = random.Random(length)
    for content in (bytes(length), b"\xff" * length, rng.randbytes(length)):
        wire = encode_frame(0x02, content, digest)
        assert wire == slow_frame(0x02, content, digest)
        assert 0 not in wire[:-1]
        assert FrameParser(digest).feed(wire) == [(0x02, content)]


def test_encoding_refuses_what_no_receiver_would_take() -> None:
    for kind in (-1, 256):
        with pytest.raises(ValueError, match=f"{kind} is not a byte"):
            encode_frame(kind, b"")
    longest = next(n for n in range(1024, 0, -1) if fits(n))
    assert len(encode_frame(1, bytes(longest))) == ENCODED_MAX_BYTES + 1
    with pytest.raises(ValueError, match="1025 bytes, more than 1024"):
        encode_frame(1, bytes(longest + 1))


def fits(payload_bytes: int) -> bool:
    try:
        encode_frame(1, bytes(payload_bytes))
    except ValueError:
        return False
    return True


@pytest.mark.parametrize("size", [1, 2, 7, 64, 4096])
def test_frames_come_out_however_the_bytes_are_cut(size: int) -> None:
    sent = [(kind, bytes([kind]) * kind) for kind in range(1, 60)]
    stream = b"\0" + b"".join(encode_frame(*frame) for frame in sent)
    parser = FrameParser()
    got = []
    for at in range(0, len(stream), size):
        got += parser.feed(stream[at : at + size])
    assert got == sent
    counters = parser.counters
    assert (counters.frames, counters.bytes, counters.empty) == (59, len(stream), 1)
    assert counters.bad_cobs == counters.bad_crc == counters.too_long == 0


def test_a_frame_of_another_digest_fails_unless_its_type_has_none() -> None:
    parser = FrameParser(0x1234, unseeded={0x01})
    assert parser.feed(encode_frame(0x02, b"abc", 0x1235)) == []
    assert parser.feed(encode_frame(0x02, b"abc")) == []
    assert parser.counters.bad_crc == 2
    assert parser.feed(encode_frame(0x01, b"abc")) == [(0x01, b"abc")]
    assert parser.feed(encode_frame(0x02, b"abc", 0x1234)) == [(0x02, b"abc")]


@pytest.mark.parametrize(
    ("wire", "counter"),
    [
        ("05 11 22 33 00", "bad_cobs"),  # says four bytes and has three
        ("02 31 00", "bad_crc"),  # no room for a checksum
        ("05 11 22 33 44 00", "bad_crc"),
        ("01 01 01 01 01 00", "bad_crc"),  # of nothing, the right one
        ("0E 31 32 33 34 35 36 37 38 39 26 39 F4 CA 00", "bad_crc"),
        ("00", "empty"),
    ],
)
def test_damage_is_counted_and_the_next_frame_is_found(wire: str, counter: str) -> None:
    parser = FrameParser()
    good = encode_frame(0x31, b"23456789")
    assert parser.feed(bytes.fromhex(wire)) == []
    assert getattr(parser.counters, counter) == 1
    assert parser.feed(good) == [(0x31, b"23456789")]


def test_a_frame_with_any_single_bit_flipped_is_never_another_frame() -> None:
    payload = bytes(range(40))
    wire = encode_frame(0x02, payload, 0x0D99E4D6)
    good = encode_frame(0x03, b"next", 0x0D99E4D6)
    for bit in range(8 * len(wire)):
        damaged = bytearray(wire)
        damaged[bit // 8] ^= 1 << bit % 8
        parser = FrameParser(0x0D99E4D6)
        assert parser.feed(bytes(damaged)) == []
        assert parser.feed(b"\0" + good) == [(0x03, b"next")]


def test_what_is_too_long_is_dropped_up_to_the_next_zero_and_never_held() -> None:
    parser = FrameParser()
    for _ in range(100):
        assert parser.feed(b"\x55" * 1000) == []
        assert parser.held_bytes <= ENCODED_MAX_BYTES
    assert parser.counters.too_long == 1
    assert parser.feed(b"\0" + encode_frame(1, b"x")) == [(1, b"x")]
    assert parser.feed(b"\x55" * 100_000 + b"\0" + encode_frame(1, b"y")) == [(1, b"y")]
    assert parser.counters.too_long == 2


def test_the_longest_frame_passes_and_one_byte_more_does_not() -> None:
    parser = FrameParser()
    parser.feed(b"\xff" * ENCODED_MAX_BYTES + b"\0")
    assert parser.counters.too_long == 0
    parser.feed(b"\xff" * (ENCODED_MAX_BYTES + 1) + b"\0")
    assert parser.counters.too_long == 1


def test_after_a_reset_the_rest_of_a_frame_is_forgotten() -> None:
    parser = FrameParser()
    parser.feed(b"\x05\x11\x22")
    parser.reset()
    assert parser.held_bytes == 0
    assert parser.feed(encode_frame(9, b"fresh")) == [(9, b"fresh")]
