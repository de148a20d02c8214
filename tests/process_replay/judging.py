"""Run the daemon's loop over a stream on a simulated clock, and collect its messages."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import closing
from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path
from typing import Any, Final

from graspd.daemon import scene
from graspd.daemon.assembly import assembly
from graspd.daemon.assembly.parts import header_now, header_of
from graspd.daemon.assembly.plan import Plan
from graspd.daemon.judge.pipeline import Pipeline
from graspd.daemon.process.signals import StopSignal
from graspd.daemon.publish.companion import Companion, PublishedVerdict, Reply, Requests
from graspd.daemon.publish.outbox import Outbox
from graspd.daemon.record.mcap import RecordingHeader
from graspd.daemon.record.recorder import Recorder
from graspd.daemon.run.loop import Loop, LoopTiming
from graspd.daemon.scene import Scene
from graspd.daemon.scene.scene import Record
from graspd.daemon.trust.lift_book import GraspId, Report
from graspd.drivers.base import Reading
from tests.kit.clock import Clock
from tests.kit.loops import ClockSelector, TimedDriver
from tests.process_replay.streams import FINGERS, START_NS

BOOT_ID: Final = "0123456789abcdef" * 2
ASKED_EVERY: Final = 40
"""Number of verdicts from one question of the controller to the next."""
SLOW_NS, SLOW_FOR, SLOW_EVERY = 15_000_000, 260, 600
"""In a slow case the first 260 verdicts of each 600 take 15 ms. Readings are skipped, for long
enough to be an overload."""
STALL_NS, STALL_AT = 160_000_000, 500
"""In a slow case one verdict of each 600 takes 160 ms. The next readings are too old."""

Message = tuple[str, str]
"""Kind of a message, such as `verdict`, and its payload."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Case:
    """A stream of readings, and the scene and controller with which it is judged."""

    readings: Callable[[], Iterator[Reading]]
    sections: Mapping[str, Any] = field(default_factory=dict)
    """Sections of the scene that are added to the usual ones, or replace them."""
    readings_max: int | None = None
    joints: bool = False
    asks: bool = False
    """True if the controller asks for a judgement every `ASKED_EVERY` verdicts."""
    tells: bool = False
    """True if the controller lifts each judged grasp, and reports how that ended."""
    slow: bool = False
    """True if judging is slower than the sensors at times; then readings are skipped."""


def run(case: Case, record_in: Path | None = None) -> list[Message]:
    """Run a case; return all its messages. `record_in`: folder for a recording; None: without.

    Here alone in process replay a loop and its parts are built.
    """
    clock, wanted = Clock(START_NS), _scene(case)
    model = assembly.load_model(wanted)
    pipeline = assembly.build_pipeline(Plan.of(wanted), model, clock)
    pipeline.boot_id = BOOT_ID
    world = _World(case, clock)
    outputs: list[Any] = [world]
    if record_in is not None:
        outputs.append(
            _recorder(record_in, clock, pipeline, header_of(Plan.of(wanted), model, BOOT_ID))
        )
    outbox = Outbox(
        wanted.hand.name,
        wanted.hand.fingers,
        model.contract.name,
        model.sha256,
        outputs,
        clock,
        lambda: clock() / 1e9,
        boot_id=BOOT_ID,
    )
    driver = TimedDriver(islice(case.readings(), case.readings_max), clock, live=case.slow)
    driver.name = "stream"
    timing = LoopTiming(
        wanted.max_age_ns,
        clock,
        rest=lambda _seconds: None,
        selector=lambda: ClockSelector(clock),
    )
    with (
        StopSignal() as stop,
        closing(Loop([driver], pipeline, outbox, stop, outputs, timing)) as loop,
    ):
        loop.run()
    for recorder in outputs[1:]:
        recorder.close()
    for thread in threading.enumerate():
        if thread.name == "recorder":
            thread.join()  # `close` does not wait long enough for a slow computer
    return world.messages


def _recorder(folder: Path, clock: Clock, pipeline: Pipeline, header: RecordingHeader) -> Recorder:
    return Recorder(
        Record(directory=folder),
        "right",
        BOOT_ID,
        take_header=lambda: header_now(pipeline, header),
        clock=clock,
        wall_clock=clock,
    )


def _scene(case: Case) -> Scene:
    sections: dict[str, Any] = {
        "hand": {"fingers": FINGERS},
        "tactile": {"driver": "palm", "source": "udp://127.0.0.1:9870"},
    }
    if case.joints:
        sections["joints"] = {"driver": "stream", "source": "udp://127.0.0.1:9871"}
    return scene.parse({**sections, **case.sections}, Path("process replay"))


class _World(Companion):
    """The loop's surroundings: collects messages, asks, reports outcomes, slows the computer."""

    def __init__(self, case: Case, clock: Clock) -> None:
        self.messages: list[Message] = []
        self._case = case
        self._clock = clock
        self._verdicts = 0
        self._asking = False
        self._lifted = 0
        """Number of the grasp that is lifted, or 0."""
        self._over: list[int] = []
        """Grasps whose lift has ended without being told yet."""

    def send(self, topic: bytes, payload: bytes) -> None:
        self.messages.append((topic.decode().partition(".")[0], payload.decode()))

    def wanted(self, _topic: bytes) -> bool:
        return self._verdicts == 0

    def on_verdict(self, published: PublishedVerdict) -> None:
        verdict = published.verdict
        self._verdicts += 1
        self._asking = self._case.asks and self._verdicts % ASKED_EVERY == 0
        if self._lifted not in (0, verdict.grasp):
            self._over.append(self._lifted)
            self._lifted = 0
        if verdict.judged and self._case.tells:
            self._lifted = verdict.grasp
        if self._case.slow and published.reading is not None:
            phase = self._verdicts % SLOW_EVERY
            self._clock.now_ns += SLOW_NS if phase < SLOW_FOR else 0
            self._clock.now_ns += STALL_NS if phase == STALL_AT else 0

    def before_wait(self, requests: Requests) -> None:
        if self._asking:
            requests.ask()
            self._asking = False
        for grasp in self._over:
            self._tell(requests, BOOT_ID, grasp)
            if grasp % 5 == 0:
                self._tell(requests, BOOT_ID, grasp, turned=True)
                self._tell(requests, "f" * 32, grasp)
        self._over.clear()

    def _tell(self, requests: Requests, boot_id: str, grasp: int, *, turned: bool = False) -> None:
        slipped = (grasp % 3 == 0) != turned
        object_name = "cup" if grasp % 2 else None
        report = Report(GraspId(boot_id, grasp), "slip" if slipped else "stable", object_name)

        def answer(reply: Reply) -> None:
            why = f"{reply.told}: {reply.detail}" if reply.detail else None
            self.messages.append(("answer", f"{grasp}: {why}"))

        requests.outcome(report, answer)
