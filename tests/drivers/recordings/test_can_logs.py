"""CAN logs of all kinds play one bus as it was; what is not understood is counted and shown."""

from __future__ import annotations

import gzip
import logging
import os
from collections.abc import Callable, Iterator, Sequence
from itertools import pairwise
from pathlib import Path

import can
import pytest

from graspd.drivers.base import RecordingError, TactileReading
from graspd.drivers.biotac import sample_command
from graspd.drivers.can.frames import CanFrame
from graspd.drivers.recordings.can_log import CanLog, Survey, bus_name, encode_frames, line_of
from tests.drivers.one_sweep import tactile

SAMPLE_ID = 0x5A1
MF_FF_TH = [[2602], [2713], [2391]]
"""Counts in the words A251 A8C8 94B9 (bytes of 7 bits and odd parity: manual, table 8)."""
SAMPLES = [bytes([sample_command(at)]) + bytes.fromhex("A251 A8C8 94B9") for at in range(17, 41)]
"""Data of the frames of one sweep of the electrodes."""
STEP_NS = 400_000


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
def test_logs_written_by_python_can_give_the_sent_sweeps(
    tmp_path: Path, ending: str, caplog: pytest.LogCaptureFixture
) -> None:
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
    assert log.period_ns == pytest.approx(24 * STEP_NS, abs=1000)
    assert "understood" not in caplog.text
    assert ("has no channel 0; played is can0" in caplog.text) == (ending == "log")
    assert ("has no channel" in caplog.text) == (ending == "log")


@pytest.mark.parametrize("ending", ["asc", "blf", "trc"])
def test_error_remote_and_fd_frames_are_never_read_as_samples(tmp_path: Path, ending: str) -> None:
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
    readings, log = played([path])
    assert 2 <= len(readings) < 20
    last = log.stream.counters.frames + 1
    said = f"1 of {last} lines were not understood; the first is line {last}, 'damaged"
    assert said in caplog.text


def test_a_packed_blf_file_that_is_cut_off_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "bus.blf"
    with can.BLFWriter(path, compression_level=0) as writer:
        for message in messages(100):
            writer(message)
    path.write_bytes(gzip.compress(path.read_bytes())[:-20])
    with pytest.raises(RecordingError, match="the packed file is damaged or cut off"):
        played([path])


def test_logs_closed_before_their_end_leave_no_file_open(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("graspd.drivers.recordings.can_log.FIRST_LINES", 24)
    paths = [tmp_path / "1.log", tmp_path / "2.log"]
    for path in paths:
        path.write_text("".join(lines_of(4)))
    with CanLog(paths, ("ff", "mf", "th"), arbitration_id=SAMPLE_ID) as log:
        assert log.read_ready()
    left = {os.path.realpath(each) for each in Path("/proc/self/fd").iterdir()}
    assert left.isdisjoint(map(str, paths))


def test_the_channel_of_a_scene_chooses_the_bus(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Two boards with one id, played together, would look like one hand."""
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


@pytest.mark.parametrize(
    "channel",
    [
        "/dev/serial/by-id/usb-Protofusion_Labs_CANable_1205aa6_https:__github.com_normaldotcom_"
        "cantact-fw_001C000F4E50430120303838-if00",
        "/dev/gr\u00fcne Hand",
    ],
)
def test_a_log_of_a_live_link_plays_whatever_its_channel(
    tmp_path: Path, channel: str, caplog: pytest.LogCaptureFixture
) -> None:
    frames = [(CanFrame(SAMPLE_ID, data), at * STEP_NS) for at, data in enumerate(SAMPLES * 4)]
    stamped = [(frame, t_ns, t_ns) for frame, t_ns in frames]
    path = tmp_path / "hand.can.log"
    path.write_bytes(encode_frames(stamped, 10**18, bus_name(channel)))
    readings, _ = played([path], channel)
    assert len(readings) == 4
    assert not caplog.text


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
        ("can0  5A1   [3]  0D 3A 1F\n", r"the lines have no times: line 1, 'can0 .*candump -L"),
        ("(1.0) can0  5A1   [1]  10100010\n", r"no line was understood: line 1, .*candump -L"),
        ("(1.0) can0 5A1##00D3A1F\n", "has frames of CAN FD alone"),
    ],
)
def test_a_log_without_classic_can_frames_is_refused(tmp_path: Path, text: str, says: str) -> None:
    path = tmp_path / "bus.log"
    path.write_text(text)
    with pytest.raises(RecordingError, match=says):
        played([path])


@pytest.mark.parametrize("encoding", ["utf-16", "utf-8-sig"])
def test_a_log_in_unicode_encoding_ending_in_zeros_is_read(tmp_path: Path, encoding: str) -> None:
    """PowerShell writes UTF-16; a computer that lost power leaves zeros."""
    path = tmp_path / "bus.txt"
    path.write_text("".join(lines_of(3)) + "\0" * 100, encoding)
    readings, _ = played([path])
    assert len(readings) == 3


def test_ids_beyond_the_limit_are_not_counted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("graspd.drivers.recordings.can_log.IDS_MAX", 3)
    path = tmp_path / "bus.log"
    path.write_text("".join(f"(1.0) can0 {number:03X}#00\n" for number in range(4)) * 2)
    frames = Survey.of(path).frames
    assert frames == {("can0", number): 2 for number in range(3)}


def test_a_board_id_that_no_frame_has_logs_a_warning(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
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
    """The same sweeps as an ASC file, with two lines that are not frames of the bus."""
    frames = [f"1 5A1 Rx d 7 {data.hex(' ').upper()}" for data in SAMPLES * (len(times_ns) // 24)]
    lines = [f"{t_ns / 1e9:.6f} {frame}" for t_ns, frame in zip(times_ns, frames, strict=True)]
    head = ["base hex  timestamps relative", "0.000000 Start of measurement", "0.000000 1 what?"]
    return "\n".join([*head, *lines, ""])


@pytest.mark.parametrize("written", [shown, asc])
@pytest.mark.parametrize("is_step", [True, False])
@pytest.mark.parametrize("same", [1, 3])
def test_times_since_the_last_frame_are_recognised(
    tmp_path: Path, is_step: bool, same: int, written: Callable[[Sequence[int]], str]
) -> None:
    """`same`: number of frames in a row that have the time of their first."""
    times_ns = [(at - at % same) * STEP_NS + at % 3 // same * 90_000 for at in range(24 * 9)]
    steps_ns = [0, *(b - a for a, b in pairwise(times_ns))]
    path = tmp_path / "shown.txt"
    path.write_text(written(steps_ns if is_step else times_ns))
    readings, _ = played([path])
    assert [reading.made_ns for reading in readings] == times_ns[23::24]


@pytest.mark.parametrize(("falls", "is_step"), [(3, False), (4, True)])
def test_times_with_four_falls_in_ten_rises_are_steps(
    tmp_path: Path, falls: int, is_step: bool
) -> None:
    times = [0, *[1, 0] * falls, *range(1, 11 - falls)]
    path = tmp_path / "shown.txt"
    path.write_text("".join(f" (000.00000{t})  can0  5A1   [1]  0D\n" for t in times))
    assert Survey.of(path).has_steps == is_step


def test_a_log_clock_set_back_plays_as_a_pause(tmp_path: Path) -> None:
    """Two logs in one file look like this; no sweep has frames of both."""
    path = tmp_path / "bus.log"
    since_ns = 10**18 + 66 * STEP_NS - 1_100_000_000
    path.write_text("".join([*lines_of(3)[:-5], *lines_of(3, since_ns=since_ns)]))
    readings, _ = played([path])
    assert [reading.faults.any() for reading in readings if reading.faults.any()] in ([], [True])
    times_ns = [reading.made_ns for reading in readings]
    assert times_ns == sorted(times_ns)
    assert len([reading for reading in readings if not reading.faults.any()]) == 5


def test_a_time_beyond_64_bits_is_refused_with_its_line(tmp_path: Path) -> None:
    path = tmp_path / "bus.log"
    path.write_text("".join([*lines_of(1), *lines_of(1, since_ns=91_700_000_000 * 10**9)]))
    with pytest.raises(RecordingError, match=r"bus.log, line 25: the time 91700000000 s is later"):
        played([path])
