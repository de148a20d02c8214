"""Run a scene file until told to stop."""

from __future__ import annotations

import logging
import time
from collections import Counter
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from graspd.daemon import scene
from graspd.daemon.assembly import assembly
from graspd.daemon.assembly.parts import Assembly, Parts
from graspd.daemon.judge.reasons import Decision
from graspd.daemon.process.signals import StopSignal
from graspd.daemon.publish.companion import Companion, PublishedVerdict
from graspd.daemon.publish.listener import PublishError
from graspd.daemon.publish.sockets import Sockets, plan
from graspd.daemon.run.loop import Ended, Loop, LoopTiming
from graspd.daemon.run.reload import Reload, losses, start_again
from graspd.daemon.scene.drivers import ReplayTactile
from graspd.drivers.base import DriverError
from graspd.models.contract import ModelError

if TYPE_CHECKING:
    from graspd.daemon.run.realtime import RealtimeMode
    from graspd.daemon.run.replaying import Controller
    from graspd.daemon.run.summary import Printer
    from graspd.daemon.run.systemd import Systemd

log = logging.getLogger("graspd")

AWAKE_RETRY_S, AWAKE_LOOK_S = 1.0, 0.1
"""After a sleep: time, s, between two tries to open everything, and between looks at signals."""


def prepare(path: Path) -> Parts:
    """Read a scene and load its model; with `[realtime]` rehearse. Raises as `Parts.of`."""
    loaded = scene.load(path)
    parts = Parts.of(loaded, assembly.load_model(loaded))
    if loaded.realtime is not None:
        from graspd.daemon.run.rehearsal import rehearse  # only where a scene wants realtime

        try:
            rehearse(loaded)
        except ModelError as error:  # the file has changed; the model in memory is good
            log.warning("no rehearsal: %s", error)
    return parts


def enter_realtime(running: scene.Scene, stack: ExitStack) -> RealtimeMode | None:
    """Enter realtime mode until `stack` closes; None without `[realtime]`."""
    if running.realtime is None:
        return None
    from graspd.daemon.run.realtime import RealtimeMode  # only where a scene wants realtime

    return stack.enter_context(RealtimeMode(running.realtime))


def _controller(wanted: scene.Scene) -> Controller | None:
    """Return what tells recorded outcomes, if the scene wants it."""
    if not isinstance(wanted.tactile, ReplayTactile) or not wanted.tactile.outcomes:
        return None
    from graspd.daemon.run.replaying import Controller  # only where a scene wants it

    return Controller(only_lifted=True)


class RunLog(Companion):
    """Log one line at the end of a run: how long it was, what was judged, why it ended."""

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


class Runner:
    """Runs a scene file; SIGHUP reloads it."""

    def __init__(
        self,
        path: Path,
        stop: StopSignal,
        *,
        printer: Printer | None = None,
        manager: Systemd | None = None,
    ) -> None:
        """`manager`: the service manager, if it started this process."""
        self._path = path
        self._stop = stop
        self._printer = printer
        self._manager = manager
        self._sockets: Sockets | None = None
        began = (lambda: None) if manager is None else manager.reloading
        self._reload = Reload(stop, partial(prepare, path), began)
        self._running = False
        self._former: Parts | None = None
        """Parts of the scene before a reload, until the new scene runs."""
        self._latest: Parts | None = None
        """Parts of the scene that ran last."""
        self._keeps_session = False
        """True if those keep outcomes and session in a file."""
        self._log = RunLog()

    def run(self) -> None:
        """Run until stopped or until a recording ends. Errors of a reload are only logged.

        Raises `SceneError`, `ModelError`, `RecordingError`, `PublishError` or `DriverError`.
        """
        cause = "an error"
        try:
            self._run(prepare(self._path))
            received = self._stop.received
            cause = "the end of the recording" if received is None else received.name
        finally:
            self._reload.close()
            if self._sockets is not None:
                self._sockets.close()
            if self._latest is not None:
                self._log.write(cause)
        if self._printer is not None and self._latest is not None:
            self._printer.summary(self._latest.pipeline.trust)

    def _run(self, parts: Parts) -> None:
        woken = False
        while True:
            self._running = False
            try:
                if woken:
                    slept, parts = parts, Parts.of(parts.scene, parts.model)
                    parts.pipeline.lifts.follow(slept.pipeline.lifts)
                ended, following = self._work(parts)
            except Exception as error:
                if self._running or (self._former is None and not (woken and _is_told(error))):
                    raise
                if self._former is not None:
                    self._refuse(error)
                    parts, self._former = self._former, None
                    for loss in losses(parts.pipeline, kept=True):
                        log.warning("%s", loss)
                    start_again(parts.pipeline)
                elif not self._waits_for_the_rest(error):
                    return
                continue
            woken = ended is Ended.SLEPT
            if woken:
                log.warning("the computer has slept: starting again")
            elif following is not None:
                following.pipeline.lifts.follow(parts.pipeline.lifts)
                parts, self._former = following, parts
            else:
                return

    def _waits_for_the_rest(self, error: Exception) -> bool:
        """Wait for networks and disks that wake later; return False if asked to stop."""
        log.warning("%s; another try in %g s", error, AWAKE_RETRY_S)
        until_s = time.monotonic() + AWAKE_RETRY_S
        while not self._stop.wait(AWAKE_LOOK_S) and time.monotonic() < until_s:
            if self._manager is not None:
                self._manager.after_round()
        return self._stop.received is None

    def _open_sockets(self, served: scene.Scene) -> Sockets:
        """Open the sockets of a scene; keep the open ones if they are the same."""
        if self._sockets is not None and self._sockets.plan == plan(served):
            return self._sockets
        if self._sockets is not None:
            self._sockets.close()
            self._sockets = None
        self._sockets = Sockets(served)
        return self._sockets

    def _work(self, parts: Parts) -> tuple[Ended, Parts | None]:
        """Run one scene until its end; return the reason, and after a reload the next scene."""
        running = parts.scene
        with ExitStack() as stack:
            around = Assembly(parts, stack)
            sockets = self._open_sockets(running)
            around.add_sockets(sockets)
            around.open_drivers()
            keeps_session = around.keep_session()
            realtime = enter_realtime(running, stack)
            around.record()
            controller = _controller(running)
            self._note_training(parts)
            companions = [
                *(self._reload, self._manager, self._log, *around.companions),
                *(self._printer, realtime, controller),
            ]
            loop = Loop(
                parts.drivers,
                parts.pipeline,
                around.build_outbox(),
                self._reload,
                [companion for companion in companions if companion is not None],
                LoopTiming(running.max_age_ns),
                around.keep,
            )
            stack.callback(loop.close)
            self._running, self._former = True, None
            self._take_over(parts, keeps_session=keeps_session)
            log.info("verdict.%s on %s", running.hand.name, running.endpoint)
            if running.ask_endpoint is not None:
                log.info("questions on %s", running.ask_endpoint)
            if self._manager is not None:
                self._manager.ready(f"ready: {running.tactile.driver}, {parts.model.contract.name}")
            following: Parts | None = None
            ended = loop.run()
            while ended is Ended.RELOAD and (following := self._taken()) is None:
                ended = loop.run()
            return ended, following

    def _note_training(self, parts: Parts) -> None:
        """Have the summary say which recordings the model was trained on."""
        played = parts.scene.tactile
        if self._printer is None or not isinstance(played, ReplayTactile):
            return
        from graspd.daemon.run.replaying import trained_on  # only where recordings are scored

        self._printer.result.trained_on = trained_on(played.recordings, parts.model)

    def _take_over(self, parts: Parts, *, keeps_session: bool) -> None:
        """Note that these parts run now; log what those before knew and these do not."""
        if self._latest is not None and self._latest is not parts:
            for loss in losses(self._latest.pipeline, kept=self._keeps_session):
                log.warning("%s", loss)
        self._latest, self._keeps_session = parts, keeps_session

    def _taken(self) -> Parts | None:
        """Return the prepared scene; None, with an error in the log, if it is wrong."""
        prepared = self._reload.take()
        if isinstance(prepared, Parts):
            log.info("%s: reloaded", self._path)
            return prepared
        self._refuse(prepared)
        if self._manager is not None:
            self._manager.ready("the new scene is wrong, the former one goes on")
        return None

    def _refuse(self, error: Exception) -> None:
        said = str(error) if _is_told(error) else f"{type(error).__name__}: {error}"
        for line in said.splitlines():
            log.error("%s", line)
        log.error("%s: not reloaded, the former scene goes on", self._path)


def _is_told(error: Exception) -> bool:
    """Return True if the text of the error says what to mend; False for a bug of graspd."""
    return isinstance(error, scene.SceneError | ModelError | PublishError | DriverError)
