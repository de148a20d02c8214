"""CAN logs of all kinds play one bus as it was; what is not understood is counted and shown."""

from __future__ import annotations

import io
import logging
from collections.abc import Callable, Iterator, Sequence
from itertools import pairwise
from pathlib import Path

import can
import pytest
from hypothesis import given
from hypothesis import strategies as st

from graspd.drivers.base import RecordingError, TactileReading
from graspd.drivers.biotac import sample_command
from graspd.drivers.can.frames import ERROR, EXTENDED, LOST, REMOTE, CanFrame
from graspd.drivers.recordings.can_files import read_asc, read_trc
from graspd.drivers.recordings.can_log import CanLog, line_of, read_log
from graspd.drivers.recordings.candump import Logged, parse
from tests.drivers.one_sweep import tactile
from tests.kit.clock import Clock

SAMPLE_ID = 0x5A1
MF_FF_TH = [[2602], [2713], [2391]]
"""Counts in the words A251 A8C8 94B9 (bytes of 7 bits and odd parity: manual, table 8)."""
SAMPLES = [bytes([sample_command(at)]) + bytes.fromhex("A251 A8C8 94B9") for at in range(17, 41)]
"""Data of the frames of one sweep of the electrodes."""
STEP_NS = 400_000


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


BUS_WARNING = CanFrame(4, b"\0\1" + 6 * b"\0", ERROR)
WARNING_DATA = "00 01 00 00 00 00 00 00"
EIGHT = CanFrame(0x123, bytes.fromhex("1122334455667788"))
ASKED = CanFrame(0x123, b"", EXTENDED | REMOTE)
THREE = CanFrame(0x123, b"\x0d\x3a\x1f")
AT_NS = 1_436_509_052_249_713_000


@pytest.mark.parametrize(
    ("line", "t_ns", "frame"),
    [  # candump of can-utils: -L and -l
        ("(1436509052.249713) can0 123#0D3A1F\n", AT_NS, THREE),
        ("(1436509052.249713) can0 123#0d3a1f R\r\n", AT_NS, THREE),
        ("(1436509052.249713) can0 123#0D3A1F T", AT_NS, THREE),
        ("(1436509052.249713250)   can0 123#0D3A1F", AT_NS + 250, THREE),
        ("(1436509052.2497) can0 123#0D3A1F", AT_NS - 13_000, THREE),
        ("(1436509052) can0 123#0D3A1F", 1_436_509_052 * 10**9, THREE),
        ("(0000000052.249713) can0 123#", 52_249_713_000, CanFrame(0x123, b"")),
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
        "(1436509052,249713) vcan0 044#2A",
        "(1436509052.249713) vcan0 044#" + "00" * 9,
        "(1436509052.249713) vcan0 44#00",
        "(1436509052.249713) vcan0 0x4#00",
        "can0  100   [3]  0D 3A 1F",
        " (000.000123)  can0  100   [3]  0D 3A",
        " (000.000123)  can0  100   [3]  0D 3A 1",
        " (000.000123)  can0  100   [3]  1F`3A`0D",
        " (000.000123)  can0  100   [2]  00001101 00111010",
        " (2015-13-10 06:17:32.249713)  can0  123   [3]  0D 3A 1F",
    ],
)
def test_a_line_that_is_no_frame_is_none(line: str) -> None:
    assert parse(line) is None


def test_where_candump_lost_frames_is_a_loss() -> None:
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
        ("0.5 CANFD  1 Rx  123  1 0 3  3 0D 3A 1F   0 0 3000 0 0 0", Logged(HALF_NS, "can0", None)),
        ("0.5 CANFD 1 Rx 123  Name  0 0 3  3 0D 3A 1F  9 8 200000", Logged(HALF_NS, "can0", THREE)),
        ("0.5 1  123             Rx   d 3 0D 3A", None),
        ("0.5 1  123             Rx   d 3 0D A 1F", None),
        ("0.5 1  123             Rx   d 3 0D XX 1F", None),
        ("0.5 1  FFFFFFFFx       Rx   d 1 00", None),
        ("0.5 1  923             Rx   d 1 00", None),
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


TRC_2_1 = [";$FILEVERSION=2.1", ";$STARTTIME=0", ";$COLUMNS=N,O,T,B,I,d,R,L,D"]
DAYS_S = 25569 * 86400
"""From the zero of TRC files, 30 December 1899, to that of Unix."""


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
        (TRC_2_1, "      1     500.000 DT  1     0123 Rx -  3    0D 3A 1", None),
        ([";$FILEVERSION=1.1"], "     1)      500.0  Rx     0123  3  0D A 1F", None),
        ([";$FILEVERSION=1.2"], "     1)      500.0 1  Rx     0123  3    0D 3A 1F", None),
    ],
)  # fmt: skip
def test_lines_of_a_trc_file_are_read(
    head: list[str], line: str, frame: CanFrame | str | None
) -> None:
    ((_, _, found),) = read_trc([*head, ";  Message Number", line])
    at_ns = HALF_NS - (DAYS_S * 10**9 if head == TRC_2_1 else 0)
    logged = Logged(at_ns, "can0", frame if isinstance(frame, CanFrame) else None)
    assert found == (None if frame is None else logged)


def messages(sweeps: int, channel: int = 0) -> Iterator[can.Message]:
    for at in range(24 * sweeps):
        yield can.Message(
            timestamp=1e9 + at * STEP_NS / 1e9,
            arbitration_id=SAMPLE_ID,
            is_extended_id=False,
            data=SAMPLES[at % 24],
            channel=channel,
        )


def lines_of(sweeps: int, bus: str = "can0", since_ns: int = 10**18) -> list[str]:
    frames = [CanFrame(SAMPLE_ID, data) for data in SAMPLES] * sweeps
    return [line_of(frame, since_ns + at * STEP_NS, bus) for at, frame in enumerate(frames)]


def played(paths: Sequence[Path], channel: str = "can0") -> tuple[list[TactileReading], CanLog]:
    fingers = ("ff", "mf", "th")
    log = CanLog(paths, fingers, channel=channel, sequence="electrodes", arbitration_id=SAMPLE_ID)
    with log:
        readings: list[TactileReading] = []
        while not log.exhausted:
            readings += tactile(log.read_ready())
    return readings, log


@pytest.mark.parametrize("ending", ["asc", "blf", "csv", "trc", "log"])
def test_what_python_can_writes_plays_as_it_was(tmp_path: Path, ending: str) -> None:
    path = tmp_path / f"bus.{ending}"
    writer = can.Logger(path)
    for message in messages(9):
        writer(message)
    writer.stop()
    readings, log = played([path.rename(tmp_path / "bus.txt")], "can0" if ending != "log" else "0")
    assert len(readings) == 9
    for reading in readings:
        assert (reading.counts == MF_FF_TH).all()
        assert not reading.faults.any()
    steps_ns = {b.made_ns - a.made_ns for a, b in pairwise(readings)}
    assert max(abs(step_ns - 24 * STEP_NS) for step_ns in steps_ns) < 1000
    assert log.stream.counters.frames == 9 * 24


@pytest.mark.parametrize("ending", ["asc", "blf", "trc"])
def test_other_frames_of_a_log_are_never_samples(tmp_path: Path, ending: str) -> None:
    path = tmp_path / f"bus.{ending}"
    writer = can.Logger(path)
    kinds = ({"is_error_frame": True}, {"is_remote_frame": True}, {"is_fd": True})
    for message in messages(3):
        writer(message)
        for kind in kinds:
            data = b"" if kind.get("is_remote_frame") else message.data
            writer(can.Message(message.timestamp, SAMPLE_ID, False, data=data, channel=0, **kind))
    writer.stop()
    readings, log = played([path])
    counters, written = log.stream.counters, 0 if ending == "trc" else 3 * 24
    assert len(readings) == 3
    assert not any(reading.faults.any() for reading in readings)
    assert (counters.remote_frames, counters.error_frames) == (written, written)
    assert counters.malformed_frames == written


@pytest.mark.parametrize("damage", ["cut", "flipped", "long"])
def test_a_damaged_blf_file_plays_up_to_the_damage(
    tmp_path: Path, damage: str, caplog: pytest.LogCaptureFixture
) -> None:
    path = tmp_path / "bus.blf"
    with can.BLFWriter(path, max_container_size=4096) as writer:
        for message in messages(20):
            writer(message)
    content = bytearray(path.read_bytes())
    second = content.index(b"LOBJ", content.index(b"LOBJ") + 4)
    if damage == "cut":
        del content[second + 8 :]
    elif damage == "flipped":
        content[second] ^= 1
    else:
        content[second + 8 : second + 12] = b"\xff\xff\xff\x7f"
    path.write_bytes(content)
    readings, _ = played([path])
    assert 2 <= len(readings) < 20
    assert "1 of " in caplog.text
    assert "damaged" in caplog.text


def test_the_channel_of_a_scene_chooses_the_bus(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Two boards with one id would give one hand."""
    caplog.set_level(logging.INFO)
    path = tmp_path / "any.log"
    other = lines_of(4, "can1")
    both = [line for pair in zip(lines_of(4), other, strict=True) for line in pair]
    path.write_text("".join(both))
    for channel in ("can0", "can1"):
        readings, log = played([path], channel)
        assert len(readings) == 4
        assert log.stream.counters.frames == 4 * 24
        assert f"has the channels can0, can1; played is {channel}" in caplog.text
    with pytest.raises(RecordingError, match=r"has the channels can0, can1: set tactile\.channel"):
        played([path], "can2")
    path.write_text("".join(other))
    readings, _ = played([path], "can0")
    assert len(readings) == 4
    assert "has no channel can0; played is can1" in caplog.text
    monkeypatch.setattr("graspd.drivers.recordings.can_log.FIRST_LINES", 48)
    path.write_text("".join([*lines_of(4), *other]))
    readings, _ = played([path], "can0")
    assert len(readings) == 4
    assert f"{path}: line 97 has the channel can1, too" in caplog.text


def test_lines_that_are_not_understood_are_counted(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    path = tmp_path / "bus.log"
    path.write_text("".join(["# of yesterday\n", "\n", *lines_of(2), "x" * 300 + "\n", "0.5 y"]))
    readings, log = played([path])
    assert len(readings) == 2
    assert log.stream.counters.frames == 48
    assert f"2 of 50 lines were not understood; the first is line 51, '{'x' * 80}'" in caplog.text


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("can0  5A1   [3]  0D 3A 1F\n", r"no line was understood: line 1, 'can0 .*candump -L"),
        ("(1.0) can0 5A1##00D3A1F\n", "has frames of CAN FD alone"),
    ],
)
def test_a_log_without_frames_of_a_board_is_refused(tmp_path: Path, text: str, says: str) -> None:
    path = tmp_path / "bus.log"
    path.write_text(text)
    with pytest.raises(RecordingError, match=says):
        played([path])


@pytest.mark.parametrize("encoding", ["utf-16", "utf-16-be", "utf-8-sig"])
def test_a_log_of_another_encoding_and_with_a_torn_end_is_read(
    tmp_path: Path, encoding: str
) -> None:
    """PowerShell writes UTF-16; a computer that lost power leaves zeros."""
    path = tmp_path / "bus.txt"
    mark = "\ufeff" if encoding == "utf-16-be" else ""
    path.write_text(mark + "".join(lines_of(3)) + "\0" * 100, encoding)
    readings, _ = played([path])
    assert len(readings) == 3


def test_an_id_that_no_frame_has_is_named(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    path = tmp_path / "bus.log"
    path.write_text("".join(lines_of(2)).replace(" 5A1#", " 0A2#"))
    readings, _ = played([path])
    assert readings == []
    assert "no frame of the begin has tactile.arbitration_id 0x5a1; there are 0xa2" in caplog.text


def shown(times_ns: Sequence[int]) -> str:
    """The lines of one sweep after the other as candump shows them."""
    times = [f"({t_ns // 10**9:03}.{t_ns % 10**9 // 1000:06})" for t_ns in times_ns]
    frames = [f"5A1   [7]  {data.hex(' ').upper()}" for data in SAMPLES * (len(times) // 24)]
    return "".join(f" {time}  can0  {data}\n" for time, data in zip(times, frames, strict=True))


def asc(times_ns: Sequence[int]) -> str:
    """The same of an ASC file, with two lines that are not frames of the bus."""
    frames = [f"1 5A1 Rx d 7 {data.hex(' ').upper()}" for data in SAMPLES * (len(times_ns) // 24)]
    lines = [f"{t_ns / 1e9:.6f} {frame}" for t_ns, frame in zip(times_ns, frames, strict=True)]
    head = ["base hex  timestamps relative", "0.000000 Start of measurement", "0.000000 1 what?"]
    return "\n".join([*head, *lines, ""])


@pytest.mark.parametrize("written", [shown, asc])
@pytest.mark.parametrize("jitter_ns", [0, 90_000])
@pytest.mark.parametrize("is_step", [True, False])
def test_times_since_the_frame_before_are_told_from_others(
    tmp_path: Path, is_step: bool, jitter_ns: int, written: Callable[[Sequence[int]], str]
) -> None:
    times_ns = [at * STEP_NS + at % 3 * jitter_ns for at in range(24 * 9)]
    steps_ns = [0, *(b - a for a, b in pairwise(times_ns))]
    path = tmp_path / "shown.txt"
    path.write_text(written(steps_ns if is_step else times_ns))
    readings, _ = played([path])
    assert [reading.made_ns for reading in readings] == times_ns[23::24]


def test_times_that_stand_or_fall_between_buses_are_not_steps(tmp_path: Path) -> None:
    """An adapter may count milliseconds; frames of two buses may come out of order."""
    times_ns = [at * STEP_NS // 1_000_000 * 1_000_000 for at in range(24 * 9)]
    coarse, other = shown(times_ns), shown([at * STEP_NS + 90_000 for at in range(24 * 9)])
    path = tmp_path / "shown.txt"
    path.write_text(coarse)
    readings, _ = played([path])
    assert [reading.made_ns for reading in readings] == times_ns[23::24]
    own = shown([at * STEP_NS for at in range(24 * 9)]).splitlines(keepends=True)
    later = other.replace("can0", "can1").splitlines(keepends=True)
    path.write_text("".join(line for pair in zip(later, own, strict=True) for line in pair))
    readings, _ = played([path])
    assert [reading.made_ns for reading in readings] == [at * STEP_NS for at in range(23, 216, 24)]


def test_a_clock_that_was_set_back_is_a_pause(tmp_path: Path) -> None:
    """As of two logs in one file; no sweep has frames of both."""
    path = tmp_path / "bus.log"
    path.write_text("".join([*lines_of(3)[:-5], *lines_of(3, since_ns=5 * 10**9)]))
    readings, _ = played([path])
    assert [reading.faults.any() for reading in readings if reading.faults.any()] in ([], [True])
    times_ns = [reading.made_ns for reading in readings]
    assert times_ns == sorted(times_ns)
    assert len([reading for reading in readings if not reading.faults.any()]) == 5


def test_a_link_log_plays_at_its_own_pace_times_speed(tmp_path: Path) -> None:
    path, clock = tmp_path / "can.log", Clock()
    path.write_text("".join(lines_of(7)))
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
        assert driver.period_ns == 24 * STEP_NS


def test_a_file_of_another_kind_is_not_a_can_log(tmp_path: Path) -> None:
    path = tmp_path / "table.log"
    path.write_text("a,b\n1,2\n")
    with pytest.raises(RecordingError, match="is a text table, not a CAN log"):
        list(read_log(path))
