"""Link logs play as they were; damage costs what is damaged and no more."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from graspd.drivers.base import JointReading, RecordingError
from graspd.drivers.recordings.csv_player import ReplayDriver
from graspd.drivers.recordings.serial_log import (
    Record,
    SerialLog,
    encode_records,
    parse_records,
)
from graspd.drivers.spi.conversation import LineEvent
from graspd.drivers.spi.messages import FrameParser, encode_frame
from tests.drivers.palm.palm_stream import MS
from tests.kit.clock import Clock

records = st.tuples(
    st.integers(0, 2**64 - 1), st.tuples(st.sampled_from(LineEvent), st.binary(max_size=900))
)


def encoded(made: list[tuple[int, Record]]) -> bytes:
    return b"".join(encode_records(event, t_ns, data) for t_ns, (event, data) in made)


@given(st.lists(records, max_size=10), st.integers(1, 50))
def test_records_come_back_however_the_file_is_cut_into_chunks(
    made: list[tuple[int, Record]], size: int
) -> None:
    data = encoded(made)
    parser = FrameParser()
    found = [
        record
        for start in range(0, len(data), size)
        for record in parse_records(parser, data[start : start + size])
    ]
    assert found == made
    frames = FrameParser()
    assert len(list(frames.feed(data))) == len(made)
    counters = frames.counters
    assert counters.bad_cobs + counters.bad_crc + counters.too_long == 0


@pytest.mark.parametrize(("kind", "size"), [(LineEvent.SENT, 7), (4, 8)])
def test_a_frame_of_another_type_or_length_is_left_out(kind: int, size: int) -> None:
    assert list(parse_records(FrameParser(), encode_frame(kind, bytes(size)))) == []


@given(st.binary(min_size=961, max_size=2000))
def test_long_bytes_come_back_in_pieces(data: bytes) -> None:
    found = list(parse_records(FrameParser(), encode_records(LineEvent.RECEIVED, 5, data)))
    assert b"".join(piece for _, (_, piece) in found) == data
    assert max(len(piece) for _, (_, piece) in found) == 960
    assert {(t_ns, event) for t_ns, (event, _) in found} == {(5, LineEvent.RECEIVED)}


def test_damaged_records_are_counted_and_the_first_is_placed(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    path = tmp_path / "line.serial"
    content = bytearray(encoded([(at, (LineEvent.RECEIVED, bytes(80))) for at in range(200)]))
    size = len(content) // 200
    for number in (120, 150):
        content[number * size + 20] ^= 0x40
    path.write_bytes(content)
    driver = SerialLog([path], ("ff", "mf", "th"))
    assert len(list(driver.records(path))) == 198
    assert "2 of 200 records were damaged; the first is before byte 12288" in caplog.text


@pytest.mark.parametrize("content", [b"", b"no frames\n" * 1000])
def test_a_file_without_anything_from_a_link_is_refused(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "link.serial"
    path.write_bytes(content)
    with pytest.raises(RecordingError, match="nothing that came over a link"):
        SerialLog([path], ("ff", "mf", "th")).open()


def test_a_reading_is_handed_over_as_old_as_it_was() -> None:
    clock = Clock()
    player = ReplayDriver([Path("x.csv")], clock=clock)
    clock.now_ns += 5 * MS
    made = JointReading(480 * MS, 3, (), np.zeros(0))
    given = player.hand_over(made, 500 * MS)
    assert (given.t_ns, given.recorded_ns) == (clock.now_ns - 20 * MS, 480 * MS)
    assert player.handed_over_ns == clock.now_ns
