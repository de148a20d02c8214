"""The loop: waits for drivers, judges what they bring, reports, says so when nothing comes."""

from __future__ import annotations

import selectors
import time
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

from daemon.judge.pipeline import Pipeline
from daemon.judge.verdict import State, Verdict
from daemon.reporter import Reporter
from daemon.stop import StopSignal
from drivers.base import Driver, JointReading, TactileReading

if TYPE_CHECKING:
    from daemon.questions import Questions

STATUS_PERIOD_NS = 1_000_000_000
"""Status goes out this often, ns, even when nothing happens."""
SILENCE_PERIODS = 10
"""Readings that may be missing before the daemon says so, as long as that is longer than the age
limit. Consumers apply the same rule to the daemon."""

Listener = Callable[[Verdict, bytes, TactileReading | None], None]
"""Gets every verdict after it was published, with its payload and the reading it is about."""


class Service:
    """Runs one hand in one thread until told to stop or until a recording ends."""

    def __init__(
        self,
        drivers: Sequence[Driver],
        pipeline: Pipeline,
        reporter: Reporter,
        stop: StopSignal,
        *,
        max_age_ns: int,
        listener: Listener | None = None,
        chore: Callable[[], None] | None = None,
        questions: Questions | None = None,
        clock: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        """`drivers` are open, the tactile one first; `max_age_ns` is the age limit, ns.

        `chore` is done before readings are judged, and once a second. `questions` are answered
        with the next verdict, or if a grasp is judged on request only, when it has been.
        """
        self._drivers = drivers
        self._tactile = drivers[0]
        self._pipeline = pipeline
        self._reporter = reporter
        self._stop = stop
        self._listener = listener
        self._chore = chore
        self._questions = questions
        self._clock = clock
        self._max_age_ns = max_age_ns
        self._state = State.RUNNING
        now_ns = clock()
        self._last_t_ns = now_ns
        self._silence_due_ns = now_ns + self._silence_ns()
        self._status_due_ns = now_ns + STATUS_PERIOD_NS
        self._status_at_ns = now_ns
        self._readings_since_status = 0

    def run(self) -> None:
        """Run. Raises `DriverError` if the driver gives up; sends a last status in any case."""
        try:
            with selectors.SelectSelector() as selector:
                selector.register(self._stop, selectors.EVENT_READ)
                while self._stop.received is None and not self._tactile.exhausted:
                    # Now, and not when the descriptor says so: sending an answer quietens it.
                    self._take_questions()
                    self._wait(selector)
                    if not self._take_readings():
                        self._mind_silence()
                    if self._clock() >= self._status_due_ns:
                        self._send_status()
        finally:
            self._state = State.STOPPING
            self._send_status()

    def _wait(self, selector: selectors.BaseSelector) -> None:
        """Sleep until a driver, a timer or a signal wants attention."""
        descriptors = (driver.fileno() for driver in self._drivers)
        wanted = {descriptor for descriptor in descriptors if descriptor is not None}
        if self._questions is not None:
            wanted.add(self._questions.fileno())
        watched = {key.fd for key in selector.get_map().values()} - {self._stop.fileno()}
        for former in watched - wanted:
            selector.unregister(former)
        for descriptor in wanted - watched:
            selector.register(descriptor, selectors.EVENT_READ)
        dues_ns = [driver.due_ns() for driver in self._drivers]
        due_ns = min(
            self._silence_due_ns, self._status_due_ns, *(due for due in dues_ns if due is not None)
        )
        selector.select(max(due_ns - self._clock(), 0) / 1e9)

    def _take_readings(self) -> bool:
        """Judge and report what the drivers have; False if there was no tactile reading."""
        taken = False
        readings = [reading for driver in self._drivers for reading in driver.read_ready()]
        received_ns = self._clock()
        if readings and self._chore is not None:
            self._chore()
        for reading in readings:
            if isinstance(reading, JointReading):
                self._pipeline.turn(reading)
                continue
            judgement = self._pipeline.judge(reading)
            verdict, payload = self._reporter.verdict(judgement, received_ns, self._silence_ns())
            self._state = State.RUNNING
            self._last_t_ns = reading.t_ns
            self._silence_due_ns = received_ns + self._silence_ns()
            self._readings_since_status += 1
            taken = True
            self._answer(verdict, payload)
            if self._listener is not None:
                self._listener(verdict, payload, reading)
        return taken

    def _take_questions(self) -> None:
        if self._questions is not None and self._questions.take(self._clock()):
            self._pipeline.ask()

    def _answer(self, verdict: Verdict, payload: bytes) -> None:
        """Answer who asked, if this verdict is what they wait for or they have waited too long."""
        if self._questions is None:
            return
        if verdict.judged or not self._pipeline.on_request:
            self._questions.answer(payload)
        else:
            self._questions.answer(payload, self._clock())

    def _mind_silence(self) -> None:
        now_ns = self._clock()
        if now_ns < self._silence_due_ns or self._tactile.exhausted:
            return
        self._state = State.SILENT
        self._silence_due_ns = now_ns + self._silence_ns()
        verdict, payload = self._reporter.verdict(
            self._pipeline.silence(self._last_t_ns), now_ns, self._silence_ns()
        )
        self._answer(verdict, payload)
        if self._listener is not None:
            self._listener(verdict, payload, None)

    def _silence_ns(self) -> int:
        """How long nothing may come before it is said, ns."""
        return max(self._max_age_ns, SILENCE_PERIODS * (self._tactile.period_ns or 0))

    def _send_status(self) -> None:
        if self._chore is not None:
            self._chore()
        now_ns = self._clock()
        elapsed_s = max(now_ns - self._status_at_ns, 1) / 1e9
        self._reporter.status(
            self._state,
            self._readings_since_status / elapsed_s,
            self._counters(),
            self._pipeline,
        )
        self._readings_since_status = 0
        self._status_at_ns = now_ns
        self._status_due_ns = now_ns + STATUS_PERIOD_NS

    def _counters(self) -> dict[str, dict[str, int]]:
        counters = {driver.name: driver.counters.as_dict() for driver in self._drivers}
        if self._questions is not None:
            counters["ask"] = dict(self._questions.counters)
        return counters
