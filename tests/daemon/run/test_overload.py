"""Readings that come faster than they are judged: the newest is judged, the others counted."""

from __future__ import annotations

import itertools
import logging
import selectors
import time
from collections.abc import Callable

import msgspec
import numpy as np
import pytest

from graspd.daemon.judge.decision import HandLimits
from graspd.daemon.judge.reasons import Decision, Reason
from graspd.daemon.publish.companion import LoopEvent
from graspd.daemon.run.loop import DRAINS_MAX, LoopTiming
from graspd.daemon.run.overload import YIELD_MAX_NS, mark_repeats
from graspd.daemon.trust.lift_book import GraspId
from graspd.drivers.base import ElectrodeFault, JointReading, Reading, TactileReading
from tests.daemon.fakes import MS, Clock, FakeDriver, reading, sound
from tests.daemon.judge.felt_hand import POSES
from tests.kit.loops import LoopBench, TimedDriver

START_NS = Clock().now_ns
PERIOD_NS = 10 * MS
SECOND_NS = 1_000_000_000


class OverloadedLoop(LoopBench):
    """A loop in which each verdict takes `cost_ns()`; it has run to its end."""

    def __init__(
        self,
        driver: FakeDriver,
        clock: Clock,
        cost_ns: Callable[[], int],
        *,
        hand: HandLimits | None = None,
    ) -> None:
        super().__init__(driver, clock, cost_ns=cost_ns, hand=hand, max_age_ms=1000)
        self.angles: list[int] = []
        self.gaps = 0
        self.run()

    def on_reading(self, reading: Reading) -> None:
        if isinstance(reading, JointReading):
            self.angles.append(reading.seq)

    def on_event(self, event: LoopEvent, grasp: GraspId | None = None) -> None:
        self.gaps += event is LoopEvent.SKIPPED


def stream(seconds: float, period_ns: int = PERIOD_NS) -> list[Reading]:
    number = round(seconds * SECOND_NS / period_ns)
    return [reading(START_NS + seq * period_ns, seq, seq) for seq in range(number)]


def flood(cost_ns: int, seconds: float = 3.0, at_once: int = 1000) -> OverloadedLoop:
    clock = Clock()
    driver = TimedDriver(stream(seconds), clock, at_once=at_once)
    return OverloadedLoop(driver, clock, lambda: cost_ns)


@pytest.mark.parametrize("times", [1.5, 10.0])
def test_in_overload_the_newest_are_judged_and_all_are_counted(times: float) -> None:
    cost_ns = round(times * PERIOD_NS)
    bench = flood(cost_ns, 4.0)
    status = bench.statuses[-1]
    assert len(bench.judged) + status.skipped_readings == 400
    for each in bench.statuses:  # counts of one moment
        taken = sum(each.verdicts.values()) + each.skipped_readings
        assert taken == each.drivers["fake"]["readings"]
    assert bench.driver.counters.readings == 400
    assert status.skipped_readings == pytest.approx(400 * (1 - 1 / times), rel=0.25)
    # From the second round on, which knows what judging takes, none has waited for another.
    waited_ms = [v.age_ms - v.latency_us / 1e3 for v, _ in bench.judged[1:-1]]
    assert max(waited_ms) < PERIOD_NS / MS
    assert max(v.latency_us for v, _ in bench.judged) == 0.0
    seqs = [seen.seq for _, seen in bench.judged]
    assert seqs == sorted(set(seqs))
    assert bench.gaps == sum(b - a > 1 for a, b in itertools.pairwise([-1, *seqs]))


@pytest.mark.parametrize(
    "costs",
    [[PERIOD_NS * 9 // 10] * 101, [0] * 20 + [95 * MS] + [MS // 2] * 80],
    ids=["nearly a period each", "one stall"],
)
def test_nothing_is_skipped_if_the_backlog_takes_under_10_ms(costs: list[int]) -> None:
    clock, each = Clock(), iter(costs)
    bench = OverloadedLoop(TimedDriver(stream(1.0), clock), clock, lambda: next(each))
    assert [seen.seq for _, seen in bench.judged] == list(range(100))
    assert bench.statuses[-1].skipped_readings == 0
    assert bench.gaps == 0
    assert sum(bench.rests_s) < 0.01  # a stall alone is long enough for one


def test_a_recording_is_judged_whole_however_slow_the_judge() -> None:
    clock = Clock()
    driver = TimedDriver(stream(1.0), clock, live=False)
    bench = OverloadedLoop(driver, clock, lambda: 30 * MS)
    assert [seen.seq for _, seen in bench.judged] == list(range(100))
    assert bench.statuses[-1].skipped_readings == 0
    assert not any(status.overloaded for status in bench.statuses)
    assert bench.rests_s  # all the same: in realtime it would be ended


def test_an_overloaded_loop_sleeps_feeds_the_watchdog_and_reports() -> None:
    bench = flood(30 * MS, 10.0)
    worked_ns = 10 * SECOND_NS
    assert sum(bench.rests_s) * 1e9 == pytest.approx(worked_ns / 11, rel=0.2)
    assert max(bench.rests_s) * 1e9 <= YIELD_MAX_NS
    assert len(bench.rests_s) >= len(bench.judged) - 2
    assert max(np.diff(bench.rounds_ns)) < 200 * MS
    assert len(bench.statuses) == 10
    assert max(np.diff([status.t_mono_ns for status in bench.statuses])) < 1.1 * SECOND_NS


def test_an_overload_is_logged_at_its_begin_and_end(caplog: pytest.LogCaptureFixture) -> None:
    clock = Clock()

    def cost_ns() -> int:
        return 30 * MS if clock() < START_NS + 5 * SECOND_NS else 0

    with caplog.at_level(logging.INFO, "graspd"):
        bench = OverloadedLoop(TimedDriver(stream(13.0), clock), clock, cost_ns)
    times_s = [(status.t_mono_ns - START_NS) / SECOND_NS for status in bench.statuses]
    said = [status.overloaded for status in bench.statuses]
    assert said[:2] == [False, False]
    assert all(over for t_s, over in zip(times_s, said, strict=True) if 3.2 < t_s < 10.0)
    assert not any(over for t_s, over in zip(times_s, said, strict=True) if t_s > 10.5)
    assert [record.levelno for record in caplog.records] == [logging.WARNING, logging.INFO]
    assert f"{bench.statuses[-1].skipped_readings} readings" in caplog.text


def test_readings_skipped_in_one_stall_are_counted_without_overload(
    caplog: pytest.LogCaptureFixture,
) -> None:
    clock = Clock()
    costs = itertools.chain([MS] * 20, [SECOND_NS // 2], itertools.repeat(MS))
    bench = OverloadedLoop(TimedDriver(stream(3.0), clock), clock, lambda: next(costs))
    assert bench.statuses[-1].skipped_readings == 49
    assert not any(status.overloaded for status in bench.statuses)
    assert not caplog.records


def test_in_overload_no_joint_reading_is_skipped_or_reordered() -> None:
    clock = Clock()
    angles = [
        JointReading(item.t_ns, number, ("FFJ3",), np.array([0.5]))
        for number, item in enumerate(stream(2.0))
    ]
    both = [item for pair in zip(angles, stream(2.0), strict=True) for item in pair]
    bench = OverloadedLoop(TimedDriver(both, clock), clock, lambda: 30 * MS)
    assert bench.angles == list(range(200))
    assert bench.statuses[-1].skipped_readings > 100


def test_the_newest_is_judged_even_if_reads_return_only_three() -> None:
    """The loop reads again until no reading waits."""
    bench = flood(100 * MS, 3.0, at_once=3)
    ages_ms = [verdict.age_ms for verdict, _ in bench.judged[3:-1]]
    assert max(ages_ms) < 10.0


def test_a_driver_with_endless_readings_does_not_hold_the_loop() -> None:
    clock = Clock()
    driver = TimedDriver(stream(0.6, PERIOD_NS // 200), clock, at_once=20)
    bench = OverloadedLoop(driver, clock, lambda: 30 * MS)
    rounds = len(bench.rounds_ns)
    assert driver.calls <= (DRAINS_MAX + 1) * rounds
    assert max(np.diff(bench.rounds_ns)) < 200 * MS
    assert bench.statuses[-1].skipped_readings + len(bench.judged) == driver.counters.readings


def test_a_sensor_frozen_among_skipped_readings_is_never_stable() -> None:
    """The judge sees only the newest reading, which differs from the one that it saw before."""
    clock = Clock()
    came = stream(2.0)
    for at in range(100, 200, 10):
        for item in came[at + 1 : at + 9]:
            assert isinstance(item, TactileReading)
            item.counts[:] = came[at].counts  # type: ignore[union-attr]
    first = {came[at].t_ns for at in range(100, 200, 10)}
    bench = OverloadedLoop(TimedDriver(came, clock), clock, lambda: 35 * MS)
    frozen = [
        (verdict, seen)
        for verdict, seen in bench.judged
        if seen.seq >= 100 and seen.seq % 10 and seen.seq % 10 != 9 and seen.t_ns not in first
    ]
    assert len(frozen) > 10
    assert {verdict.verdict for verdict, _ in frozen} == {Decision.UNKNOWN}
    assert Decision.STABLE in {verdict.verdict for verdict, _ in bench.judged}


def test_an_unchanged_finger_is_marked_held_except_its_flagged_electrodes() -> None:
    """A flagged electrode does not count as different from the former sweep."""
    former, newest = reading(START_NS, 1, 1), reading(START_NS + PERIOD_NS, 2, 2)
    counts = newest.counts.copy()
    counts[0] = former.counts[0]
    counts[0, 5] += 7
    faults = np.zeros((3, 24), np.uint8)
    faults[0, 5] = ElectrodeFault.PARITY
    found = mark_repeats(msgspec.structs.replace(newest, counts=counts, faults=faults), former)
    held = (found.faults & ElectrodeFault.HELD) != 0
    assert held[0].sum() == 23
    assert not held[0, 5]
    assert not held[1:].any()
    assert found.faults[0, 5] == ElectrodeFault.PARITY


def test_an_unread_finger_stays_marked_missing_not_held() -> None:
    former, newest = reading(START_NS, 1, 1), reading(START_NS + PERIOD_NS, 2, 2)
    counts, faults = newest.counts.copy(), np.zeros((3, 24), np.uint8)
    counts[2], faults[2] = 0, ElectrodeFault.MISSING
    gone = msgspec.structs.replace(newest, counts=counts, faults=faults)
    assert (
        mark_repeats(gone, msgspec.structs.replace(gone, counts=counts.copy())).faults[2].tolist()
        == [ElectrodeFault.MISSING] * 24
    )
    assert mark_repeats(gone, former) is gone


class BusySelector(selectors.SelectSelector):
    """Selector that never waits but works for 0.2 ms, as on a slow processor."""

    def select(self, timeout: float | None = None) -> list[tuple[selectors.SelectorKey, int]]:
        until_ns = time.thread_time_ns() + 200_000
        while time.thread_time_ns() < until_ns:
            pass
        return super().select(0.0)


def test_a_loop_kept_busy_by_its_selector_yields_the_processor() -> None:
    rests_s: list[float] = []
    clock = Clock()
    driver = FakeDriver([], clock)
    driver.ends = False

    def rest(seconds: float) -> None:
        rests_s.append(seconds)
        driver.ends = True

    driver.live = True
    timing = LoopTiming(60 * SECOND_NS, rest=rest, selector=BusySelector)
    LoopBench(driver, clock, timing=timing).run()
    assert len(rests_s) == 1
    assert 0.0 < rests_s[0] <= YIELD_MAX_NS / 1e9


def test_a_reading_marked_interrupted_makes_the_grasp_settle_again() -> None:
    """The counts continue as before; only the mark says that the sender began again."""
    clock, random = Clock(), np.random.default_rng(3)
    came: list[Reading] = []
    for seq, pose in enumerate(["rest"] * 150 + ["grasp"] * 100):
        counts = POSES[pose] + random.integers(-2, 3, (3, 24))
        came.append(sound(counts, START_NS + seq * PERIOD_NS, seq))
    came[200] = msgspec.structs.replace(came[200], interrupted=True)
    bench = OverloadedLoop(TimedDriver(came, clock), clock, lambda: 0, hand=HandLimits())
    said = {seen.seq: verdict for verdict, seen in bench.judged}
    assert said[199].verdict is Decision.STABLE
    assert said[200].reasons == [Reason.SEQUENCE_GAP]
    assert {said[seq].verdict for seq in range(200, 224)} == {Decision.UNKNOWN}
    assert said[224].verdict is Decision.STABLE
