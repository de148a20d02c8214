"""Damaged bytes raise nothing, give no value that was not sent, and hide no later good frame."""

from __future__ import annotations

import itertools

from hypothesis import given, settings
from hypothesis import strategies as st

from graspd.biotac import COUNT_MAX, FINGERS
from graspd.drivers.base import TactileReading
from graspd.drivers.can.frames import ERROR, REMOTE, unpack_frame
from graspd.drivers.palm.packet import CAN_RECORD_BYTES, Palm, parse_packet
from graspd.drivers.palm.stream import PalmStream
from graspd.drivers.spi.messages import (
    DELIMITER,
    DIGEST,
    ENCODED_MAX_BYTES,
    FrameParser,
    encode_frame,
)
from graspd.drivers.twins.datagrams import PalmTwin
from tests.drivers.can.can_standin import decoder, sweep_of_frames
from tests.drivers.can.can_words import pack_frame
from tests.drivers.one_sweep import counts_of, sweeps_of

MS = 1_000_000
PACKETS_KEPT = 14
"""Packets of a round: the most that the assembler may hold."""
PACKETS = [
    [packet.to_bytes() + appended for packet in PalmTwin(sweeps_of(4), palm=palm).packets()]
    for palm, appended in itertools.product(Palm, (b"", bytes(CAN_RECORD_BYTES)))
]
"""Packets of four rounds by kind of palm, each without and with a CAN record appended."""


@st.composite
def damaged(draw: st.DrawFn, good: bytes, other: bytes) -> bytes:
    """Draw what a link may make of a frame: parts of it are lost, spoilt, repeated or another's."""
    data = good
    for _ in range(draw(st.integers(1, 2))):
        start, end = sorted(draw(st.tuples(*[st.integers(0, len(data))] * 2)))
        part = data[start:end]
        spoilt = st.binary(min_size=len(part), max_size=len(part))
        instead = draw(
            st.sampled_from([b"", part * 2, bytes(len(part)), b"\xff" * len(part), other[start:]])
            | spoilt
            | st.binary(max_size=300)
        )
        data = data[:start] + instead + data[end:]
    return data


FRAMES = st.tuples(
    st.integers(0, 255),
    st.binary(max_size=300) | st.sampled_from([b"", bytes(254), b"\xff" * 255]),
)


@settings(max_examples=300)
@given(st.data(), FRAMES, FRAMES)
def test_the_frame_after_a_damaged_bridge_frame_is_found(
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


@st.composite
def spoilt(draw: st.DrawFn) -> tuple[int, dict[int, bytes]]:
    """Draw a kind of palm, and damaged packets of it by their place in `PACKETS`."""
    kind = draw(st.integers(0, len(PACKETS) - 1))
    places = draw(st.lists(st.integers(14, 41), min_size=1, max_size=3, unique=True))
    packets = PACKETS[kind]
    return kind, {at: draw(damaged(packets[at], packets[at - 1])) for at in places}


@settings(max_examples=100)
@given(spoilt())
def test_a_damaged_palm_packet_gives_no_impossible_count(
    spoilt: tuple[int, dict[int, bytes]],
) -> None:
    """Packets have no checksum, so one that still looks right after damage is read."""
    kind, changes = spoilt
    stream, readings = PalmStream(FINGERS), 0
    for cycle, good in enumerate(PACKETS[kind]):
        packet = parse_packet(changes.get(cycle, good), stream.counters)
        for reading in () if packet is None else stream.push(packet, cycle * MS):
            assert reading.counts.max() <= COUNT_MAX
            readings += 1
        assert sum(kept is not None for kept in stream.packets) <= PACKETS_KEPT
    assert packet is not None
    assert packet.to_bytes() == good[: len(packet.to_bytes())]
    assert readings, "the undisturbed rounds are read"


@settings(max_examples=100)
@given(st.booleans(), st.data())
def test_damaged_can_frames_hide_no_later_sweep(is_lost: bool, data: st.DataObject) -> None:
    made, counters = decoder()
    good = [pack_frame(frame) for frame in sweep_of_frames(0)]
    bad = damaged(data.draw(st.sampled_from(good)), good[-1])
    readings: list[TactileReading] = []
    for at, raw in enumerate(data.draw(st.lists(bad | st.sampled_from(good), max_size=30))):
        frame = unpack_frame(raw)
        if frame is not None and not frame.flags & (REMOTE | ERROR):
            readings += made.push(frame, at * MS)
    if is_lost:
        made.interrupt()
    start_ns = 5_000 * MS
    for at, frame in enumerate(frame for n in (1, 2, 3) for frame in sweep_of_frames(n)):
        readings += made.push(frame, start_ns + at * 227_000)
    assert counters.readings == len(readings)
    assert not readings[-1].faults.any()
    assert (readings[-1].counts == counts_of(3)).all()
