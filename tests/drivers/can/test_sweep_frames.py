"""Per-finger frames become readings: nothing is mixed, what is missing is flagged."""

from __future__ import annotations

import pytest

from graspd.drivers.base import ElectrodeFault, TactileReading
from graspd.drivers.can.readings import CanCounters
from graspd.drivers.can.sweep_frames import FrameAssembler
from tests.drivers.can.can_words import FINGERS, assert_true, truth, word

OUTAGE_NS = 2_000_000_000
PERIODS_NEEDED = 5
LATE_FRAMES_MAX = 8
SEQUENCE_JUMP_MAX = 1000
"""Ten seconds of sweeps; more is a new start."""

MISSING = ElectrodeFault.MISSING


TICK_US = 10_000


def push(
    sweeps: FrameAssembler, row: int, sweep: int, t_ns: int = 0, tick_us: int | None = None
) -> list[TactileReading]:
    words = b"".join(word(int(count)) for count in truth(sweep)[row])
    tick_us = sweep * TICK_US if tick_us is None else tick_us
    return list(sweeps.push(row, sweep % (1 << 16), tick_us % (1 << 32), words, 0, t_ns))


def frame_sweeps() -> tuple[FrameAssembler, CanCounters]:
    counters = CanCounters()
    return FrameAssembler(range(FINGERS), counters), counters


def whole(
    sweeps: FrameAssembler, sweep: int, t_ns: int = 0, tick_us: int | None = None
) -> list[TactileReading]:
    pushed = [push(sweeps, row, sweep, t_ns, tick_us) for row in range(FINGERS)]
    return [reading for readings in pushed for reading in readings]


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


@pytest.mark.parametrize(("jump", "missed"), [(1, 0), (2, 1), (1000, 999)])
def test_up_to_a_thousand_sweeps_may_be_missing(jump: int, missed: int) -> None:
    sweeps, counters = frame_sweeps()
    whole(sweeps, 5)
    whole(sweeps, 5 + jump)
    assert (counters.missed_readings, counters.restarts) == (missed, 0)


@pytest.mark.parametrize(
    ("late_ns", "of_the_sweep"), [(2 * 10_000_000, True), (2 * 10_000_000 + 1, False)]
)
def test_a_frame_may_come_two_periods_after_the_first_of_its_sweep(
    late_ns: int, of_the_sweep: bool
) -> None:
    sweeps, counters = frame_sweeps()
    due_ns = running(sweeps, 9)
    push(sweeps, 0, 9, due_ns)
    push(sweeps, 1, 9, due_ns)
    (reading,) = push(sweeps, 2, 9, due_ns + late_ns)
    assert (not reading.faults.any()) == of_the_sweep
    assert counters.restarts == (not of_the_sweep)


@pytest.mark.parametrize(("late_ns", "restarts"), [(100_000_000, 0), (100_000_001, 1)])
def test_a_tenth_of_a_second_while_the_period_is_not_known(late_ns: int, restarts: int) -> None:
    sweeps, counters = frame_sweeps()
    whole(sweeps, 1)
    push(sweeps, 0, 2, 10)
    push(sweeps, 1, 2, 10 + late_ns)
    assert counters.restarts == counters.missed_readings == restarts


@pytest.mark.parametrize(("ahead_us", "restarts"), [((1 << 31) - 1, 0), (1 << 31, 1)])
def test_a_tick_that_is_half_of_all_ahead_went_back(ahead_us: int, restarts: int) -> None:
    sweeps, counters = frame_sweeps()
    whole(sweeps, 5, tick_us=7)
    whole(sweeps, 6, tick_us=7 + ahead_us)
    assert counters.restarts == counters.missed_readings == restarts
    late_us = 7 + ahead_us - ((1 << 31) - 1)
    push(sweeps, 0, 5, 0, tick_us=late_us)
    assert counters.late_frames == 1
    push(sweeps, 0, 4, 0, tick_us=late_us - 1)
    assert counters.late_frames == 1


def test_a_late_frame_is_one_of_the_two_periods_before() -> None:
    for late_ns, late in ((2 * PERIOD_NS, 1), (2 * PERIOD_NS + 1, 0)):
        sweeps, counters = frame_sweeps()
        due_ns = running(sweeps, 9)
        push(sweeps, 0, 7, due_ns - PERIOD_NS + late_ns)
        assert (counters.late_frames, counters.restarts) == (late, 1 - late)


def test_a_late_frame_is_told_from_a_new_start_across_the_wrap() -> None:
    sweeps, counters = frame_sweeps()
    whole(sweeps, (1 << 16) + 3)
    assert push(sweeps, 0, (1 << 16) - 2) == []
    assert (counters.late_frames, counters.restarts) == (1, 0)
    sweeps, counters = frame_sweeps()
    whole(sweeps, 5000)
    (reading,) = whole(sweeps, 5000 + (1 << 15) - 8, tick_us=17)  # half of all numbers away
    assert_true(reading, 5000 + (1 << 15) - 8)
    assert (counters.late_frames, counters.restarts) == (0, 1)


def test_a_sweep_that_was_joined_in_the_middle_after_an_interruption_is_missed() -> None:
    sweeps, counters = frame_sweeps()
    whole(sweeps, 0)
    sweeps.interrupt()
    assert push(sweeps, 1, 5) == []
    (reading,) = whole(sweeps, 6)
    assert (reading.seq, counters.missed_readings, counters.unsynchronised_frames) == (6, 5, 1)


def test_frames_of_a_sweep_that_come_in_another_order_are_counted() -> None:
    sweeps, counters = frame_sweeps()
    for row in (1, 0, 2):
        push(sweeps, row, 0)
    whole(sweeps, 1)
    assert counters.reordered_frames == 1
    counters = CanCounters()
    sweeps = FrameAssembler((2, 0, 1), counters)  # row 1 comes first
    for row in (1, 2, 0):
        push(sweeps, row, 0)
    assert counters.reordered_frames == 0


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
    (reading,) = whole(sweeps, 0, OUTAGE_NS + 1, tick_us=77)
    assert reading.t_ns == OUTAGE_NS + 1
    assert counters.restarts == 1


def test_a_copy_is_a_copy_however_late_it_comes() -> None:
    sweeps, counters = frame_sweeps()
    whole(sweeps, 0)
    assert whole(sweeps, 0, OUTAGE_NS + 1) == []
    assert (counters.duplicate_frames, counters.restarts) == (FINGERS, 0)


PERIOD_NS = 10_000_000


def running(sweeps: FrameAssembler, sweep: int) -> int:
    """Sweeps up to before `sweep`, on time; when that is due, ns."""
    for before in range(sweep - 8, sweep):
        whole(sweeps, before, before * PERIOD_NS)
    return sweep * PERIOD_NS


def test_a_frame_with_the_number_at_hand_and_another_tick_is_dropped() -> None:
    sweeps, counters = frame_sweeps()
    whole(sweeps, 2)
    push(sweeps, 0, 3)
    assert push(sweeps, 1, 3, tick_us=31_000) == push(sweeps, 1, 3, tick_us=29_000) == []
    assert push(sweeps, 2, 3) == []
    (reading,) = push(sweeps, 0, 4)
    assert (reading.faults[1] == MISSING).all()
    assert counters.contradicting_frames == 2


def test_a_tick_that_runs_backwards_is_a_new_start_and_its_wrap_is_none() -> None:
    sweeps, counters = frame_sweeps()
    whole(sweeps, 10, tick_us=(1 << 32) - 5)
    whole(sweeps, 11, tick_us=(1 << 32) + 9_995)
    assert counters.restarts == 0
    (reading,) = whole(sweeps, 14, tick_us=17)
    assert not reading.faults.any()
    assert (counters.restarts, counters.missed_readings) == (1, 1)


def test_an_interrupted_frame_sweep_is_missed() -> None:
    sweeps, counters = frame_sweeps()
    (before,) = whole(sweeps, 0)
    push(sweeps, 0, 1)
    sweeps.interrupt()
    assert push(sweeps, 2, 1) == push(sweeps, 1, 1) == []
    (after,) = whole(sweeps, 2)
    assert after.seq == before.seq + 2
    assert (counters.interrupted_sweeps, counters.missed_readings) == (1, 1)


@pytest.mark.parametrize(("gap_ns", "learned"), [(OUTAGE_NS, True), (OUTAGE_NS + 1, False)])
def test_no_period_is_learned_from_an_outage(gap_ns: int, learned: bool) -> None:
    sweeps, _ = frame_sweeps()
    for sweep in range(PERIODS_NEEDED + 1):
        whole(sweeps, sweep, 1 + sweep * gap_ns)
    assert sweeps.period_ns == (gap_ns if learned else None)


def test_no_period_is_learned_from_sweeps_that_were_lost_or_of_two_starts() -> None:
    """Else frames of two starts would be waited for as long as the board takes to begin anew."""
    sweeps, _ = frame_sweeps()
    at_ns = 0
    for _start in range(3):
        for sweep in (0, 1, 3, 5, 7):
            at_ns += 10_000_000 if sweep == 1 else 110_000_000
            whole(sweeps, sweep, at_ns)
    assert sweeps.period_ns is None  # only three times did one follow the other
    for sweep in range(8, 11):
        at_ns += 10_000_000
        whole(sweeps, sweep, at_ns)
    assert sweeps.period_ns == 10_000_000
