"""The recorder writes all entries within limits; a slow or full disk never delays the loop."""

from __future__ import annotations

import errno
import json
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest

from graspd.daemon import scene
from graspd.daemon.record import mcap
from graspd.daemon.record import recorder as recorder_module
from graspd.daemon.record.mcap import McapWriter, make_room
from graspd.daemon.record.mcap_reader import McapReader
from graspd.daemon.record.recorder import QUEUE_MAX, Recorder, ReplayRecorder
from graspd.daemon.scene.scene import Record
from graspd.drivers.recordings.kinds import open_recording
from tests.daemon.record.recorded import BOOT, HEADER, NO_STATUS, files, messages, recorder
from tests.kit.disk import Disk
from tests.kit.waiting import wait_until

TOPIC = b"verdict.right"


Make = Callable[..., Recorder]


@pytest.fixture
def make(tmp_path: Path) -> Iterator[Make]:
    made: list[Recorder] = []

    def new(**options: Any) -> Recorder:  # noqa: ANN401
        made.append(recorder(tmp_path, **options))
        return made[-1]

    yield new
    for each in made:
        each.close()


def payload(number: int, size: int = 0) -> bytes:
    # Digits that do not repeat: files would not grow by what compresses well.
    noise = np.random.default_rng(number).bytes(size // 2).hex()
    return json.dumps({"number": number, "noise": noise}).encode()


def numbers(folder: Path) -> list[int]:
    return [content["number"] for path in files(folder) for _, content in messages(path)]


def test_a_file_has_the_daemons_header_and_clock(tmp_path: Path, make: Make) -> None:
    # The header compares the two clocks between these times.
    wall_made_ns, made_ns = time.time_ns(), time.monotonic_ns()
    writing = make()
    before_ns = time.monotonic_ns()
    writing.send(TOPIC, payload(0))
    after_ns = time.monotonic_ns()
    writing.close()
    closed_ns, wall_closed_ns = time.monotonic_ns(), time.time_ns()
    (path,) = (tmp_path / "record").iterdir()
    with open_recording(path) as stream:
        recording = McapReader(path, stream)
        (message,) = recording
    assert recording.header.fingers == ("ff", "th")
    assert recording.header.boot_id == BOOT
    assert before_ns <= message.at_ns <= after_ns
    ahead_ns = recording.header.wall_minus_monotonic_ns
    assert wall_made_ns - closed_ns <= ahead_ns <= wall_closed_ns - made_ns
    assert path.stat().st_mode & 0o777 == 0o640


def test_new_files_begin_by_size_without_losing_entries(
    tmp_path: Path, make: Make, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(mcap, "ROTATE_BYTES", 100_000)
    writing = make()
    for number in range(300):
        writing.send(TOPIC, payload(number, 4000))
        if number % 30 == 29:
            wait_until(lambda n=number: writing.counters["record"]["recorded"] > n)  # type: ignore[misc]
            writing.on_status(NO_STATUS)
    writing.close()
    paths = sorted((tmp_path / "record").iterdir())
    assert 4 <= len(paths) <= 12  # 300 of 2 kB each, compressed from hex
    assert numbers(tmp_path) == list(range(300))


STAMP = f"20260101T000000Z-{BOOT[:8]}-0002"
"""Stamp of the file for which old ones make room."""


def old(folder: Path, hour: int, size: int, ending: str = "mcap") -> Path:
    path = folder / f"right-20200101T{hour:02}0000Z-00000000-0000.{ending}"
    path.parent.mkdir(exist_ok=True)
    path.write_bytes(bytes(size))
    return path


def test_the_oldest_files_make_room_and_nothing_else_is_removed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(mcap, "FILES_MAX", 4)
    folder = tmp_path / "record"
    paths = [old(folder, hour, 10) for hour in range(5)]
    beside = old(folder, 0, 10, "can.log")
    strangers = [folder / "right-notes.mcap", folder / "left-20200101T000000Z-00000000-0000.mcap"]
    for path in strangers:
        path.write_bytes(b"")
    assert make_room(Record(directory=folder), "right", STAMP) == 2
    assert not paths[0].exists()
    assert not beside.exists()
    assert not paths[1].exists()
    assert all(path.exists() for path in [*paths[2:], *strangers])


def test_old_files_are_deleted_until_all_fit_in_keep_mb(tmp_path: Path) -> None:
    for hour in range(5):
        old(tmp_path, hour, 10**6)
    for keep_mb, removed in ((4.5, 2), (1.0, 3), (1.0, 0)):
        options = Record(directory=tmp_path, keep_mb=keep_mb)
        assert make_room(options, "right", STAMP) == removed


def test_after_the_clock_is_set_back_older_files_go_first(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = [
        "20400101T000000Z-11111111-0000",
        "20400101T010000Z-11111111-0001",  # then the clock is set back
        "20250101T000000Z-22222222-0000",
        "20260101T000000Z-01234567-0000",
        "20250101T120000Z-01234567-0001",  # set back in the run of `STAMP`
    ]
    for stamp in made:
        (tmp_path / f"right-{stamp}.mcap").touch()
    for left in range(len(made), 0, -1):
        monkeypatch.setattr(mcap, "FILES_MAX", left)
        assert make_room(Record(directory=tmp_path), "right", STAMP) == 1
        there = {path.stem.removeprefix("right-") for path in tmp_path.iterdir()}
        assert there == set(made[len(made) - left + 1 :])


@pytest.fixture
def disk(monkeypatch: pytest.MonkeyPatch) -> Disk:
    """A disk that hangs until `goes_on` is set."""
    made = Disk(monkeypatch, "fdatasync")
    made.goes_on.clear()
    return made


def test_entries_are_dropped_and_counted_while_a_disk_stalls(
    tmp_path: Path, make: Make, disk: Disk, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(recorder_module, "CLOSE_S", 100.0)
    writing = make()
    assert disk.asked.wait(100)
    for number in range(QUEUE_MAX + 500):
        writing.send(TOPIC, payload(number))
    assert writing.counters["record"]["dropped"] == 500
    disk.goes_on.set()
    wait_until(lambda: writing.counters["record"]["recorded"] == QUEUE_MAX)
    writing.send(TOPIC, payload(QUEUE_MAX + 500))
    writing.close()
    (path,) = (tmp_path / "record").iterdir()
    with open_recording(path) as stream:
        *before, loss, last = McapReader(path, stream)
    assert len(before) == QUEUE_MAX
    assert (loss.kind, last.kind) == ("dropped", before[-1].kind)


def test_closing_warns_and_gives_up_on_a_hanging_disk(
    make: Make,
    disk: Disk,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    monkeypatch.setattr(recorder_module, "CLOSE_S", 0.05)
    writing = make()
    assert disk.asked.wait(100)
    writing.close()
    assert "does not answer" in caplog.text
    disk.goes_on.set()


def test_a_replay_recorder_waits_for_a_slow_disk(
    tmp_path: Path, disk: Disk, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(recorder_module, "CLOSE_S", 0.0)
    monkeypatch.setattr(recorder_module, "QUEUE_MAX", 20)
    options, silence = Record(directory=tmp_path / "record"), Mock(reading=None)
    silence.judgement.moment.judged = False
    writing = ReplayRecorder(
        options, "right", BOOT, take_header=lambda: lambda: HEADER, patience_s=100.0
    )
    assert disk.asked.wait(100)
    threading.Timer(0.2, disk.goes_on.set).start()
    for number in range(100):
        writing.send(TOPIC, payload(number))
        writing.on_verdict(silence)
    writing.close()
    assert numbers(tmp_path) == list(range(100))
    assert writing.counters["record"]["dropped"] == 0


def test_all_unflushed_entries_count_as_lost_on_a_full_disk(
    make: Make, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Ten entries wait for a flush; of the twenty that follow the disk refuses the fifth.

    The test calls `go_round`: at this interval the thread's first round comes after 6 s.
    """
    monkeypatch.setattr(recorder_module, "FLUSH_NS", 60_000_000_000)
    writing = make()
    real, written = McapWriter.write, list[int]()

    def write(file: McapWriter, topic: bytes, payload: bytes, at_ns: int) -> None:
        if len(written) == 14:
            raise OSError(errno.ENOSPC, "No space left on device")
        written.append(at_ns)
        real(file, topic, payload, at_ns)

    monkeypatch.setattr(McapWriter, "write", write)
    for number in range(10):
        writing.send(TOPIC, payload(number))
    writing.go_round()
    for number in range(20):
        writing.send(TOPIC, payload(number))
    writing.go_round()
    writing.send(TOPIC, payload(0))
    writing.close()
    counted = writing.counters["record"]
    assert (counted["recorded"], counted["lost"], counted["failures"]) == (0, 31, 1)


def test_the_record_folder_is_beside_the_scene_or_the_default(tmp_path: Path) -> None:
    tactile = {"driver": "palm", "source": "udp://127.0.0.1:1"}
    for record, folder in (
        ({"directory": "kept"}, tmp_path / "kept"),
        ({}, Path("/var/lib/graspd/record")),
    ):
        loaded = scene.parse({"tactile": tactile, "record": record}, tmp_path / "scene.toml")
        assert loaded.record is not None
        assert loaded.record.folder == folder
