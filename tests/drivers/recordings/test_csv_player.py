"""The replay driver: pace, order, time stamps, and what it counts."""

from __future__ import annotations

import logging
from pathlib import Path

import numpy as np
import pytest

from graspd.drivers.base import JointReading, Reading, RecordingError, TactileReading
from graspd.drivers.recordings.csv_player import ReplayDriver
from tests.drivers.one_sweep import tactile
from tests.drivers.recordings.tables import (
    TABLE_HEADER,
    stream,
    table,
    write,
)
from tests.kit.clock import Clock

MS = 1_000_000
START_NS = 10**12


def play(driver: ReplayDriver, clock: Clock | None = None) -> list[Reading]:
    """Open the driver and take all it has, moving the clock to whatever is due."""
    readings: list[Reading] = []
    with driver:
        while not driver.exhausted:
            due_ns = driver.due_ns()
            assert due_ns is not None
            if clock is not None:
                clock.now_ns = max(clock.now_ns, due_ns)
            readings.extend(driver.read_ready())
    return readings


def times_ms(readings: list[Reading], start_ns: int = START_NS) -> list[float]:
    return [(reading.t_ns - start_ns) / MS for reading in tactile(readings)]


@pytest.mark.parametrize(
    ("rate_hz", "speed", "period_ms"), [(50, 1, 20), (100, 4, 2.5), (10, 0.5, 200)]
)
def test_a_table_plays_at_its_rate_times_speed(
    tmp_path: Path, rate_hz: float, speed: float, period_ms: float
) -> None:
    clock = Clock()
    path = write(tmp_path, table(4))
    driver = ReplayDriver([path], rate_hz=rate_hz, speed=speed, clock=clock)
    assert times_ms(play(driver, clock)) == [k * period_ms for k in range(4)]
    assert driver.period_ns == period_ms * MS


def test_a_stream_plays_at_its_own_times_whatever_their_offset(tmp_path: Path) -> None:
    clock = Clock()
    path = write(tmp_path, stream(["100.5", "100.51", "100.51", "100.75"]))
    readings = tactile(play(ReplayDriver([path], speed=2, clock=clock), clock))
    assert times_ms([*readings]) == [0, 5, 5, 125]
    assert [reading.recorded_ns for reading in readings] == [0, 10 * MS, 10 * MS, 250 * MS]


def test_a_streams_period_is_its_shortest_step(tmp_path: Path) -> None:
    clock = Clock()
    path = write(tmp_path, stream(["5", "5.02", "5.03", "35.0"]))
    with ReplayDriver([path], speed=2, clock=clock) as driver:
        periods_ms = [None if driver.period_ns is None else driver.period_ns / MS]
        while not driver.exhausted:
            clock.now_ns = max(clock.now_ns, driver.due_ns() or 0)
            driver.read_ready()
            periods_ms.append((driver.period_ns or 0) / MS)
    assert periods_ms == [None, 0, 10, 5, 5]


def test_rows_overdue_after_a_lag_are_all_played(tmp_path: Path) -> None:
    clock = Clock()
    with ReplayDriver([write(tmp_path, table(6))], clock=clock) as driver:
        driver.read_ready()
        clock.now_ns += 35 * MS
        seqs: list[int] = []
        while readings := driver.read_ready():
            seqs.extend(reading.seq for reading in readings)
        assert seqs == [1, 2, 3]
        assert driver.due_ns() == START_NS + 40 * MS


def test_several_files_play_in_a_row_on_one_time_axis(tmp_path: Path) -> None:
    clock = Clock()
    paths = [
        write(tmp_path, table(2), "a.csv"),
        write(tmp_path, stream(["7", "7.03", "7.04"]), "b.csv"),
        write(tmp_path, stream(["-1"]), "c.csv"),
        write(tmp_path, table(2), "d.csv"),
    ]
    readings = play(ReplayDriver(paths, clock=clock), clock)
    # A stream continues for its shortest step, 10 ms; one of a single row for that of tables.
    assert times_ms(readings) == [0, 10, 20, 50, 60, 70, 80, 90]
    assert [reading.seq for reading in readings] == list(range(8))
    sources = [
        reading.annotation.source.name for reading in tactile(readings) if reading.annotation
    ]
    assert sources == ["a.csv"] * 2 + ["b.csv"] * 3 + ["c.csv"] + ["d.csv"] * 2


def test_a_loop_starts_again_and_time_continues(tmp_path: Path) -> None:
    clock = Clock()
    paths = [
        write(tmp_path, table(2), "a.csv"),
        write(tmp_path, stream(["1", "1.02"]), "b.csv"),
    ]
    readings: list[Reading] = []
    with ReplayDriver(paths, loop=True, clock=clock) as driver:
        while len(readings) < 9:
            clock.now_ns = max(clock.now_ns, driver.due_ns() or 0)
            readings.extend(driver.read_ready())
        assert not driver.exhausted
    assert times_ms(readings) == [0, 10, 20, 40, 60, 70, 80, 100, 120]
    assert [reading.seq for reading in readings] == list(range(9))
    begins = [at for at, reading in enumerate(readings) if reading.interrupted]
    assert begins == [2, 6], "a stream does not follow what was before"


def test_a_stream_with_joints_gives_the_joints_before_the_counts(tmp_path: Path) -> None:
    angles = {"rh_THJ5": ["0.1", "0.2"], "rh_FFJ0": ["1.5", "nan"]}
    path = write(tmp_path, stream(["0", "0.01"], angles))
    clock = Clock()
    with ReplayDriver([path], clock=clock) as driver:
        joints, counts = driver.read_ready()
        assert isinstance(joints, JointReading)
        assert isinstance(counts, TactileReading)
        assert joints.names == ("THJ5", "FFJ0")
        assert joints.position_rad.tolist() == [0.1, 1.5]
        assert joints.t_ns == counts.t_ns == clock.now_ns
        clock.now_ns += 10 * MS
        joints, _ = driver.read_ready()
        assert isinstance(joints, JointReading)
        np.testing.assert_array_equal(joints.position_rad, [0.2, np.nan])
        assert joints.seq == 1
        assert driver.counters.bad_angles == 1
        assert driver.counters.readings == 2


def test_open_checks_the_header_of_every_file(tmp_path: Path) -> None:
    good = write(tmp_path, table(), "good.csv")
    bad = write(tmp_path, table(columns=TABLE_HEADER[:-1]), "bad.csv")
    driver = ReplayDriver([good, good, bad])
    with pytest.raises(RecordingError, match=r"bad.csv, line 1, column th_biotac_24") as caught:
        driver.open()
    assert caught.value.path == bad
    with pytest.raises(RecordingError, match=r"gone.csv: no such file or directory"):
        ReplayDriver([good, tmp_path / "gone.csv"]).open()
    with pytest.raises(RecordingError, match=r"empty.csv: the file has a header and no rows"):
        ReplayDriver([good, write(tmp_path, table(0), "empty.csv")]).open()


def test_unknown_columns_of_all_files_are_logged_once(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    extra = [*TABLE_HEADER, "force", *(f"x{k}" for k in range(20))]
    content = ",".join(extra).encode() + b"\no,0" + b",5" * 93 + b"\n"
    paths = [write(tmp_path, table(), "a.csv"), write(tmp_path, content, "b.csv")] * 2
    with caplog.at_level(logging.INFO), ReplayDriver(paths, speed=None) as driver:
        assert not driver.exhausted
    (record,) = caplog.records
    assert record.levelname == "INFO"
    assert record.getMessage().startswith("replay: unknown columns ignored: 21, such as 'force'")
    assert record.getMessage().endswith("'x8'"), "ten names"


def test_a_column_that_may_be_an_angle_is_warned_of(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    content = stream(["0", "0.01"], {"FFJ3_filtered": ["0.1"] * 2, "FFJ3_effort": ["1"] * 2})
    play(ReplayDriver([write(tmp_path, content)], speed=None))
    (record,) = (record for record in caplog.records if record.levelname == "WARNING")
    assert "'FFJ3_filtered' may be a joint's angle, and is not read" in record.getMessage()


@pytest.mark.parametrize(("name", "unit"), [("t_ms", ["ms"]), ("t", [])])
def test_a_unit_of_times_other_than_seconds_is_logged(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, name: str, unit: list[str]
) -> None:
    content = stream(["0", "0.5", "1", "1.5"]).replace(b"t,", f"{name},".encode(), 1)
    with caplog.at_level(logging.INFO), ReplayDriver([write(tmp_path, content)], speed=None):
        assert [record.getMessage().split()[-1] for record in caplog.records] == unit


def test_a_table_without_a_readable_outcome_logs_one_warning(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    content = table(2, {0: {"slipped": "yes"}, 1: {"slipped": "no"}})
    play(ReplayDriver([write(tmp_path, content)], speed=None))
    (record,) = caplog.records
    assert record.levelname == "WARNING"
    assert "line 2, column slipped: 'yes' is not an outcome" in record.getMessage()


def test_files_that_together_last_too_long_are_refused(tmp_path: Path) -> None:
    path = write(tmp_path, stream(["0", "3500000000"]))
    assert len(play(ReplayDriver([path], read_as="stream", speed=None))) == 2
    with pytest.raises(RecordingError, match=r"line 3: the time 10500000000 s is later"):
        play(ReplayDriver([path] * 2, read_as="stream", speed=None))


def test_a_bad_row_is_raised_after_the_readings_before_it(tmp_path: Path) -> None:
    path = write(tmp_path, table(2) + b"apple,0,1\n" + table(1))
    clock = Clock()
    with ReplayDriver([path], clock=clock) as driver:
        assert len(driver.read_ready()) == 1
        clock.now_ns += 10 * MS
        assert len(driver.read_ready()) == 1
        assert not driver.exhausted
        due_ns = driver.due_ns()
        assert due_ns is not None
        assert due_ns <= clock.now_ns, "an error does not wait"
        with pytest.raises(RecordingError, match="line 4: the row has 3 cells, the header 74"):
            driver.read_ready()
        assert driver.exhausted
        assert driver.read_ready() == ()


def test_bad_values_are_counted_and_strict_refuses_them(tmp_path: Path) -> None:
    changes = {1: {"ff_biotac_1": "nan", "th_biotac_9": "4096"}, 2: {"mf_biotac_3": "2.5"}}
    path = write(tmp_path, table(4, changes).rstrip(b"\n"))
    driver = ReplayDriver([path], speed=None)
    faulty = [bool(reading.faults.any()) for reading in tactile(play(driver))]
    assert faulty == [False, True, True, True]
    counters = driver.counters
    assert (counters.readings, counters.faulty_readings) == (4, 3)
    assert (counters.not_counts, counters.cut_off) == (3, 1)
    with pytest.raises(RecordingError, match=r"line 3, column ff_biotac_1: 'nan' is not a count"):
        play(ReplayDriver([path], speed=None, strict=True))
