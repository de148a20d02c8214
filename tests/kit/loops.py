"""The daemon's loop on a clock of the test, with a fake driver, model, outputs and waits."""

from __future__ import annotations

import selectors
from collections.abc import Callable, Iterable, Sequence
from contextlib import closing, nullcontext

from graspd.daemon.judge.decision import HandLimits
from graspd.daemon.process.signals import StopSignal
from graspd.daemon.process.sleep import Sleep
from graspd.daemon.publish.companion import Answer, Companion, PublishedVerdict, at_once
from graspd.daemon.publish.messages import Status, Verdict
from graspd.daemon.publish.outbox import Outbox
from graspd.daemon.run.loop import Ended, Loop, LoopTiming
from graspd.daemon.trust.trust import Trust
from graspd.drivers.base import Reading, TactileReading
from tests.daemon.fakes import FINGERS, MS, Clock, FakeDriver, FakeModel, pipeline
from tests.kit.messages import decode_status


class SentMessages:
    """Output of an `Outbox` that keeps the messages."""

    def __init__(self) -> None:
        self.sent: list[tuple[bytes, bytes]] = []
        self.wants_tactile = False

    def send(self, topic: bytes, payload: bytes) -> None:
        self.sent.append((topic, payload))

    def wanted(self, _topic: bytes) -> bool:
        return self.wants_tactile

    @property
    def topics(self) -> list[bytes]:
        return [topic for topic, _ in self.sent]

    def statuses(self) -> list[Status]:
        return [decode_status(payload) for topic, payload in self.sent if topic == b"status.right"]


class ClockSelector(selectors.SelectSelector):
    """Selector that moves the clock by the timeout instead of waiting; nothing is ever ready."""

    def __init__(self, clock: Clock) -> None:
        super().__init__()
        self.clock = clock

    def select(self, timeout: float | None = None) -> list[tuple[selectors.SelectorKey, int]]:
        self.clock.now_ns += round((timeout or 0.0) * 1e9)
        return []


class TimedDriver(FakeDriver):
    """Driver that hands over the readings due by its clock, at most `at_once` per call."""

    def __init__(
        self,
        readings: Iterable[Reading],
        clock: Clock,
        *,
        live: bool = True,
        at_once: int = 1000,
    ) -> None:
        super().__init__([], clock)
        self.live = live
        self.at_once = at_once
        self.calls = 0
        self._readings = iter(readings)
        self._next = next(self._readings, None)

    @property
    def exhausted(self) -> bool:
        return self._next is None

    def due_ns(self) -> int | None:
        return None if self._next is None else self._next.t_ns

    def read_ready(self) -> Sequence[Reading]:
        self.calls += 1
        ready: list[Reading] = []
        while self._next and self._next.t_ns <= self.clock() and len(ready) < self.at_once:
            ready.append(self._next)
            self.counters.readings += isinstance(self._next, TactileReading)
            self._next = next(self._readings, None)
        return ready


class LoopBench(Companion):
    """A loop, and the messages, verdicts and times that it has produced."""

    def __init__(
        self,
        driver: FakeDriver,
        clock: Clock,
        *,
        stop: StopSignal | None = None,
        model: FakeModel | None = None,
        companions: Sequence[Companion] = (),
        boot_id: str | None = None,
        trust: Trust | None = None,
        keep: Callable[[Answer], None] = at_once,
        hand: HandLimits | None = None,
        max_age_ms: int = 100,
        sleep: Sleep | None = None,
        timing: LoopTiming | None = None,
        cost_ns: Callable[[], int] | None = None,
    ) -> None:
        """`stop` None: the bench has one of its own, which `run` closes. `keep`: calls its
        argument once all outcomes are on the disk. `timing` None: of `max_age_ms` and `sleep`.

        With `cost_ns`, which replaces `timing` and `sleep`, the clock moves only in waits, and at
        each verdict by its result, ns.
        """
        self.driver = driver
        self.clock = clock
        self.output = SentMessages()
        self.verdicts: list[Verdict] = []
        self.payloads: list[bytes] = []
        self.judged: list[tuple[Verdict, TactileReading]] = []
        self.rests_s: list[float] = []
        self.rounds_ns: list[int] = []
        """Time at the end of each round."""
        self._cost_ns = cost_ns
        self._stop = StopSignal() if stop is None else stop
        self._owns_stop = stop is None
        self.pipeline = pipeline(
            model or FakeModel(), clock, hand=hand, trust=trust, max_age_ns=max_age_ms * MS
        )
        self.pipeline.boot_id = boot_id or ""
        if timing is None:
            timing = LoopTiming(max_age_ms * MS, clock, Sleep() if sleep is None else sleep)
        if cost_ns is not None:
            timing = LoopTiming(
                max_age_ms * MS, clock, rest=self._rest, selector=lambda: ClockSelector(clock)
            )
        outputs = [self.output]
        self.loop = Loop(
            [driver],
            self.pipeline,
            Outbox(
                "right", FINGERS, "fake", "ab" * 32, outputs, clock, lambda: 5.0, boot_id=boot_id
            ),
            self._stop,
            [self, *companions],
            timing,
            keep,
        )

    def run(self) -> Ended:
        """Run the loop to its end; return why it ended."""
        with closing(self.loop), self._stop if self._owns_stop else nullcontext():
            return self.loop.run()

    @property
    def statuses(self) -> list[Status]:
        return self.output.statuses()

    def on_verdict(self, published: PublishedVerdict) -> None:
        if self._cost_ns is not None:
            self.clock.now_ns += self._cost_ns()
        self.verdicts.append(published.verdict)
        self.payloads.append(published.payload)
        if published.reading is not None:
            self.judged.append((published.verdict, published.reading))

    def after_round(self) -> None:
        self.rounds_ns.append(self.clock())

    def _rest(self, seconds: float) -> None:
        self.rests_s.append(seconds)
        self.clock.now_ns += round(seconds * 1e9)
