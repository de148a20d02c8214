"""Faults on demand: each does what it says, and the counters equal what was injected."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from graspd.drivers.base import ElectrodeFault, TactileReading
from graspd.drivers.recordings.csv_player import DEMO_TABLE, ReplayDriver
from graspd.drivers.recordings.faults import FaultInjector, ReplayCounters, ReplayFaults
from tests.drivers.recordings.tables import stream, table, write

MS = 1_000_000
ROWS = 200


def run(faults: ReplayFaults, path: Path = DEMO_TABLE) -> tuple[ReplayDriver, list[TactileReading]]:
    driver = ReplayDriver([path], speed=None, faults=faults)
    readings: list[TactileReading] = []
    with driver:
        while not driver.exhausted:
            readings += [r for r in driver.read_ready() if isinstance(r, TactileReading)]
    return driver, readings


@pytest.fixture(scope="module")
def clean() -> list[TactileReading]:
    return run(ReplayFaults())[1]


def test_without_faults_nothing_is_injected() -> None:
    driver, readings = run(ReplayFaults())
    assert len(readings) == ROWS
    injected = [n for name, n in driver.counters.as_dict().items() if name.startswith("injected")]
    assert len(injected) == 7
    assert not any(injected)


def test_off_is_silent_from_that_reading_on() -> None:
    driver, readings = run(ReplayFaults(off_from=150))
    assert [reading.seq for reading in readings] == list(range(150))
    assert driver.counters.injected_off == 50
    assert driver.counters.missed_readings == 0


def test_stuck_repeats_the_reading_before(clean: list[TactileReading]) -> None:
    driver, readings = run(ReplayFaults(stuck_from=20))
    for index, reading in enumerate(readings):
        expected = clean[min(index, 19)].counts
        np.testing.assert_array_equal(reading.counts, expected)
        assert not reading.faults.any()
    assert driver.counters.injected_stuck == ROWS - 20
    assert readings[30].annotation != readings[19].annotation


def test_stuck_repeats_faults_as_well(tmp_path: Path) -> None:
    path = write(tmp_path, table(4, {1: {"ff_biotac_2": "nan"}}))
    _, readings = run(ReplayFaults(stuck_from=2), path)
    flags = [int(reading.faults[0, 1]) for reading in readings]
    assert flags == [0, *[ElectrodeFault.NOT_A_COUNT] * 3]


@pytest.mark.parametrize("offset", [300, -4095])
def test_wrong_shifts_and_clips(clean: list[TactileReading], offset: int) -> None:
    driver, readings = run(ReplayFaults(wrong_counts=offset))
    for reading, before in zip(readings, clean, strict=True):
        shifted = np.clip(before.counts.astype(int) + offset, 0, 4095)
        np.testing.assert_array_equal(reading.counts, shifted)
    assert driver.counters.injected_wrong == ROWS
    assert driver.counters.faulty_readings == 0


def test_wrong_leaves_what_is_no_count_alone(tmp_path: Path) -> None:
    path = write(tmp_path, table(1, {0: {"ff_biotac_2": "nan"}}))
    _, (reading,) = run(ReplayFaults(wrong_counts=100), path)
    assert reading.counts[0, 1] == 0
    assert reading.faults[0, 1] == ElectrodeFault.NOT_A_COUNT


def test_garbage_is_16_bit_and_what_has_more_than_12_is_no_count(
    clean: list[TactileReading],
) -> None:
    driver, readings = run(ReplayFaults(garbage_probability=0.4, seed=3))
    changed = [
        (reading.counts != before.counts).any()
        for reading, before in zip(readings, clean, strict=True)
    ]
    assert sum(changed) == driver.counters.injected_garbage
    # Binomial, 200 x 0.4: within 5 standard deviations of 7.
    assert 45 <= sum(changed) <= 115
    flagged = np.array([r.faults for r, bad in zip(readings, changed, strict=True) if bad]) > 0
    # 4096 of 65536 words are counts: 93.75 % of thousands of electrodes are not.
    assert 0.92 < flagged.mean() < 0.955
    assert driver.counters.not_counts == flagged.sum()
    assert driver.counters.faulty_readings == driver.counters.injected_garbage
    assert all(not reading.counts[reading.faults > 0].any() for reading in readings)


def test_value_faults_keep_to_the_chosen_electrodes(clean: list[TactileReading]) -> None:
    faults = ReplayFaults(
        stuck_from=1,
        wrong_counts=50,
        garbage_probability=0.5,
        fingers=("mf",),
        electrodes=(1, 24),
    )
    _, readings = run(faults)
    changed = np.zeros((3, 24), dtype=bool)
    for reading, before in zip(readings, clean, strict=True):
        changed |= reading.counts != before.counts
    assert np.argwhere(changed).tolist() == [[1, 0], [1, 23]]


@pytest.mark.parametrize("every", [2, 7])
def test_slow_makes_every_nth_reading_and_leaves_no_gap(every: int) -> None:
    driver, readings = run(ReplayFaults(slow_every=every))
    lines = [reading.annotation.line - 2 for reading in readings if reading.annotation]
    assert lines == list(range(0, ROWS, every))
    assert [reading.seq for reading in readings] == list(range(len(lines)))
    assert driver.counters.injected_slow == ROWS - len(lines)


def test_intermittent_leaves_a_gap_in_seq() -> None:
    driver, readings = run(ReplayFaults(intermittent_probability=0.3, seed=11))
    lost = ROWS - len(readings)
    assert 25 <= lost <= 95
    assert driver.counters.injected_intermittent == driver.counters.missed_readings == lost
    for reading in readings:
        assert reading.annotation is not None
        assert reading.seq == reading.annotation.line - 2


def test_delayed_comes_late_and_says_when_it_should_have_come(tmp_path: Path) -> None:
    now_ns = 5_000 * MS
    path = write(tmp_path, table(3))
    driver = ReplayDriver([path], faults=ReplayFaults(delayed_s=0.25), clock=lambda: now_ns)
    with driver:
        assert driver.read_ready() == ()
        for index in range(3):
            due_ns = driver.due_ns()
            assert due_ns == (5_250 + 10 * index) * MS
            now_ns = due_ns
            (reading,) = driver.read_ready()
            assert reading.t_ns == (5_000 + 10 * index) * MS
        assert driver.counters.injected_delayed == 3
        assert driver.counters.late == 0


def test_delayed_does_not_wait_when_there_is_no_schedule(tmp_path: Path) -> None:
    driver = ReplayDriver(
        [write(tmp_path, table(1))],
        speed=None,
        faults=ReplayFaults(delayed_s=0.25),
        clock=lambda: 5_000 * MS,
    )
    with driver:
        (reading,) = driver.read_ready()
    assert reading.t_ns == 4_750 * MS


def test_joints_still_come_while_the_sensor_is_off(tmp_path: Path) -> None:
    path = write(tmp_path, stream(["0", "1", "2"], {"FFJ3": ["0", "0.1", "0.2"]}))
    with ReplayDriver([path], speed=None, faults=ReplayFaults(off_from=1)) as driver:
        assert [len(driver.read_ready()) for _ in range(3)] == [2, 1, 1]


@settings(max_examples=25)
@given(
    off_from=st.none() | st.integers(0, ROWS + 10),
    stuck_from=st.none() | st.integers(1, ROWS + 10),
    garbage_probability=st.floats(0, 1),
    wrong_counts=st.integers(-4095, 4095),
    slow_every=st.integers(1, 20),
    intermittent_probability=st.floats(0, 1),
    seed=st.integers(0, 2**32),
)
def test_under_any_mix_every_row_is_accounted_for(**fields: Any) -> None:  # noqa: ANN401
    driver, readings = run(ReplayFaults(**fields))
    counters = driver.counters
    kept_back = counters.injected_off + counters.injected_slow + counters.injected_intermittent
    assert counters.readings == len(readings) == ROWS - kept_back
    assert counters.injected_wrong == (len(readings) if fields["wrong_counts"] else 0)
    made = counters.readings + counters.missed_readings
    assert all(reading.seq < made for reading in readings)
    seqs = [reading.seq for reading in readings]
    assert seqs == sorted(set(seqs))
    assert all(reading.counts.max() <= 4095 for reading in readings)
    flagged = sum(int((reading.faults > 0).sum()) for reading in readings)
    assert counters.not_counts == flagged


def test_the_largest_word_that_is_a_count_is_4095() -> None:
    """Of 16-bit words, 240,000 times: it does not come with a chance of 2 in 100."""
    faults, fingers = ReplayFaults(garbage_probability=1.0), ("ff", "mf", "rf", "lf", "th")
    injector = FaultInjector(faults, fingers, ReplayCounters())
    counts, flags = np.zeros((5, 24), np.uint16), np.zeros((5, 24), np.uint8)
    largest = 0
    for _ in range(2000):
        injector.inject(counts, flags)
        largest = max(largest, int(counts.max()))
    assert largest == 4095
