"""Link logs play as they were; damage costs what is damaged and no more."""

from __future__ import annotations

import io
import os
from collections.abc import Generator
from pathlib import Path

import can
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from graspd.drivers.base import JointReading, RecordingError, TactileReading
from graspd.drivers.biotac import sample_command
from graspd.drivers.can.frames import ERROR, EXTENDED, REMOTE, CanFrame
from graspd.drivers.recordings.can_log import CanLog, frame_of, line_of
from graspd.drivers.recordings.player import RecordedDriver
from graspd.drivers.recordings.serial_log import (
    Record,
    SerialLog,
    encode_records,
    parse_records,
)
from graspd.drivers.spi.driver import LineEvent
from graspd.drivers.spi.messages import FrameParser
from tests.drivers.palm.palm_stream import MS
from tests.kit.clock import Clock


@st.composite
def frames(draw: st.DrawFn) -> CanFrame:
    """A frame as it can come from a bus."""
    kind = draw(st.sampled_from([0, EXTENDED, REMOTE, REMOTE | EXTENDED, ERROR]))
    highest = 0x1FFFFFFF if kind & (EXTENDED | ERROR) else 0x7FF
    data = b"" if kind & REMOTE else draw(st.binary(max_size=8))
    return CanFrame(draw(st.integers(0, highest)), data, kind)


@given(frames(), st.integers(0, 4 * 10**18))
def test_a_frame_comes_back_from_its_line_to_the_microsecond(frame: CanFrame, wall_ns: int) -> None:
    line = line_of(frame, wall_ns, "can0")
    assert frame_of(line) == (wall_ns // 1000 * 1000, "can0", frame)


@given(frames())
def test_python_can_reads_our_lines(frame: CanFrame) -> None:
    if frame.flags & ERROR:
        return  # python-can keeps no class of an error
    (message,) = can.CanutilsLogReader(io.StringIO(line_of(frame, 10**18, "can0")))
    assert message.arbitration_id == frame.arbitration_id
    assert bytes(message.data or b"") == frame.data
    assert message.is_extended_id == bool(frame.flags & EXTENDED)
    assert message.is_remote_frame == bool(frame.flags & REMOTE)
    assert message.timestamp == pytest.approx(1e9)


@pytest.mark.parametrize(
    ("line", "frame"),
    [  # candump -L of can-utils
        ("(1436509052.249713) vcan0 044#2A366C2BBA\n", CanFrame(0x44, b"\x2a\x36\x6c\x2b\xba")),
        ("(1436509053.850870) vcan0 00000123#R\n", CanFrame(0x123, b"", EXTENDED | REMOTE)),
        (
            "(1436509053.850870) can0 20000004#0001000000000000",
            CanFrame(4, b"\0\1" + 6 * b"\0", ERROR),
        ),
        ("(1436509053.850870) can0 213#R8\n", CanFrame(0x213, b"", REMOTE)),
        ("(1436509053.850870) can0 213#11 R\n", CanFrame(0x213, b"\x11")),
    ],
)
def test_lines_of_candump_are_read(line: str, frame: CanFrame) -> None:
    found = frame_of(line)
    assert found is not None
    assert found[2] == frame


@pytest.mark.parametrize(
    "line",
    [
        "",
        "\n",
        "(1436509052.249713) vcan0 044#2A366",
        "(1436509052.249713) vcan0 844#2A",
        "(1436509052.24971) vcan0 044#2A",
        "(1436509052.249713) vcan0 044#" + "00" * 9,
        "(1436509052.249713) vcan0 044##311",
        "(1436509052.249713) vcan0 44#00",
        "(1436509052.249713) vcan0 0x4#00",
        "can0  100   [3]  0D 3A 1F",
    ],
)
def test_a_line_that_is_no_frame_is_none(line: str) -> None:
    assert frame_of(line) is None


@given(st.text(max_size=60))
def test_no_text_makes_the_line_parser_raise(text: str) -> None:
    frame_of(text)


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


@given(st.binary(min_size=961, max_size=2000))
def test_long_bytes_come_back_in_pieces(data: bytes) -> None:
    found = list(parse_records(FrameParser(), encode_records(LineEvent.RECEIVED, 5, data)))
    assert b"".join(piece for _, (_, piece) in found) == data
    assert max(len(piece) for _, (_, piece) in found) == 960
    assert {(t_ns, event) for t_ns, (event, _) in found} == {(5, LineEvent.RECEIVED)}


@given(st.lists(records, min_size=3, max_size=6), st.data())
def test_damage_costs_the_record_that_is_damaged_and_the_one_after_it_at_most(
    made: list[tuple[int, Record]], data: st.DataObject
) -> None:
    whole = bytearray(encoded(made))
    at = data.draw(st.integers(0, len(whole) - 1))
    whole[at] ^= data.draw(st.integers(1, 255))
    found = list(parse_records(FrameParser(), bytes(whole)))
    assert len(found) >= len(made) - 2
    assert all(record in made for record in found)


@given(st.binary(max_size=3000))
def test_no_bytes_make_the_record_parser_raise(data: bytes) -> None:
    list(parse_records(FrameParser(), data))


@pytest.mark.parametrize("content", [b"", b"\0" * 100, b"no frames\n" * 1000, bytes(range(256))])
def test_a_file_without_anything_from_a_link_is_refused(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "link.log"
    path.write_bytes(content)
    fingers = ("ff", "mf", "th")
    for driver in (CanLog([path], fingers), SerialLog([path], fingers)):
        with pytest.raises(RecordingError, match="nothing that came over a link"), driver:
            pass


def test_a_log_of_two_buses_is_refused(tmp_path: Path) -> None:
    """Two boards with one id would give one hand."""
    path, frame = tmp_path / "can.log", CanFrame(0x123, b"abc")
    lines = [line_of(frame, 10**18, bus) for bus in ("can0", "can0", "can1")]
    path.write_text("".join(lines))
    with pytest.raises(RecordingError, match=r"can\.log, line 3: is of bus 'can1', those"):
        list(CanLog([path], ("ff",)).records(path))


def test_the_frames_of_a_can_log_are_counted_and_other_lines_passed_over(tmp_path: Path) -> None:
    path = tmp_path / "can.log"
    log = CanLog([path], ("ff", "mf", "th"), sequence="electrodes")
    lines = ["# of yesterday\n", "\n"]
    for sweep in range(2):
        for at, channel in enumerate(range(17, 41)):
            t_ns = 10**18 + (24 * sweep + at) * 400_000
            data = bytes([sample_command(channel)]) + bytes.fromhex("A251 A8C8 94B9")
            lines.append(line_of(CanFrame(0x1A5, data), t_ns, "can0"))
    path.write_text("".join([*lines, "x" * 300 + "\n", lines[-1]]))
    records = list(log.records(path))
    assert len(records) == 49
    readings = [reading for record in records for reading in log.feed(*record)]
    assert [(reading.t_ns - 10**18) / 400_000 for reading in readings] == [23, 47]
    assert isinstance(readings[1], TactileReading)
    assert (readings[1].counts == [[2602], [2713], [2391]]).all()
    counters = log.stream.counters
    assert (counters.frames, counters.accepted_frames, counters.duplicate_frames) == (49, 49, 1)
    log.begin()
    assert log.stream.counters.frames == 0


def test_a_link_log_plays_at_its_own_pace_times_speed(tmp_path: Path) -> None:
    path, clock = tmp_path / "can.log", Clock()
    data = [bytes([sample_command(at)]) + bytes.fromhex("A251 A8C8 94B9") for at in range(17, 41)]
    times_ns = [10**18 + at * 400_000 for at in range(24 * 7)]
    lines = [
        line_of(CanFrame(0x1A5, data[at % 24]), t_ns, "can0") for at, t_ns in enumerate(times_ns)
    ]
    path.write_text("".join(lines))
    fingers = ("ff", "mf", "th")
    with CanLog([path], fingers, sequence="electrodes", speed=2.0, clock=clock) as driver:
        assert driver.period_ns is None
        began_ns, times_us = clock.now_ns, []
        while not driver.exhausted:
            clock.now_ns = driver.due_ns() or clock.now_ns
            times_us += [(r.t_ns - began_ns) // 1000 for r in driver.read_ready()]
        assert driver.period_ns == 24 * 200_000
    assert times_us == [(24 * sweep + 23) * 200 for sweep in range(7)]
    with CanLog([path], fingers, sequence="electrodes", clock=clock) as driver:
        assert len([reading for _ in range(7) for reading in driver.read_ready()]) == 7
        assert driver.period_ns == 24 * 400_000


RECORDED_NS = (500 * MS, 510 * MS, 530 * MS)


class Player(RecordedDriver[str]):
    def __init__(self, speed: float | None, clock: Clock) -> None:
        super().__init__([Path("x.csv")], speed, clock)

    def open(self) -> None:
        self.start(items())


def items() -> Generator[tuple[int, str], None, None]:
    yield from ((at_ns, f"at {at_ns // MS}") for at_ns in RECORDED_NS)


@pytest.mark.parametrize(("speed", "steps_ms"), [(1.0, [0, 10, 30]), (2.0, [0, 5, 15])])
def test_items_are_due_as_recorded_over_the_speed(speed: float, steps_ms: list[int]) -> None:
    clock = Clock()
    player = Player(speed, clock)
    player.open()
    assert player.due_ns() == clock.now_ns, "the first one begins the run"
    began_ns = clock.now_ns
    assert player.take() is not None
    for at_ns, step_ms in list(zip(RECORDED_NS, steps_ms, strict=True))[1:]:
        due_ns = began_ns + step_ms * MS
        assert player.due_ns() == due_ns
        clock.now_ns = due_ns - 1
        assert player.take() is None
        clock.now_ns = due_ns + 2
        assert player.take() == (at_ns, f"at {at_ns // MS}")
        assert player.played_ns(at_ns) == due_ns
    assert player.exhausted
    assert player.due_ns() is None


def test_without_a_speed_all_is_due_at_once_and_keeps_its_recorded_times() -> None:
    clock = Clock()
    player = Player(None, clock)
    player.open()
    taken = [player.take() for _ in RECORDED_NS]
    assert [at_ns for at_ns, _ in filter(None, taken)] == list(RECORDED_NS)
    assert [player.played_ns(at_ns) - clock.now_ns for at_ns in RECORDED_NS] == [
        *(0, 10 * MS, 30 * MS),
    ]
    assert player.exhausted


def test_a_reading_is_handed_over_as_old_as_it_was() -> None:
    clock = Clock()
    player = Player(None, clock)
    clock.now_ns += 5 * MS
    made = JointReading(480 * MS, 3, (), np.zeros(0))
    given = player.hand_over(made, 500 * MS)
    assert (given.t_ns, given.recorded_ns) == (clock.now_ns - 20 * MS, 480 * MS)
    assert player.handed_over_ns == clock.now_ns


def test_an_error_waits_until_what_is_before_it_was_taken() -> None:
    def broken() -> Generator[tuple[int, str], None, None]:
        yield 0, "first"
        raise RecordingError("x.csv", "no more")  # type: ignore[arg-type]

    player = Player(None, Clock())
    with pytest.raises(RuntimeError, match="not open"):
        player.take()
    player.start(broken())
    assert player.take() == (0, "first")
    assert not player.exhausted
    with pytest.raises(RecordingError, match="no more"):
        player.take()
    assert player.exhausted


def test_a_pipe_is_refused_instead_of_waited_for(tmp_path: Path) -> None:
    path = tmp_path / "pipe.log"
    os.mkfifo(path)
    with pytest.raises(RecordingError, match="is not a regular file"):
        CanLog([path], ("ff",)).open()


def test_a_folder_is_no_log(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match="is a directory"):
        CanLog([tmp_path], ("ff",)).open()
