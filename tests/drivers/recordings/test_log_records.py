"""Lines of CAN logs and records of serial ones are what was sent, or are counted as damaged."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from graspd.drivers.base import JointReading, LinkCause, RecordingError
from graspd.drivers.can.frames import ERROR, EXTENDED, LOST, REMOTE, CanFrame
from graspd.drivers.recordings.can_files import read_asc, read_trc
from graspd.drivers.recordings.can_log import line_of
from graspd.drivers.recordings.candump import NO_BUS, Logged, parse
from graspd.drivers.recordings.csv_player import ReplayDriver
from graspd.drivers.recordings.serial_log import (
    Record,
    SerialLog,
    encode_records,
    parse_records,
)
from graspd.drivers.spi.conversation import LineEvent
from graspd.drivers.spi.messages import FrameParser, Ping, encode, encode_frame
from tests.drivers.palm.palm_stream import MS
from tests.drivers.spi.bridge_bench import hello, sweep
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
    assert parse(line) == Logged(wall_ns // 1000 * 1000, "can0", frame)


BUS_WARNING = CanFrame(4, b"\0\1" + 6 * b"\0", ERROR)
WARNING_DATA = "00 01 00 00 00 00 00 00"
EIGHT = CanFrame(0x123, bytes.fromhex("1122334455667788"))
ASKED = CanFrame(0x123, b"", EXTENDED | REMOTE)
THREE = CanFrame(0x123, b"\x0d\x3a\x1f")
AT_NS = 1_436_509_052_249_713_000


@pytest.mark.parametrize(
    ("line", "t_ns", "frame"),
    [  # candump of can-utils: -L and -l
        ("(1436509052.249713) can0 123#0d3a1f R\r\n", AT_NS, THREE),
        ("(1436509052.249713) can0 123#0D3A1F T", AT_NS, THREE),
        ("(1436509052.249713251)   can0 123#0D3A1F", AT_NS + 251, THREE),
        ("(1436509052.2497132519) can0 123#0D3A1F", AT_NS + 251, THREE),
        ("(1436509052.2497) can0 123#0D3A1F", AT_NS - 13_000, THREE),
        ("(0000000052) can0 123#", 52 * 10**9, CanFrame(0x123, b"")),
        ("(1436509052.249713) can0 00000123#R", AT_NS, ASKED),
        ("(1436509052.249713) can0 213#R8", AT_NS, CanFrame(0x213, b"", REMOTE)),
        ("(1436509052.249713) can0 20000004#0001000000000000", AT_NS, BUS_WARNING),
        ("(1436509052.249713) can0 123#1122334455667788_B", AT_NS, EIGHT),
        ("(1436509052.249713) can0 123##10D3A1F", AT_NS, None),
        # -ta, -tA, with -x, -a, -c, -e, and as older versions align ids
        (" (1436509052.249713)  can0  123   [3]  0D 3A 1F", AT_NS, THREE),
        (" (2015-07-10 06:17:32.249713)  can0  123   [3]  0D 3A 1F", AT_NS, THREE),
        (" (1436509052.249713)  can0  RX - -  123   [3]  0D 3A 1F", AT_NS, THREE),
        (" (1436509052.249713)  can0  TX B E       123   [3]  0D 3A 1F   '.:.'", AT_NS, THREE),
        ("\x1b[34m (1436509052.249713)  \x1b[32mcan0\x1b[0m  123   [3]  0D 3A 1F", AT_NS, THREE),
        (" (1436509052.249713)  can0   52  [2] 0D 3A", AT_NS, CanFrame(0x52, b"\x0d\x3a")),
        (" (1436509052.249713)  can0  00000123   [0] ", AT_NS, CanFrame(0x123, b"", EXTENDED)),
        (" (1436509052.249713)  can0  00000123   [8]  remote request", AT_NS, ASKED),
        (f" (1436509052.249713) can0 20000004 [8] {WARNING_DATA}  ERRORFRAME", AT_NS, BUS_WARNING),
        (f" (1436509052.249713)  can0  123  [12]  {WARNING_DATA} 08 09 0A 0B", AT_NS, None),
    ],
)  # fmt: skip
def test_lines_of_candump_are_read(line: str, t_ns: int, frame: CanFrame | None) -> None:
    found = parse(line)
    assert found is not None
    assert found[:3] == (t_ns, "can0", frame)


@pytest.mark.parametrize(
    "line",
    [
        "\n",
        "(1436509052.249713) vcan0 044#2A366",
        "(1436509052.249713) vcan0 844#2A",
        "(1436509052.249713) vcan0 044#" + "00" * 9,
        "(1436509052.249713) vcan0 44#00",
        "can0  100   [3]  0D 3A 1F",
        " (000.000123)  can0  100   [3]  0D 3A",
        " (000.000123)  can0  100   [2]  00001101 00111010",
        " (2015-13-10 06:17:32.249713)  can0  123   [3]  0D 3A 1F",
    ],
)
def test_a_line_without_a_time_or_valid_frame_gives_none(line: str) -> None:
    assert parse(line) is None


def test_a_dropcount_line_of_candump_is_a_loss_frame() -> None:
    line = "DROPCOUNT: dropped 3 CAN frames on 'can0,5A1:7FF' socket (total drops 3)\n"
    assert parse(line) == Logged(None, "can0", CanFrame(0, b"", LOST))


@given(st.text(max_size=60))
def test_no_text_makes_a_line_parser_raise(text: str) -> None:
    parse(text)
    list(read_asc([text]))
    list(read_trc([text]))


HALF_NS = 500_000_000
ASC_HEAD = ["date Thu Nov 26 12:31:53.458 2026", "base hex  timestamps absolute", "// a comment"]
ERROR_FRAME = CanFrame(0x80, b"", ERROR)


@pytest.mark.parametrize(
    ("line", "logged"),
    [
        ("0.5 1  123             Rx   d 3 0D 3A 1F", Logged(HALF_NS, "can0", THREE)),
        ("0.5 2  123x  Rx   r 3", Logged(HALF_NS, "can1", ASKED)),
        ("0.5 1  ErrorFrame", Logged(HALF_NS, "can0", ERROR_FRAME)),
        ("0.5 1  123  Rx   d 3 0D 3A 1F  Length = 0 BitCount = 64", Logged(HALF_NS, "can0", THREE)),
        ("0.5 CANFD 1 Rx 123 Name 1 0 3  3 0D 3A 1F  9 8 3000 0 0", Logged(HALF_NS, "can0", None)),
        ("0.5 CANFD  1 Rx  123  0 0 3  3 0D 3A 1F  9 8 200000", Logged(HALF_NS, "can0", THREE)),
        ("0.5 1  123             Rx   d 3 0D A 1F", None),
        ("0.5 1  FFFFFFFFx       Rx   d 1 00", None),
        ("0.5 1  923             Rx   d 1 00", None),
        ("0.5 CANFD 1 Rx 123", None),
        ("nonsense", None),
    ],
)  # fmt: skip
def test_lines_of_an_asc_file_are_read(line: str, logged: Logged | None) -> None:
    others = ["0.4 1  Statistic: D 1 R 0", "0.4 CAN 1 Status:chip status error active", ""]
    ((number, _, found),) = read_asc([*ASC_HEAD, *others, line])
    assert (number, found) == (len(ASC_HEAD) + 4, logged)


def test_decimal_data_of_an_asc_file_is_read() -> None:
    ((_, _, found),) = read_asc(["base dec  timestamps absolute", "0.5 1 291 Rx d 3 13 58 31"])
    assert found == Logged(HALF_NS, "can0", THREE)


def test_asc_lines_without_frames_keep_their_relative_time() -> None:
    lines = ["base hex  timestamps relative", "0.5 1  Statistic: D 1 R 0"]
    ((number, _, found),) = read_asc(lines)
    assert (number, found) == (2, Logged(HALF_NS, NO_BUS, None, may_be_step=True))


TRC_2_1 = [";$FILEVERSION=2.1", ";$STARTTIME=0", ";$COLUMNS=N,O,T,B,I,d,R,L,D"]
DAYS_S = 25569 * 86400
"""Seconds from the zero of times in TRC files, 30 December 1899, to that of Unix."""


@pytest.mark.parametrize(
    ("head", "line", "frame"),
    [  # lines as in PEAK's description of the formats
        ([], "     1)      500  0123  3  0D 3A 1F", THREE),
        ([";$FILEVERSION=1.1"], "     1)      500.0  Rx     0123  3  0D 3A 1F", THREE),
        ([";$FILEVERSION=1.3"], "     1)      500.0 1  Rx     0123  -  3    0D 3A 1F", THREE),
        (TRC_2_1, "      1     500.000 DT  1     0123 Rx -  3    0D 3A 1F", THREE),
        (TRC_2_1, "      1     500.000 RR  1 00000123 Rx -  3", ASKED),
        (TRC_2_1, "      1     500.000 FD  1     0123 Rx -  3    0D 3A 1F", "CAN FD"),
        (TRC_2_1, "      1     500.000 DT  1     0123 Rx -  3    0D 3A", None),
        ([";$FILEVERSION=1.1"], "     1)      500.0  Rx     0123  3  0D A 1F", None),
        ([";$FILEVERSION=1.2"], "     1)      500.0 1  Rx     0123  3    0D 3A 1F", None),
    ],
)  # fmt: skip
def test_lines_of_a_trc_file_are_read(
    head: list[str], line: str, frame: CanFrame | str | None
) -> None:
    ((number, _, found),) = read_trc([*head, ";  Message Number", line])
    at_ns = HALF_NS - (DAYS_S * 10**9 if head == TRC_2_1 else 0)
    logged = Logged(at_ns, "can0", frame if isinstance(frame, CanFrame) else None)
    assert (number, found) == (len(head) + 2, None if frame is None else logged)


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


def test_damaged_records_are_counted_and_the_first_is_located(
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


def test_a_record_whose_time_is_too_late_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "line.serial"
    path.write_bytes(encoded([(2**64 - 1, (LineEvent.RECEIVED, b"a"))]))
    with pytest.raises(RecordingError, match=r"line.serial: the time 18446744073.7 s is later"):
        list(SerialLog([path], ("ff", "mf", "th")).records(path))


def test_each_opening_of_a_logged_port_is_up_after_its_own_wait(
    caplog: pytest.LogCaptureFixture,
) -> None:
    log = SerialLog([Path("line.serial")], ("ff", "mf", "th"))
    caplog.set_level("INFO")
    for start_ns in (50_000_000 * MS, 50_500_000 * MS):
        log.feed(start_ns, (LineEvent.OPENED, b""))
        for nonce in (1, 2):
            log.feed(start_ns, (LineEvent.SENT, encode(Ping(nonce))))
            log.feed(start_ns + 250 * MS, (LineEvent.RECEIVED, encode(hello(nonce, 1000))))
        for seq in (0, 1):
            end_ns = start_ns + 250 * MS + seq * 10 * MS
            log.feed(end_ns, (LineEvent.RECEIVED, encode(sweep(seq, 2000 + seq * 10_000))))
    assert caplog.text.count("up after 0.2") == caplog.text.count("up after") == 2
    for t_ns in range(51_000_000 * MS, 51_000_003 * MS, MS):
        log.stream.lost(LinkCause.SILENT, "no answer", t_ns)
        log.feed(t_ns, (LineEvent.OPENED, b""))
    assert caplog.text.count("no answer") == 1


@pytest.mark.parametrize("content", [b"", b"no frames\n" * 1000])
def test_a_file_without_anything_from_a_link_is_refused(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "link.serial"
    path.write_bytes(content)
    with pytest.raises(RecordingError, match="nothing that came over a link"):
        SerialLog([path], ("ff", "mf", "th")).open()


def test_hand_over_keeps_the_age_of_a_recorded_reading() -> None:
    clock = Clock()
    player = ReplayDriver([Path("x.csv")], clock=clock)
    clock.now_ns += 5 * MS
    made = JointReading(480 * MS, 3, (), np.zeros(0))
    given = player.hand_over(made, 500 * MS)
    assert (given.t_ns, given.recorded_ns) == (clock.now_ns - 20 * MS, 480 * MS)
    assert player.handed_over_ns == clock.now_ns
