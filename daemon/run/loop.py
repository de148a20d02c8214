"""The loop: wait for readings, judge them, publish verdicts, and notice silence."""

from __future__ import annotations

import math
import selectors
import time
from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import dataclass, field
from enum import Enum
from functools import partial
from typing import Final

from graspd.daemon.judge.pipeline import Judgement, Pipeline
from graspd.daemon.judge.reasons import Reason
from graspd.daemon.process.signals import StopSignal
from graspd.daemon.process.sleep import Sleep
from graspd.daemon.publish.companion import (
    Answer,
    Companion,
    LoopEvent,
    PublishedVerdict,
    Reply,
    Told,
    at_once,
    hooks,
)
from graspd.daemon.publish.messages import State
from graspd.daemon.publish.outbox import Outbox
from graspd.daemon.run.overload import LoadShedder, mark_repeats
from graspd.daemon.trust.lift_book import GraspId, OutcomeStatus, Report
from graspd.drivers.base import Driver, JointReading, Reading, TactileReading

NOT_YOURS: Final = Reply(
    Told.NOT_YOURS, "another peer may lift here, or this one has too short a routing id"
)
UNKNOWN_START: Final = Reply(Told.UNKNOWN_START, "of a start whose grasps are not known any more")
REFUSALS: Final = {
    OutcomeStatus.UNKNOWN: Reply(Told.UNKNOWN_GRASP, "not judged, or too long ago"),
    OutcomeStatus.CONTRADICTS: Reply(
        Told.CONTRADICTS, "another outcome of this grasp was told before"
    ),
}
"""Answer to a refused outcome by its status."""
STATUS_PERIOD_NS: Final = 1_000_000_000
"""Time between two status messages, ns."""
SILENCE_PERIODS: Final = 10
"""Number of missing readings that count as silence; never in less time than the age limit."""
DRAINS_MAX: Final = 8
"""Most extra reads of the driver in one round, so that a flood cannot hold the loop."""
BLOCKED_NS: Final = 50_000
"""Time for which a wait must block, its processor time left out, for the loop to be idle, ns."""


class Ended(Enum):
    """Reason why the loop ended; the value is for the log."""

    STOPPED = "a signal"
    EXHAUSTED = "the end of the recording"
    SLEPT = "a sleep of the computer"
    """The loop ends after a sleep, as readings from before it may look new."""


POLL = getattr(selectors, "PollSelector", selectors.DefaultSelector)
"""Selector by poll(2). Systems without it, which only replay recordings, use another one."""


@dataclass(frozen=True, slots=True)
class LoopTiming:
    """Clocks and waits of the loop."""

    max_age_ns: int
    """Age limit of readings, ns."""
    clock: Callable[[], int] = time.monotonic_ns
    """Clock that returns monotonic ns."""
    sleep: Sleep = field(default_factory=Sleep)
    rest: Callable[[float], None] = time.sleep
    """Function that puts this thread to sleep for a number of seconds."""
    selector: Callable[[], selectors.BaseSelector] = POLL
    """Selector: `POLL`, which waits in whole milliseconds.

    A driver that reopens a device mostly gets the same descriptor, which epoll(7) would not notice.
    """


class Loop:
    """Run one hand in one thread until a signal, a sleep of the computer or a recording's end."""

    def __init__(
        self,
        drivers: Sequence[Driver],
        pipeline: Pipeline,
        outbox: Outbox,
        stop: StopSignal,
        companions: Sequence[Companion],
        timing: LoopTiming,
        keep: Callable[[Answer], None] = at_once,
    ) -> None:
        """`drivers`: open, the tactile one first; the caller closes them.

        `keep`: calls its argument once all outcomes until now are saved, or cannot be.
        """
        self._drivers = drivers
        self._tactile = drivers[0]
        self._pipeline = pipeline
        self._on_request = pipeline.on_request
        self._outbox = outbox
        self._stop = stop
        self._clock = timing.clock
        self._sleep = timing.sleep
        self._new_selector = timing.selector
        self._max_age_ns = timing.max_age_ns
        self._keep = keep

        pipeline.lifts.on_announced = self._announced
        self._companions = companions
        self._before_wait = hooks(companions, Companion.before_wait)
        self._on_reading = hooks(companions, Companion.on_reading)
        self._on_event = hooks(companions, Companion.on_event)
        self._on_verdict = hooks(companions, Companion.on_verdict)
        self._on_outcome = hooks(companions, Companion.on_outcome)
        self._on_status = hooks(companions, Companion.on_status)
        self._after_round = hooks(companions, Companion.after_round)

        self._joints: dict[str, tuple[int, float]] = {}
        """Time, ns, and value, rad, of the newest angle of each joint."""
        self._watched: list[int] = []
        """Descriptors of drivers and companions in the selector."""
        self._state = State.RUNNING
        now_ns = self._clock()
        self._shedder = LoadShedder(now_ns, live=self._tactile.live, sleep=timing.rest)
        self._last_t_ns = now_ns
        self._silence_due_ns = now_ns + self._silence_ns
        self._status_at_ns = now_ns
        self._readings_since_status = 0

    def run(self) -> Ended:
        """Run until the loop ends; return why. Call `close` after it. Raises `DriverError`."""
        with closing(self._new_selector()) as selector:
            selector.register(self._stop, selectors.EVENT_READ)
            while self._stop.received is None:
                if self._tactile.exhausted:
                    return Ended.EXHAUSTED
                if self._sleep.has_slept():
                    self._report_silence(self._clock(), is_answer=True)
                    return Ended.SLEPT
                self._go_round(selector)
        if self._tactile.fileno() is not None:
            self._take_readings()  # the readings that had arrived before the signal
        return Ended.STOPPED

    def close(self) -> None:
        """Publish the last status, with the state `stopping`."""
        self._state = State.STOPPING
        self._send_status()

    def _go_round(self, selector: selectors.BaseSelector) -> None:
        self._wait(selector)
        if not self._take_readings() and not self._tactile.exhausted:
            now_ns = self._clock()
            if now_ns >= self._silence_due_ns:
                self._report_silence(now_ns)
        if self._clock() - self._status_at_ns >= STATUS_PERIOD_NS:
            self._send_status()
        for after_round in self._after_round:
            after_round()

    def _wait(self, selector: selectors.BaseSelector) -> None:
        """Have the companions act; wait for input, or until something is due."""
        # This does not depend on their descriptors, which sending a message resets.
        ends_ns = [before_wait(self) for before_wait in self._before_wait]
        watched = list[int]()
        for companion in self._companions:
            watched += companion.filenos
        for driver in self._drivers:
            if (descriptor := driver.fileno()) is not None:
                watched.append(descriptor)
            ends_ns.append(driver.due_ns())
        due_ns = min(self._silence_due_ns, self._status_at_ns + STATUS_PERIOD_NS)
        for end_ns in ends_ns:
            if end_ns is not None and end_ns < due_ns:
                due_ns = end_ns
        if watched != self._watched:
            self._watch(watched, selector)
        now_ns = began_ns = self._clock()
        worked_ns = time.thread_time_ns()
        if began_ns < due_ns:
            selector.select((due_ns - began_ns) / 1e9)
            now_ns = self._clock()
        idle_ns = now_ns - began_ns
        if idle_ns >= BLOCKED_NS:  # reading the processor time is a system call
            idle_ns -= time.thread_time_ns() - worked_ns
        if idle_ns >= BLOCKED_NS:
            self._shedder.waited(now_ns)
        else:  # input was waiting already
            self._shedder.yield_processor(now_ns)

    def _watch(self, watched: list[int], selector: selectors.BaseSelector) -> None:
        for former in set(self._watched).difference(watched):
            selector.unregister(former)
        for descriptor in set(watched).difference(self._watched):
            selector.register(descriptor, selectors.EVENT_READ)
        self._watched = watched

    def _take_readings(self) -> bool:
        """Judge and publish the waiting readings, or skip some; return False if none was judged."""
        readings, backlog = self._read()
        received_ns = began_ns = self._clock()
        taken = False
        skipped: list[TactileReading] = []
        for reading in readings:
            for on_reading in self._on_reading:
                on_reading(reading)
            if reading.interrupted:
                self._interrupt()
            if isinstance(reading, JointReading):
                self._pipeline.observe_joints(reading)
                self._joints |= _angles(reading)
                continue
            backlog -= 1
            if backlog and (skipped or self._should_skip(backlog + 1, began_ns - received_ns)):
                skipped.append(reading)
                continue
            if skipped:
                reading = self._after_skipped(skipped, reading)
            if not self._judge(reading, received_ns):
                return taken
            taken = True
            judged_ns = self._clock()
            self._shedder.record_cost(judged_ns - began_ns)
            began_ns = judged_ns
        if taken:
            self._pipeline.learn()  # last, when the verdicts are published and there is time
        return taken

    def _read(self) -> tuple[list[Reading], int]:
        """Return the waiting readings, and how many of them are tactile."""
        readings: list[Reading] = []
        for driver in self._drivers:
            readings += driver.read_ready()
        backlog = _count_tactile(readings)
        for _ in range(DRAINS_MAX if self._should_skip(backlog) else 0):
            more = self._tactile.read_ready()
            if not more:
                break
            readings += more
            backlog += _count_tactile(more)
        return readings, backlog

    def _should_skip(self, backlog: int, age_ns: int = 0) -> bool:
        return backlog > 1 and self._shedder.should_skip(backlog, age_ns, self._tactile.period_ns)

    def _after_skipped(
        self, skipped: Sequence[TactileReading], newest: TactileReading
    ) -> TactileReading:
        """Count `skipped`, have the grasp settle again, and return `newest`, with `HELD` where a
        finger repeats the last skipped reading."""
        self._shedder.skip(len(skipped), self._clock())
        self._interrupt()
        return mark_repeats(newest, skipped[-1])

    def _interrupt(self) -> None:
        """Have the grasp settle again, as readings are missing; report this to the companions."""
        self._pipeline.skip()
        for on_event in self._on_event:
            on_event(LoopEvent.SKIPPED)

    def _judge(self, reading: TactileReading, received_ns: int) -> bool:
        """Judge and publish a reading; if the computer slept meanwhile, only return False."""
        judgement = self._pipeline.judge(reading)
        if self._sleep.has_slept():
            return False
        self._state = State.RUNNING
        self._last_t_ns = reading.t_ns
        self._readings_since_status += 1
        self._publish(judgement, reading, received_ns)
        return True

    def _report_silence(self, now_ns: int, *, is_answer: bool = False) -> None:
        self._state = State.SILENT
        judgement = self._pipeline.silence(self._last_t_ns)
        self._publish(judgement, None, now_ns, is_answer=is_answer)

    def _publish(
        self,
        judgement: Judgement,
        reading: TactileReading | None,
        received_ns: int,
        *,
        is_answer: bool = False,
    ) -> None:
        """Publish a verdict and its reading; None: silence.

        `is_answer`: it answers waiting questions even without a judgement.
        """
        silence_ns, period_ns = self._silence_ns, self._tactile.period_ns
        self._silence_due_ns = received_ns + silence_ns
        if reading is not None:
            self._outbox.tactile(reading, self._joints)
        verdict, payload = self._outbox.verdict(
            judgement, received_ns, silence_ns, reading, period_ns
        )
        is_answer = is_answer or verdict.judged or not self._on_request
        grasp = GraspId(self._pipeline.boot_id, verdict.grasp)
        about = grasp, self._pipeline.lifts, self._keep
        published = PublishedVerdict(judgement, verdict, payload, reading, is_answer, *about)
        for on_verdict in self._on_verdict:
            on_verdict(published)

    @property
    def _silence_ns(self) -> int:
        """Return the time without a reading, ns, after which silence is reported."""
        return max(self._max_age_ns, SILENCE_PERIODS * (self._tactile.period_ns or 0))

    def _announced(self, grasp: GraspId, announced: bool) -> None:
        for on_event in self._on_event:
            on_event(LoopEvent.ANNOUNCED if announced else LoopEvent.TAKEN_BACK, grasp)

    def _send_status(self) -> None:
        now_ns = self._clock()
        elapsed_s = max(now_ns - self._status_at_ns, 1) / 1e9
        counters = {driver.name: driver.counters.as_dict() for driver in self._drivers}
        health: dict[str, Reason] = {}
        for companion in self._companions:
            counters |= companion.counters
            health |= companion.health
        status = self._outbox.status(
            self._state,
            self._readings_since_status / elapsed_s,
            counters,
            self._pipeline,
            health,
            skipped_readings=self._shedder.skipped_readings,
            overloaded=self._shedder.overloaded,
        )
        self._readings_since_status = 0
        self._status_at_ns = now_ns
        for on_status in self._on_status:
            on_status(status)

    def ask(self) -> None:
        """Request a judgement; in mode `request` a settled grasp is judged then."""
        self._pipeline.ask()
        for on_event in self._on_event:
            on_event(LoopEvent.ASKED)

    def silence(self) -> None:
        """Publish the verdict `unknown`, with reason `stale`: no reading has come."""
        self._report_silence(self._clock())

    def outcome(self, report: Report, answer: Answer) -> None:
        """Learn, publish and save the outcome of a lift; call `answer` once saved or refused.

        `not-lifted` takes back that the grasp may be lifted.
        """
        lifts, grasp = self._pipeline.lifts, report.grasp
        if grasp.boot_id == self._outbox.boot_id:  # the lift book of a replay has the recorded ids
            grasp = GraspId(self._pipeline.boot_id, grasp.grasp)
        if not lifts.may_report(grasp, report.peer):
            answer(NOT_YOURS)
            return
        if report.outcome == "not-lifted" and lifts.take_back(grasp):
            self._keep(answer)
            return
        if report.outcome == "not-lifted" and lifts.is_told(grasp):
            lifts.told[OutcomeStatus.CONTRADICTS] += 1
            answer(REFUSALS[OutcomeStatus.CONTRADICTS])
            return
        status = self._pipeline.outcome(grasp, slipped=report.outcome == "slip")
        if status in REFUSALS:
            is_earlier = status is OutcomeStatus.UNKNOWN and grasp.boot_id != self._outbox.boot_id
            answer(UNKNOWN_START if is_earlier else REFUSALS[status])
            return
        if status is OutcomeStatus.TAKEN:
            self._outbox.outcome(report)
            for on_outcome in self._on_outcome:
                on_outcome(report._replace(grasp=grasp))
        elif lifts.is_kept(grasp):
            answer(Reply(Told.REPEATED))
            return
        self._keep(partial(self._kept, grasp, answer))

    def _kept(self, grasp: GraspId, answer: Answer, reply: Reply) -> None:
        if reply.told is Told.KEPT:
            self._pipeline.lifts.keep(grasp)
        answer(reply)


def _angles(joints: JointReading) -> dict[str, tuple[int, float]]:
    pairs = zip(joints.names, joints.position_rad.tolist(), strict=True)
    return {name: (joints.made_ns, angle) for name, angle in pairs if math.isfinite(angle)}


def _count_tactile(readings: Sequence[Reading]) -> int:
    return [type(reading) for reading in readings].count(TactileReading)
