"""The loop: waits for readings, has them judged and the verdicts sent, and notices silence."""

from __future__ import annotations

import selectors
import time
from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import dataclass, field
from enum import Enum
from typing import Literal

from daemon.judge.pipeline import Pipeline
from daemon.process.signals import Stop
from daemon.process.sleep import Sleep
from daemon.publish.companion import CONTRADICTS, Answer, Companion, overridden
from daemon.publish.deadlines import Deadlines
from daemon.publish.messages import State, Verdict
from daemon.publish.outbox import Outbox
from daemon.run.overload import Overload, after
from daemon.run.selector import ExactSelector
from daemon.trust.ledger import GraspId
from drivers.base import Driver, JointReading, Reading, TactileReading

STATUS_PERIOD_NS = 1_000_000_000
"""Status goes out this often, ns, even when nothing happens."""
SILENCE_PERIODS = 10
"""Readings that may be missing before the daemon says so, as long as that is longer than the age
limit. Consumers apply the same rule to the daemon."""
DRAINS_MAX = 8
"""How often the driver is asked for more in one round when there is too much: what the kernel keeps
is taken in fewer, and a flood cannot hold the loop."""
BLOCKED_NS = 50_000
"""A wait longer by this than what the processor took for it, ns, was one: the kernel had this
thread sleep. What is there already takes processor time alone, however slow the processor is."""


class Ended(Enum):
    """Why the loop has ended."""

    STOPPED = "stopped"
    EXHAUSTED = "exhausted"
    """The recording is over."""
    RELOAD = "reload"
    """The scene is to be read again."""
    SLEPT = "slept"
    """The computer has slept: what is known of the hand is from before, however fresh it looks."""


Selector = ExactSelector | selectors.BaseSelector


@dataclass(frozen=True, slots=True)
class Timing:
    """What the loop knows of time."""

    max_age_ns: int
    """Age limit of readings, ns."""
    clock: Callable[[], int] = time.monotonic_ns
    """Gives monotonic ns."""
    sleep: Sleep = field(default_factory=Sleep)
    """Says whether the computer has slept."""
    rest: Callable[[float], None] = time.sleep
    """Has the kernel put this thread to sleep, s."""
    selector: Callable[[], Selector] = ExactSelector
    """Makes what waits for descriptors."""


class Loop:
    """Runs one hand, in one thread, until told to stop or until a recording ends."""

    def __init__(
        self,
        drivers: Sequence[Driver],
        pipeline: Pipeline,
        outbox: Outbox,
        stop: Stop,
        companions: Sequence[Companion],
        timing: Timing,
    ) -> None:
        """`drivers` are open, the tactile one first, and are closed by who opened them.

        `stop` says when to end and when the scene is to be read again. `companions` are called in
        their order.
        """
        self._drivers = drivers
        self._tactile = drivers[0]
        self._pipeline = pipeline
        self._outbox = outbox
        self._stop = stop
        self._clock = timing.clock
        self._sleep = timing.sleep
        self._new_selector = timing.selector
        self._max_age_ns = timing.max_age_ns

        self._filenos = overridden(companions, Companion.filenos)
        drivers_due_ns = (driver.due_ns for driver in drivers)
        self._due_ns = (*drivers_due_ns, *overridden(companions, Companion.due_ns))
        self._before_wait = overridden(companions, Companion.before_wait)
        self._before_readings = overridden(companions, Companion.before_readings)
        self._on_joints = overridden(companions, Companion.on_joints)
        self._on_skipped = overridden(companions, Companion.on_skipped)
        self._on_asked = overridden(companions, Companion.on_asked)
        self._on_outcome = overridden(companions, Companion.on_outcome)
        self._keep = overridden(companions, Companion.keep)
        self._on_answer = overridden(companions, Companion.on_answer)
        self._on_verdict = overridden(companions, Companion.on_verdict)
        self._on_judged = overridden(companions, Companion.on_judged)
        self._on_status = overridden(companions, Companion.on_status)
        self._after_round = overridden(companions, Companion.after_round)
        self._counters_by_part = overridden(companions, Companion.counters_by_part)

        self._deadlines = Deadlines()
        self._joints: JointReading | None = None
        self._watched: list[int] = []
        """Descriptors of drivers and companions that the selector has."""
        self._state = State.RUNNING
        now_ns = self._clock()
        self._overload = Overload(now_ns, live=self._tactile.live, sleep=timing.rest)
        self._last_t_ns = now_ns
        self._silence_due_ns = now_ns + self._silence_ns(self._tactile.period_ns)
        self._status_due_ns = now_ns + STATUS_PERIOD_NS
        self._status_at_ns = now_ns
        self._readings_since_status = 0

    def run(self) -> Ended:
        """Run until something ends it. Called again after `RELOAD`, it goes on where it was.

        Raises `DriverError` if a driver gives up. Call `close` when it is not to go on.
        """
        self._watched = []
        with closing(self._new_selector()) as selector:
            selector.register(self._stop, selectors.EVENT_READ)
            while self._stop.received is None:
                if self._tactile.exhausted:
                    return Ended.EXHAUSTED
                if self._stop.take_reload():
                    return Ended.RELOAD
                if self._sleep.has_slept():  # before anything is repeated for who comes late
                    return self._wake()
                self._go_round(selector)
        if self._tactile.fileno() is not None:
            self._take_readings()  # what had come before the signal
        return Ended.STOPPED

    def close(self) -> None:
        """Send the last status, whose state is `stopping`."""
        self._state = State.STOPPING
        self._send_status()

    def ask(self) -> None:
        """Have a settled grasp judged, if that is done on request only."""
        self._pipeline.ask()
        for on_asked in self._on_asked:
            on_asked()

    def outcome(
        self,
        boot_id: str,
        grasp: int,
        outcome: Literal["stable", "slip"],
        object_name: str | None = None,
    ) -> str | None:
        """Publish and learn how the lift of a judged grasp has ended; None, or why not."""
        judged = GraspId(boot_id, grasp)
        trust = self._pipeline.trust
        if trust is not None and trust.ledger.contradicts(judged, slipped=outcome == "slip"):
            trust.outcome(judged, slipped=outcome == "slip")  # which counts it
            return CONTRADICTS
        refused = self._outbox.outcome(
            *judged, outcome, object_name, known=self._pipeline.knows(judged)
        )
        if refused is None:
            self._pipeline.outcome(judged, slipped=outcome == "slip")
            for on_outcome in self._on_outcome:
                on_outcome(grasp, outcome, object_name)
        return refused

    def keep(self, answer: Answer) -> None:
        """Call `answer` once what was told is on the disk; at once where nothing is kept there."""
        if not self._keep:
            answer(None)
        for keep in self._keep:
            keep(answer)

    def _go_round(self, selector: Selector) -> None:
        # Now, and not when the descriptors say so: sending quietens them.
        for before_wait in self._before_wait:
            before_wait(self)
        self._wait(selector)
        if not self._take_readings():
            self._check_silence()
        if self._clock() >= self._status_due_ns:
            self._send_status()
        for after_round in self._after_round:
            after_round()

    def _wake(self) -> Ended:
        """Say that nothing is known, also to who waits for an answer."""
        verdict, payload = self._tell_silence(self._clock())
        for on_answer in self._on_answer:
            on_answer(verdict, payload)
        return Ended.SLEPT

    def _wait(self, selector: Selector) -> None:
        """Sleep until a driver, a timer, a companion or a signal wants attention."""
        wanted = [fd for driver in self._drivers if (fd := driver.fileno()) is not None]
        for filenos in self._filenos:
            wanted += filenos()
        if wanted != self._watched:
            for former in set(self._watched).difference(wanted):
                selector.unregister(former)
            for descriptor in set(wanted).difference(self._watched):
                selector.register(descriptor, selectors.EVENT_READ)
            self._watched = wanted
        due_ns = min(self._silence_due_ns, self._status_due_ns)
        for timer in self._due_ns:
            timer_ns = timer()
            if timer_ns is not None and timer_ns < due_ns:
                due_ns = timer_ns
        now_ns = began_ns = self._clock()
        worked_ns = time.thread_time_ns()
        if began_ns < due_ns:
            selector.select((due_ns - began_ns) / 1e9)
            now_ns = self._clock()
        idle_ns = now_ns - began_ns
        if idle_ns >= BLOCKED_NS:  # else it is not asked for, which takes a system call
            idle_ns -= time.thread_time_ns() - worked_ns
        if idle_ns >= BLOCKED_NS:
            self._overload.waited(now_ns)
        else:  # there was work already
            self._overload.rest(now_ns)

    def _take_readings(self) -> bool:
        """Judge and report what the drivers have; False if there was no tactile reading."""
        taken = False
        readings, waiting = self._read()
        received_ns = began_ns = self._clock()
        if readings:
            for before_readings in self._before_readings:
                before_readings()
        skipped: list[TactileReading] = []
        for reading in readings:
            if isinstance(reading, JointReading):
                self._pipeline.observe_joints(reading)
                self._joints = reading
                for on_joints in self._on_joints:
                    on_joints(reading)
                continue
            waiting -= 1
            if waiting and (skipped or self._is_too_much(waiting + 1, began_ns - received_ns)):
                skipped.append(reading)
                continue
            if skipped:
                reading = self._after(skipped, reading)
            if not self._judge(reading, received_ns):
                return taken
            taken = True
            judged_ns = self._clock()
            self._overload.judged(judged_ns - began_ns)
            began_ns = judged_ns
        if taken:
            self._pipeline.learn()  # what there is time for only now
        return taken

    def _read(self) -> tuple[list[Reading], int]:
        """What the drivers have, and how many are tactile; if that is too much, to the newest."""
        readings: list[Reading] = []
        for driver in self._drivers:
            readings += driver.read_ready()
        waiting = _tactile(readings)
        for _ in range(DRAINS_MAX if self._is_too_much(waiting) else 0):
            more = self._tactile.read_ready()
            if not more:
                break
            readings += more
            waiting += _tactile(more)
        return readings, waiting

    def _is_too_much(self, waiting: int, elapsed_ns: int = 0) -> bool:
        return waiting > 1 and self._overload.is_too_much(
            waiting, elapsed_ns, self._tactile.period_ns
        )

    def _after(self, skipped: Sequence[TactileReading], newest: TactileReading) -> TactileReading:
        """The newest reading, as it is to be judged after those that were left out."""
        self._overload.skip(len(skipped), self._clock())
        self._pipeline.skip()
        for on_skipped in self._on_skipped:
            on_skipped()
        return after(skipped[-1], newest)

    def _judge(self, reading: TactileReading, received_ns: int) -> bool:
        """Judge and report one reading; False if it is of before a sleep of the computer."""
        self._outbox.tactile(reading, self._joints)
        judgement = self._pipeline.judge(reading)
        if self._sleep.has_slept():
            return False
        period_ns = self._tactile.period_ns
        silence_ns = self._silence_ns(period_ns)
        verdict, payload = self._outbox.verdict(judgement, received_ns, silence_ns)
        self._deadlines.add(reading, verdict.age_ms, period_ns)
        self._state = State.RUNNING
        self._last_t_ns = reading.t_ns
        self._silence_due_ns = received_ns + silence_ns
        self._readings_since_status += 1
        self._tell(verdict, payload, reading)
        if judgement.moment.judged:
            for on_judged in self._on_judged:
                on_judged(judgement)
        return True

    def _tell(self, verdict: Verdict, payload: bytes, reading: TactileReading | None) -> None:
        """Tell companions a verdict, and whether it is what those who ask wait for."""
        if verdict.judged or not self._pipeline.on_request:
            for on_answer in self._on_answer:
                on_answer(verdict, payload)
        for on_verdict in self._on_verdict:
            on_verdict(verdict, payload, reading)

    def _check_silence(self) -> None:
        now_ns = self._clock()
        if now_ns >= self._silence_due_ns and not self._tactile.exhausted:
            self._tell_silence(now_ns)

    def _tell_silence(self, now_ns: int) -> tuple[Verdict, bytes]:
        self._state = State.SILENT
        silence_ns = self._silence_ns(self._tactile.period_ns)
        self._silence_due_ns = now_ns + silence_ns
        verdict, payload = self._outbox.verdict(
            self._pipeline.silence(self._last_t_ns), now_ns, silence_ns
        )
        self._tell(verdict, payload, None)
        return verdict, payload

    def _silence_ns(self, period_ns: int | None) -> int:
        """How long nothing may come before it is said, ns."""
        return max(self._max_age_ns, SILENCE_PERIODS * (period_ns or 0))

    def _send_status(self) -> None:
        for before_readings in self._before_readings:
            before_readings()
        now_ns = self._clock()
        elapsed_s = max(now_ns - self._status_at_ns, 1) / 1e9
        counters = {driver.name: driver.counters.as_dict() for driver in self._drivers}
        for counters_by_part in self._counters_by_part:
            counters |= counters_by_part()
        status = self._outbox.status(
            self._state,
            self._readings_since_status / elapsed_s,
            counters,
            self._pipeline,
            self._deadlines,
            skipped_readings=self._overload.skipped_readings,
            overloaded=self._overload.overloaded,
        )
        self._readings_since_status = 0
        self._status_at_ns = now_ns
        self._status_due_ns = now_ns + STATUS_PERIOD_NS
        for on_status in self._on_status:
            on_status(status)


def _tactile(readings: Sequence[Reading]) -> int:
    """How many of them are tactile."""
    return [type(reading) for reading in readings].count(TactileReading)
