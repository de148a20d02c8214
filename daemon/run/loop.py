"""The loop: waits for drivers, judges what they bring, reports, says so when nothing comes."""

from __future__ import annotations

import selectors
import time
from collections.abc import Callable, Sequence
from enum import Enum
from typing import TYPE_CHECKING, Protocol

from daemon.judge.pipeline import Judgement, Pipeline
from daemon.process.signals import StopSignal
from daemon.process.sleep import Sleep
from daemon.publish.deadlines import Deadlines
from daemon.publish.messages import State, Status, Verdict
from daemon.publish.outbox import Reporter
from daemon.run.overload import Overload, after
from drivers.base import Driver, JointReading, Reading, TactileReading

if TYPE_CHECKING:
    from daemon.publish.questions import Questions

STATUS_PERIOD_NS = 1_000_000_000
"""Status goes out this often, ns, even when nothing happens."""
SILENCE_PERIODS = 10
"""Readings that may be missing before the daemon says so, as long as that is longer than the age
limit. Consumers apply the same rule to the daemon."""
DRAINS_MAX = 8
"""How often the driver is asked for more in one round when there is too much: what the kernel keeps
is taken in fewer, and a flood cannot hold the loop."""

Listener = Callable[[Verdict, bytes, TactileReading | None], None]
"""Gets every verdict after it was published, with its payload and the reading it is about."""


class Ended(Enum):
    """Why the loop has ended."""

    STOPPED = "stopped"
    EXHAUSTED = "exhausted"
    """The recording is over."""
    RELOAD = "reload"
    """Another scene is ready to take over."""
    SLEPT = "slept"
    """The computer has: what is known of the hand is from before it, however fresh it looks."""


class Watchdog(Protocol):
    """Who wants to hear, now and then, that the loop goes round."""

    def due_ns(self) -> int | None:
        """When next, monotonic ns; None if never."""

    def feed(self) -> None:
        """The loop has gone round: drivers, timers and messages have been seen to."""


class Peers(Protocol):
    """The sockets, as far as others than the publisher's caller come to them."""

    @property
    def questions(self) -> Questions | None:
        """Who takes questions, if anybody."""

    def filenos(self) -> list[int]:
        """Become readable when a peer may want something."""

    def take(self) -> None:
        """See to peers that come."""

    def counters(self) -> dict[str, dict[str, int]]:
        """What peers did, by the part that counted it."""


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
        on_joints: Callable[[JointReading], None] | None = None,
        on_asked: Callable[[], None] | None = None,
        on_skipped: Callable[[], None] | None = None,
        on_judged: Callable[[Judgement], None] | None = None,
        sockets: Peers | None = None,
        watchdog: Watchdog | None = None,
        on_status: Callable[[Status], None] | None = None,
        reload: Callable[[], bool] | None = None,
        clock: Callable[[], int] = time.monotonic_ns,
        sleep: Sleep | None = None,
    ) -> None:
        """`drivers` are open, the tactile one first; `max_age_ns` is the age limit, ns.

        `chore` is done before readings are judged, and once a second. `on_joints` gets every joint
        reading, `on_asked` is done when somebody has asked, `on_skipped` before a reading is judged
        if others before it were left out (`daemon.run.overload`), `on_judged` once a verdict is out
        for which the network judged the reading. Questions that come by `sockets` are answered with
        the next verdict, or if a grasp is judged on request only, when it has been.
        `on_status` gets every status once it is sent. `reload` is done when a reload is asked for,
        and says whether the loop shall end for it. `sleep` says whether the computer has slept.
        """
        self._drivers = drivers
        self._tactile = drivers[0]
        self._pipeline = pipeline
        self._reporter = reporter
        self._stop = stop
        self._listener = listener
        self._chore = chore
        self._on_joints = on_joints
        self._on_asked = on_asked
        self._on_skipped = on_skipped
        self._on_judged = on_judged
        self._sockets = sockets
        self._questions = None if sockets is None else sockets.questions
        if self._questions is not None:
            self._questions.on_outcome = reporter.outcome
        self._watchdog = watchdog
        self._on_status = on_status
        self._reload = reload
        self._clock = clock
        self._sleep = Sleep() if sleep is None else sleep
        self._deadlines = Deadlines()
        self._joints: JointReading | None = None
        self._watched: set[int] = set()
        """Descriptors of drivers and questions that the selector has."""
        self._max_age_ns = max_age_ns
        self._state = State.RUNNING
        now_ns = clock()
        self._overload = Overload(now_ns, live=self._tactile.live)
        self._last_t_ns = now_ns
        self._silence_due_ns = now_ns + self._silence_ns()
        self._status_due_ns = now_ns + STATUS_PERIOD_NS
        self._status_at_ns = now_ns
        self._readings_since_status = 0

    def run(self) -> Ended:
        """Run. Raises `DriverError` if the driver gives up; sends a last status in any case."""
        try:
            with selectors.SelectSelector() as selector:
                selector.register(self._stop, selectors.EVENT_READ)
                while self._stop.received is None:
                    if self._tactile.exhausted:
                        return Ended.EXHAUSTED
                    if self._stop.take_reload() and self._reload is not None and self._reload():
                        return Ended.RELOAD
                    if self._sleep.has_slept():  # before anything is repeated for who comes late
                        return self._wake()
                    self._go_round(selector)
            if self._tactile.fileno() is not None:
                self._take_readings()  # what had come before the signal
            return Ended.STOPPED
        finally:
            self._state = State.STOPPING
            self._send_status()

    def _go_round(self, selector: selectors.BaseSelector) -> None:
        # Now, and not when the descriptors say so: sending quietens them.
        if self._sockets is not None:
            self._sockets.take()
            self._take_questions()
        self._wait(selector)
        if not self._take_readings():
            self._mind_silence()
        if self._clock() >= self._status_due_ns:
            self._send_status()
        if self._watchdog is not None:
            self._watchdog.feed()

    def _wake(self) -> Ended:
        """Say that nothing is known, also to who waits for an answer."""
        payload = self._tell_silence(self._clock())
        if self._questions is not None:
            self._questions.answer(payload)
        return Ended.SLEPT

    def _wait(self, selector: selectors.BaseSelector) -> None:
        """Sleep until a driver, a timer or a signal wants attention."""
        wanted = {fd for driver in self._drivers if (fd := driver.fileno()) is not None}
        if self._sockets is not None:
            wanted.update(self._sockets.filenos())
        if wanted != self._watched:
            for former in self._watched - wanted:
                selector.unregister(former)
            for descriptor in wanted - self._watched:
                selector.register(descriptor, selectors.EVENT_READ)
            self._watched = wanted
        due_ns = min(self._silence_due_ns, self._status_due_ns)
        for timer in (*self._drivers, self._watchdog):
            timer_ns = None if timer is None else timer.due_ns()
            if timer_ns is not None and timer_ns < due_ns:
                due_ns = timer_ns
        now_ns = self._clock()
        if now_ns < due_ns and not selector.select(0):
            selector.select((due_ns - now_ns) / 1e9)
            self._overload.waited(self._clock())
        else:  # there is work already
            self._overload.rest(now_ns)

    def _take_readings(self) -> bool:
        """Judge and report what the drivers have; False if there was no tactile reading."""
        taken = False
        readings, waiting = self._read()
        received_ns = began_ns = self._clock()
        if readings and self._chore is not None:
            self._chore()
        skipped: list[TactileReading] = []
        for reading in readings:
            if isinstance(reading, JointReading):
                self._pipeline.turn(reading)
                self._joints = reading
                if self._on_joints is not None:
                    self._on_joints(reading)
                continue
            waiting -= 1
            if waiting and (skipped or self._is_too_much(waiting + 1, began_ns - received_ns)):
                skipped.append(reading)
                continue
            if skipped:
                reading = self._after(skipped, reading)
            self._reporter.tactile(reading, self._joints)
            judgement = self._pipeline.judge(reading)
            if self._sleep.has_slept():
                return taken  # it was read before
            verdict, payload = self._reporter.verdict(judgement, received_ns, self._silence_ns())
            self._deadlines.add(reading, verdict.age_ms, self._tactile.period_ns)
            self._state = State.RUNNING
            self._last_t_ns = reading.t_ns
            self._silence_due_ns = received_ns + self._silence_ns()
            self._readings_since_status += 1
            taken = True
            self._answer(verdict, payload)
            if judgement.judged and self._on_judged is not None:
                self._on_judged(judgement)
            if self._listener is not None:
                self._listener(verdict, payload, reading)
            judged_ns = self._clock()
            self._overload.judged(judged_ns - began_ns)
            began_ns = judged_ns
        if taken:
            self._pipeline.learn()  # what there is time for only now
        return taken

    def _read(self) -> tuple[list[Reading], int]:
        """What the drivers have, and how many are tactile; if that is too much, to the newest."""
        readings = [reading for driver in self._drivers for reading in driver.read_ready()]
        waiting = _tactile(readings)
        for _ in range(DRAINS_MAX if self._is_too_much(waiting) else 0):
            more = self._tactile.read_ready()
            if not more:
                break
            readings += more
            waiting += _tactile(more)
        return readings, waiting

    def _is_too_much(self, waiting: int, elapsed_ns: int = 0) -> bool:
        return self._overload.is_too_much(waiting, elapsed_ns, self._tactile.period_ns)

    def _after(self, skipped: Sequence[TactileReading], newest: TactileReading) -> TactileReading:
        """The newest reading, as it is to be judged after those that were left out."""
        self._overload.skip(len(skipped), self._clock())
        self._pipeline.skip()
        if self._on_skipped is not None:
            self._on_skipped()
        return after(skipped[-1], newest)

    def _take_questions(self) -> None:
        if self._questions is not None and self._questions.take(self._clock()):
            self._pipeline.ask()
            if self._on_asked is not None:
                self._on_asked()

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
        if now_ns >= self._silence_due_ns and not self._tactile.exhausted:
            self._tell_silence(now_ns)

    def _tell_silence(self, now_ns: int) -> bytes:
        self._state = State.SILENT
        self._silence_due_ns = now_ns + self._silence_ns()
        verdict, payload = self._reporter.verdict(
            self._pipeline.silence(self._last_t_ns), now_ns, self._silence_ns()
        )
        self._answer(verdict, payload)
        if self._listener is not None:
            self._listener(verdict, payload, None)
        return payload

    def _silence_ns(self) -> int:
        """How long nothing may come before it is said, ns."""
        return max(self._max_age_ns, SILENCE_PERIODS * (self._tactile.period_ns or 0))

    def _send_status(self) -> None:
        if self._chore is not None:
            self._chore()
        now_ns = self._clock()
        elapsed_s = max(now_ns - self._status_at_ns, 1) / 1e9
        status = self._reporter.status(
            self._state,
            self._readings_since_status / elapsed_s,
            self._counters(),
            self._pipeline,
            self._deadlines,
            skipped_readings=self._overload.skipped_readings,
            overloaded=self._overload.overloaded,
        )
        self._readings_since_status = 0
        self._status_at_ns = now_ns
        self._status_due_ns = now_ns + STATUS_PERIOD_NS
        if self._on_status is not None:
            self._on_status(status)

    def _counters(self) -> dict[str, dict[str, int]]:
        counters = {driver.name: driver.counters.as_dict() for driver in self._drivers}
        return counters if self._sockets is None else counters | self._sockets.counters()


def _tactile(readings: Sequence[Reading]) -> int:
    """How many of them are tactile."""
    return sum(isinstance(reading, TactileReading) for reading in readings)
