"""The loop: every reading is answered, silence is answered too, and stopping is clean."""

from __future__ import annotations

import os
import signal
from collections.abc import Sequence
from typing import Literal

import numpy as np
import pytest

from graspd.daemon.judge.reasons import Decision, Reason
from graspd.daemon.publish.companion import (
    KEPT,
    Answer,
    Companion,
    LoopEvent,
    PublishedVerdict,
    Reply,
    Requests,
    Told,
)
from graspd.daemon.publish.messages import Lifts, State
from graspd.daemon.run.loop import UNKNOWN_START, Ended
from graspd.daemon.trust.lift_book import GraspId, OutcomeStatus, Report
from graspd.daemon.trust.trust import Trust
from graspd.drivers.base import (
    DriverError,
    JointReading,
    LinkCause,
    LinkError,
    Reading,
)
from tests.daemon.fakes import FINGERS, MS, Clock, FakeDriver, FakeModel, reading
from tests.daemon.session.learning import sensor_watch
from tests.kit.loops import LoopBench, TimedDriver
from tests.kit.messages import decode_tactile


def test_every_reading_gets_one_verdict_in_order() -> None:
    clock = Clock()
    bench = LoopBench(FakeDriver([reading(clock(), seed) for seed in range(20)], clock), clock)
    bench.run()
    assert [verdict.seq for verdict in bench.verdicts] == list(range(20))
    assert [verdict.grasp for verdict in bench.verdicts] == list(range(1, 21))
    assert {verdict.verdict for verdict in bench.verdicts} == {Decision.STABLE}
    assert {verdict.verdict_code for verdict in bench.verdicts} == {1}
    assert {verdict.valid for verdict in bench.verdicts} == {True}
    assert {verdict.silence_ms for verdict in bench.verdicts} == {100.0}
    assert len({verdict.boot_id for verdict in bench.verdicts}) == 1
    sent = [payload for topic, payload in bench.output.sent if topic == b"verdict.right"]
    assert sent == bench.payloads


@pytest.mark.parametrize(
    ("period_ms", "limit_ms", "expected"),
    [
        (10, 100.0, [(10, 0), (10, 100), (10, 200), (10, 300), (400, 0)]),
        (50, 500.0, [(10, 0), (400, 0), (400, 500), (950, 0)]),
    ],
)
def test_silence_is_reported_once_per_age_limit_or_ten_periods(
    period_ms: int, limit_ms: float, expected: list[tuple[int, int]]
) -> None:
    """`expected`: of each verdict the time of its reading, ms, and the reading's age, ms."""
    clock = Clock()
    start_ns = clock()
    times_ms = [time_ms for time_ms, age_ms in expected if age_ms == 0]
    driver = TimedDriver([reading(start_ns + time * MS, time) for time in times_ms], clock)
    driver.period_ns = period_ms * MS
    bench = LoopBench(driver, clock, cost_ns=lambda: 0)
    bench.run()
    said = [(round((v.t_mono_ns - start_ns) / MS), round(v.age_ms)) for v in bench.verdicts]
    assert said == expected
    assert {verdict.silence_ms for verdict in bench.verdicts} == {limit_ms}
    for verdict, (_, age_ms) in zip(bench.verdicts, expected, strict=True):
        is_silence = age_ms > 0
        assert verdict.verdict is (Decision.UNKNOWN if is_silence else Decision.STABLE)
        assert verdict.reasons == ([Reason.STALE] if is_silence else [])
        assert verdict.valid is not is_silence


def test_latency_includes_the_wait_behind_other_readings() -> None:
    clock = Clock()

    class SlowModel(FakeModel):
        def run(self) -> tuple[float, float]:
            clock.now_ns += 3 * MS
            return super().run()

    class BatchDriver(FakeDriver):
        def read_ready(self) -> Sequence[Reading]:
            batch = [item for item in self.queue if not isinstance(item, DriverError)]
            self.queue.clear()
            return batch

    driver = BatchDriver([reading(clock(), seed) for seed in range(3)], clock)
    bench = LoopBench(driver, clock, model=SlowModel())
    bench.run()
    assert [verdict.latency_us for verdict in bench.verdicts] == [3000.0, 6000.0, 9000.0]
    assert bench.statuses[-1].latency_us["max"] == 9000.0


@pytest.mark.parametrize("error", [LinkError(LinkCause.UNKNOWN, "gone"), DriverError("broken")])
def test_a_driver_error_ends_the_loop_with_status_stopping(error: DriverError) -> None:
    """The last status is sent; the watchdog is not fed for the round that failed."""
    clock, watchdog = Clock(), Watchdog()
    driver = FakeDriver([reading(clock(), 1), reading(clock(), 2), error], clock)
    bench = LoopBench(driver, clock, companions=[watchdog])
    with pytest.raises(DriverError):
        bench.run()
    assert bench.statuses[-1].state is State.STOPPING
    assert watchdog.fed == 2


def test_a_reading_that_came_before_the_signal_is_judged() -> None:
    """A reading and the signal arrive while the loop sleeps: the reading is not lost."""
    clock = Clock()
    bytes_there, write = os.pipe()

    class Last(FakeDriver):
        is_told = False

        def fileno(self) -> int | None:
            return bytes_there

        def read_ready(self) -> list[Reading]:
            if not self.is_told:
                self.is_told = True
                os.kill(os.getpid(), signal.SIGTERM)
                return []
            return [self.queue.pop(0)] if self.queue else []  # type: ignore[list-item]

    bench = LoopBench(Last([reading(clock())], clock), clock)
    assert bench.run() is Ended.STOPPED
    os.close(bytes_there)
    os.close(write)
    assert len(bench.verdicts) == 1
    assert bench.statuses[-1].state is State.STOPPING


class Watchdog(Companion):
    """Counts the rounds, in each of which a watchdog would be fed."""

    def __init__(self) -> None:
        self.fed = 0

    def after_round(self) -> None:
        self.fed += 1


def test_a_reading_is_sent_only_while_there_is_a_subscriber() -> None:
    clock = Clock()
    late = JointReading(clock() - 151 * MS, 0, ("THJ4", "FFJ4"), np.array([0.1, 0.2]))
    angles = JointReading(clock(), 1, ("FFJ3", "MFJ3"), np.array([0.5, np.nan]))
    others = JointReading(clock(), 2, ("FFJ4",), np.array([0.3]))
    first, second, third = (reading(clock(), seed) for seed in (1, 2, 3))
    came: list[Reading | DriverError] = [first, late, angles, others, second, third]
    bench = LoopBench(FakeDriver(came, clock), clock)
    send = bench.output.send

    def wants_from_the_second_verdict_on(topic: bytes, payload: bytes) -> None:
        send(topic, payload)
        bench.output.wants_tactile = len(bench.output.sent) == 1

    bench.output.send = wants_from_the_second_verdict_on  # type: ignore[method-assign]
    bench.run()
    topics = [topic for topic, _ in bench.output.sent[:-1]]
    assert topics == [b"verdict.right", b"tactile.right", b"verdict.right", b"verdict.right"]
    message = decode_tactile(bench.output.sent[1][1])
    assert message.counts == second.counts.tolist()
    assert message.faults == second.faults.tolist()
    assert message.fingers == list(FINGERS)
    assert message.joints == {"FFJ3": 0.5, "FFJ4": 0.3}


class Peer(Companion):
    """Asks and reports a slip before every wait; keeps the replies in `refused`, and in `heard`
    all events, outcomes and verdicts."""

    def __init__(self, boot_id: str) -> None:
        self.boot_id = boot_id
        self.refused: list[Reply] = []
        self.heard: list[object] = []

    def before_wait(self, requests: Requests) -> None:
        requests.ask()
        requests.outcome(Report(GraspId(self.boot_id, 1), "slip", "mug"), self.refused.append)

    def on_event(self, event: LoopEvent, grasp: GraspId | None = None) -> None:
        self.heard.append(event)

    def on_outcome(self, report: Report) -> None:
        self.heard.append(report)

    def on_verdict(self, published: PublishedVerdict) -> None:
        self.heard.append(published.payload)

    @property
    def counters(self) -> dict[str, dict[str, int]]:
        return {"peer": {"outcomes": self.refused.count(KEPT)}}


def test_a_companion_asks_reports_outcomes_and_gets_the_answers() -> None:
    clock = Clock()
    driver = FakeDriver([reading(clock(), seed) for seed in (1, 2)], clock)
    peer = Peer("b" * 32)
    bench = LoopBench(driver, clock, companions=[peer], boot_id=peer.boot_id)
    bench.run()
    first, second = bench.payloads
    told = Report(GraspId(peer.boot_id, 1), "slip", "mug")
    assert peer.refused == [Reply(Told.UNKNOWN_GRASP, "not judged, or too long ago"), KEPT]
    assert peer.heard == [LoopEvent.ASKED, first, LoopEvent.ASKED, told, second]
    assert [topic for topic, _ in bench.output.sent[:-1]].count(b"outcome.right") == 1
    assert bench.statuses[-1].drivers["peer"] == {"outcomes": 1}


BOOT = "b" * 32


def told(bench: LoopBench, outcome: Literal["stable", "slip", "not-lifted"]) -> list[Reply]:
    """Report an outcome of the first grasp; return a list to which its answers are added."""
    answers: list[Reply] = []
    bench.loop.outcome(Report(GraspId(BOOT, 1), outcome), answers.append)
    return answers


def test_outcomes_are_answered_once_saved_and_then_as_repeated() -> None:
    clock, waiting = Clock(), list[Answer]()
    driver = FakeDriver([reading(clock())], clock)
    bench = LoopBench(driver, clock, boot_id=BOOT, keep=waiting.append)
    bench.run()
    first, again = told(bench, "slip"), told(bench, "slip")
    assert (first, again, len(waiting)) == ([], [], 2)
    full = Reply(Told.NOT_KEPT, "full")
    waiting[0](full)
    third = told(bench, "slip")
    assert (first, third, len(waiting)) == ([full], [], 3)
    waiting[2](KEPT)
    assert third == [KEPT]
    assert told(bench, "slip") == [Reply(Told.REPEATED)]
    assert len(waiting) == 3
    assert [topic for topic, _ in bench.output.sent].count(b"outcome.right") == 1


@pytest.mark.parametrize("outcome", ["stable", "slip"])
def test_not_lifted_after_an_outcome_is_refused_as_contradicting(
    outcome: Literal["stable", "slip"],
) -> None:
    clock = Clock()
    bench = LoopBench(FakeDriver([reading(clock())], clock), clock, boot_id=BOOT)
    bench.run()
    assert told(bench, outcome) == [KEPT]
    assert [reply.told for reply in told(bench, "not-lifted")] == [Told.CONTRADICTS]
    assert bench.pipeline.lifts.told[OutcomeStatus.CONTRADICTS] == 1


def test_a_replay_takes_outcomes_that_name_its_own_start() -> None:
    """The book of lifts has the grasp under the recorded start's id, the report the replay's."""
    clock = Clock()
    bench = LoopBench(FakeDriver([reading(clock())], clock), clock, boot_id=BOOT)
    bench.pipeline.boot_id = "e" * 32
    bench.run()
    assert told(bench, "slip") == [KEPT]
    assert bench.pipeline.lifts.is_told(GraspId("e" * 32, 1))


def test_an_outcome_teaches_before_the_next_verdict() -> None:
    clock, trust = Clock(), Trust("fake", 0)
    driver = FakeDriver([reading(clock(), seed) for seed in (1, 2, 3)], clock)
    peer = Peer("b" * 32)
    bench = LoopBench(driver, clock, companions=[peer], boot_id=peer.boot_id, trust=trust)
    bench.run()
    assert [verdict.outcomes for verdict in bench.verdicts] == [0, 1, 1]
    first, second, _ = (verdict.p_slip for verdict in bench.verdicts)
    assert first is not None
    assert second is not None
    assert second > first
    assert bench.verdicts[1].p_slip_model == first
    status = bench.statuses[-1]
    assert status.lifts == Lifts(reported=1, outstanding=2, unreported=0)
    assert status.learner is not None
    assert status.learner.told == {
        OutcomeStatus.UNKNOWN: 1,
        OutcomeStatus.TAKEN: 1,
        OutcomeStatus.REPEATED: 1,
    }
    assert 0.0 < status.learner.uncertainty < 1.0


def test_outcomes_of_an_earlier_start_count_only_for_known_grasps() -> None:
    clock, earlier = Clock(), GraspId("e" * 32, 1)
    known = Trust("fake", 0)
    known.note(earlier, known.judge(earlier, 0.1, -2.0, np.empty(0)), stable=True)
    for trust in (known, Trust("fake", 0)):
        driver = FakeDriver([reading(clock(), seed) for seed in (1, 2)], clock)
        peer = Peer(earlier.boot_id)
        bench = LoopBench(driver, clock, companions=[peer], boot_id="b" * 32, trust=trust)
        bench.run()
        taken = trust is known
        expected = [KEPT, Reply(Told.REPEATED)] if taken else [UNKNOWN_START] * 2
        assert peer.refused == expected
        assert trust.learner.outcomes == int(taken)


class Exchanging(FakeDriver):
    """Driver whose sensor has another serial number from the third reading on."""

    @property
    def serials(self) -> dict[str, str]:
        return {"ff": "A" if self.counters.readings < 3 else "B"}


def test_a_changed_serial_number_is_noticed_before_judging_that_reading() -> None:
    clock = Clock()
    driver = Exchanging([reading(clock(), seed) for seed in range(4)], clock)
    published_at_exchange: list[int] = []
    watch = sensor_watch(driver, lambda: published_at_exchange.append(len(bench.output.sent)))
    bench = LoopBench(driver, clock, companions=[watch])
    bench.output.wants_tactile = True
    bench.run()
    assert published_at_exchange == [4]  # two readings and their verdicts
