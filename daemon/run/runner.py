"""Run a scene file."""

from __future__ import annotations

import logging
import time
from collections import Counter
from contextlib import ExitStack, closing
from pathlib import Path
from typing import TYPE_CHECKING

from graspd.daemon import scene
from graspd.daemon.assembly import assembly
from graspd.daemon.assembly.parts import Assembly, Parts
from graspd.daemon.assembly.plan import Plan
from graspd.daemon.judge.reasons import Decision
from graspd.daemon.process.signals import StopSignal
from graspd.daemon.publish.companion import Companion, PublishedVerdict
from graspd.daemon.run.loop import Ended, Loop, LoopTiming
from graspd.daemon.scene.drivers import ReplayTactile
from graspd.models.contract import ModelError

if TYPE_CHECKING:
    from graspd.daemon.run.realtime import RealtimeMode
    from graspd.daemon.run.replaying import Controller
    from graspd.daemon.run.systemd import Systemd

log = logging.getLogger("graspd")


def prepare(path: Path) -> Parts:
    """Read a scene and load its model; with `[realtime]` also judge a synthetic grasp.

    Raises `SceneError`, `ModelError` or `RecordingError`.
    """
    loaded = scene.load(path)
    model = assembly.load_model(loaded)
    parts = Parts.of(Plan.of(loaded), model)
    for warning in assembly.keep_digest(parts.model):
        log.warning("%s", warning)
    if loaded.realtime is not None:
        from graspd.daemon.run.rehearsal import rehearse  # only where a scene wants realtime

        try:
            rehearse(parts.plan)
        except ModelError as error:  # only the file has changed: the model in memory is good
            log.warning("no rehearsal: %s", error)
    return parts


def enter_realtime(running: scene.Scene, stack: ExitStack) -> RealtimeMode | None:
    """Enter realtime mode until `stack` closes, and return it; None without `[realtime]`."""
    if running.realtime is None:
        return None
    from graspd.daemon.run.realtime import RealtimeMode  # only where a scene wants realtime

    return stack.enter_context(RealtimeMode(running.realtime))


def _controller(wanted: scene.Scene) -> Controller | None:
    """Return the controller that reports recorded outcomes; None without `tactile.outcomes`."""
    if not isinstance(wanted.tactile, ReplayTactile) or not wanted.tactile.outcomes:
        return None
    from graspd.daemon.run.replaying import Controller  # imported only if it is used

    return Controller(only_lifted=True)


class RunLog(Companion):
    """Logs one line at the end of a run: its duration, its judgements, and why it ended."""

    def __init__(self) -> None:
        self._start_s = time.monotonic()
        self._readings = 0
        self._judgements: Counter[Decision] = Counter()

    def on_verdict(self, published: PublishedVerdict) -> None:
        """Count a verdict. With a gate only those that judge a grasp are judgements."""
        verdict = published.verdict
        self._readings += published.reading is not None
        if verdict.gate is None or verdict.judged:
            self._judgements[verdict.verdict] += 1

    def write(self, cause: str) -> None:
        """Log the line. `cause`: what ended the run."""
        counts = ", ".join(f"{self._judgements[decision]} {decision}" for decision in Decision)
        log.info(
            "ended by %s after %.1f s: %d readings, %d judgements: %s",
            cause,
            time.monotonic() - self._start_s,
            self._readings,
            self._judgements.total(),
            counts,
        )


def run_scene(path: Path, stop: StopSignal, *, manager: Systemd | None = None) -> Ended:
    """Run a scene file until something ends the loop; return the cause.

    `manager`: the service manager, if it started this process. Raises `SceneError`, `ModelError`,
    `RecordingError`, `PublishError` or `DriverError`.
    """
    with closing(Runner(prepare(path), stop, manager=manager)) as runner:
        runner.open()
        return runner.run()


class Runner:
    """One run of prepared parts: `open`, `run` and `close`, each called once."""

    def __init__(self, parts: Parts, stop: StopSignal, *, manager: Systemd | None = None) -> None:
        self._parts = parts
        self._stop = stop
        self._manager = manager
        self._stack = ExitStack()
        self._log = RunLog()
        self._loop: Loop | None = None

    def open(self) -> None:
        """Open sockets, drivers, session and recording; tell the manager that graspd is ready.

        Raises `SceneError`, `PublishError` or `DriverError`; `close` closes what is open then.
        """
        parts, stack = self._parts, self._stack
        running = parts.scene
        around = Assembly(parts, stack)
        around.open_sockets()
        around.open_drivers()
        around.keep_session()
        realtime = enter_realtime(running, stack)
        around.record()
        controller = _controller(running)
        companions = [
            *(self._manager, self._log, *around.companions),
            *(realtime, controller),
        ]
        self._loop = Loop(
            parts.drivers,
            parts.pipeline,
            around.build_outbox(),
            self._stop,
            [companion for companion in companions if companion is not None],
            LoopTiming(running.max_age_ns),
            around.keep,
        )
        stack.callback(self._loop.close)
        if controller is not None:
            stack.callback(controller.tell)
        log.info("verdict.%s on %s", running.hand.name, running.endpoint)
        if running.ask_endpoint is not None:
            log.info("questions on %s", running.ask_endpoint)
        if self._manager is not None:
            self._manager.ready(f"ready: {running.tactile.driver}, {parts.model.contract.name}")

    def run(self) -> Ended:
        """Run the loop until something ends it; log and return the cause."""
        if self._loop is None:
            raise RuntimeError("the parts are not open")
        cause = "an error"
        try:
            ended = self._loop.run()
            received = self._stop.received
            cause = ended.value if received is None else received.name
        finally:
            self._log.write(cause)
        return ended

    def close(self) -> None:
        """Publish the last status, save the session and close everything."""
        self._stack.close()
