"""Damaged bytes raise nothing, give no value that was not sent, and hide no later good frame."""

from __future__ import annotations

import itertools

from hypothesis import given, settings
from hypothesis import strategies as st

from graspd.drivers.base import COUNT_MAX, FINGERS
from graspd.drivers.palm.packet import CAN_RECORD_BYTES, Palm, parse_packet
from graspd.drivers.palm.stream import PalmStream
from graspd.drivers.spi.messages import (
    DELIMITER,
    DIGEST,
    ENCODED_MAX_BYTES,
    FrameParser,
    encode_frame,
)
from graspd.drivers.twins.palm import PalmTwin
from tests.drivers.twins.signals import GeneratedContact

MS = 1_000_000
PACKETS_KEPT = 14
"""Packets of a round: the most that the assembler may hold."""
PACKETS = [
    packet.to_bytes() + appended
    for palm, appended in itertools.product(Palm, (b"", bytes(CAN_RECORD_BYTES)))
    for packet in PalmTwin(itertools.islice(GeneratedContact(), 4), palm=palm).packets()
]


@st.composite
def damaged(draw: st.DrawFn, good: bytes, other: bytes) -> bytes:
    """Draw what a link may make of a frame: parts of it are lost, spoilt, repeated or another's."""
    data = good
    for _ in range(draw(st.integers(1, 3))):
        start, end = sorted(draw(st.tuples(*[st.integers(0, len(data))] * 2)))
        part = data[start:end]
        spoilt = st.binary(min_size=len(part), max_size=len(part))
        instead = draw(
            st.sampled_from([b"", part * 3, bytes(len(part)), b"\xff" * len(part), other[start:]])
            | spoilt
            | st.binary(max_size=3000)
        )
        data = data[:start] + instead + data[end:]
    return data


FRAMES = st.tuples(
    st.integers(0, 255),
    st.binary(max_size=300) | st.sampled_from([b"", bytes(254), b"\xff" * 255]),
)


@settings(max_examples=2000)
@given(st.data(), FRAMES, FRAMES)
def test_a_damaged_frame_of_a_bridge_is_nothing_and_the_next_one_is_found(
    data: st.DataObject, frame: tuple[int, bytes], other: tuple[int, bytes]
) -> None:
    good, wire = (encode_frame(*each, DIGEST) for each in (frame, other))
    bad = data.draw(damaged(good, wire)) + DELIMITER
    cut = data.draw(st.integers(0, len(bad)))
    parser, found = FrameParser(DIGEST), list[tuple[int, bytes]]()
    for piece in (bad[:cut], bad[cut:]):
        found += parser.feed(piece)
        assert parser.held_bytes <= ENCODED_MAX_BYTES
    assert set(found) <= {frame, other}
    assert parser.feed(wire) == [other]


@settings(max_examples=300)
@given(st.data(), st.lists(st.sampled_from(PACKETS), min_size=1, max_size=40))
def test_no_damaged_packet_of_a_palm_gives_a_count_that_is_none(
    data: st.DataObject, packets: list[bytes]
) -> None:
    """Packets have no checksum: one whose damage leaves it plausible is a packet."""
    stream = PalmStream(FINGERS)
    for cycle, good in enumerate(packets):
        other = packets[cycle - 1]
        for chunk in (data.draw(damaged(good, other)), good):
            packet = parse_packet(chunk, stream.counters)
            for reading in () if packet is None else stream.push(packet, cycle * MS):
                assert reading.counts.max() <= COUNT_MAX
        assert sum(kept is not None for kept in stream.packets) <= PACKETS_KEPT
        assert packet is not None
        assert packet.to_bytes() == good[: len(packet.to_bytes())]
