"""Per-finger frames become readings: nothing is mixed, what is missing is flagged."""

from __future__ import annotations

import pytest

from drivers.base import ElectrodeFault, TactileReading
from drivers.can_decoders import CanCounters
from drivers.frame_sweep import LATE_FRAMES_MAX, SEQUENCE_JUMP_MAX, FrameSweeps
from drivers.sweep import OUTAGE_NS, PERIODS_NEEDED
from tests.drivers.can_words import FINGERS, assert_true, truth, word

MISSING = ElectrodeFault.MISSING


def push(sweeps: FrameSweeps, row: int, sweep: int, t_ns: int = 0) -> list[TactileReading]:
    words = b"".join(word(int(count)) for count in truth(sweep)[row])
    return list(sweeps.push(row, sweep % (1 << 16), words, 0, t_ns))


def frame_sweeps() -> tuple[FrameSweeps, CanCounters]:
    counters = CanCounters()
    return FrameSweeps(FINGERS, counters), counters


def whole(sweeps: FrameSweeps, sweep: int, t_ns: int = 0) -> list[TactileReading]:
    return [reading for row in range(FINGERS) for reading in push(sweeps, row, sweep, t_ns)]


def test_frames_of_all_fingers_make_a_reading_in_any_order() -> None:
    sweeps, _ = frame_sweeps()
    assert push(sweeps, 2, 0, 5) == push(sweeps, 0, 0, 9) == []
    (reading,) = push(sweeps, 1, 0, 7)
    assert_true(reading, 0)
    assert not reading.faults.any()
    assert reading.t_ns == 9


def test_a_lost_frame_flags_its_finger_when_the_next_sweep_begins() -> None:
    sweeps, counters = frame_sweeps()
    whole(sweeps, 0)
    assert push(sweeps, 0, 1, 20) == push(sweeps, 2, 1, 21) == []
    (reading,) = push(sweeps, 0, 2, 30)
    assert (reading.faults[1] == MISSING).all()
    assert not reading.faults[[0, 2]].any()
    assert_true(reading, 1)
    assert (reading.t_ns, counters.lost_frames) == (21, 1)


def test_a_first_sweep_that_was_joined_in_the_middle_is_no_reading() -> None:
    sweeps, counters = frame_sweeps()
    assert push(sweeps, 2, 7) == []
    (reading,) = whole(sweeps, 8)
    assert_true(reading, 8)
    assert counters.unsynchronised_frames == 1


def test_gaps_in_the_sequence_are_missed_readings_across_its_wrap() -> None:
    sweeps, counters = frame_sweeps()
    (first,) = whole(sweeps, (1 << 16) - 2)
    (second,) = whole(sweeps, (1 << 16) + 3)
    assert second.seq == first.seq + 5
    assert counters.missed_readings == 4
    assert counters.restarts == 0


def test_duplicated_and_late_frames_change_nothing() -> None:
    sweeps, counters = frame_sweeps()
    whole(sweeps, 10)
    assert push(sweeps, 1, 10) == push(sweeps, 1, 9) == push(sweeps, 1, 10 - LATE_FRAMES_MAX) == []
    (reading,) = whole(sweeps, 11)
    assert not reading.faults.any()
    assert (counters.duplicate_frames, counters.late_frames) == (1, 2)


@pytest.mark.parametrize(
    ("sequence", "t_ns"),
    [(5000 - LATE_FRAMES_MAX - 1, 0), (5000 + SEQUENCE_JUMP_MAX + 1, 0), (0, 0)],
)
def test_a_sequence_that_starts_anew_is_followed(sequence: int, t_ns: int) -> None:
    sweeps, counters = frame_sweeps()
    (before,) = whole(sweeps, 5000)
    (after,) = whole(sweeps, sequence, t_ns)
    assert_true(after, sequence)
    assert counters.restarts == 1
    assert after.seq == before.seq + 2


def test_a_device_that_says_the_same_sweep_again_after_an_outage_has_started_anew() -> None:
    sweeps, counters = frame_sweeps()
    whole(sweeps, 0)
    (reading,) = whole(sweeps, 0, OUTAGE_NS + 1)
    assert reading.t_ns == OUTAGE_NS + 1
    assert counters.restarts == 1


def test_finger_faults_hold_for_all_its_electrodes() -> None:
    sweeps, counters = frame_sweeps()
    words = word(2602) * 24
    sweeps.push(0, 0, words, ElectrodeFault.MISSING, 0)
    sweeps.push(1, 0, words, ElectrodeFault.HELD, 0)
    (reading,) = sweeps.push(2, 0, words, 0, 0)
    assert (reading.faults[0] == ElectrodeFault.MISSING).all()
    assert not reading.counts[0].any()
    assert (reading.faults[1] == ElectrodeFault.HELD).all()
    assert not reading.faults[2].any()
    assert (counters.faulty_readings, counters.unplugged_words) == (1, 24)


def test_an_interrupted_frame_sweep_is_missed() -> None:
    sweeps, counters = frame_sweeps()
    (before,) = whole(sweeps, 0)
    push(sweeps, 0, 1)
    sweeps.interrupt()
    assert push(sweeps, 2, 1) == push(sweeps, 1, 1) == []
    (after,) = whole(sweeps, 2)
    assert after.seq == before.seq + 2
    assert (counters.interrupted_sweeps, counters.missed_readings) == (1, 1)


def test_the_frame_period_is_learned() -> None:
    sweeps, _ = frame_sweeps()
    for sweep in range(PERIODS_NEEDED + 1):
        whole(sweeps, sweep, sweep * 10_000_000)
    assert sweeps.period_ns == 10_000_000
