"""Running a scene file until told to stop, and taking it anew when told to."""

from __future__ import annotations

import logging
import time
import uuid
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

from daemon import scene
from daemon.assembly import assembly
from daemon.judge.pipeline import Pipeline
from daemon.process.signals import StopSignal
from daemon.publish.binding import PublishError
from daemon.publish.messages import Status
from daemon.publish.outbox import Reporter
from daemon.publish.sockets import Sockets, plan
from daemon.run.loop import Ended, Service, Watchdog
from drivers.base import Driver, DriverError, RecordingError
from models.contract import ModelError
from models.runtime import TactileModel

if TYPE_CHECKING:
    from daemon.record.raw import Tap
    from daemon.record.recorder import Recorded, Recorder
    from daemon.run.printer import Printer
    from daemon.run.realtime import Hot

log = logging.getLogger("graspd")

AWAKE_RETRY_S, AWAKE_LOOK_S = 1.0, 0.1
"""After a sleep, between two tries to open what is not there yet, and to look for signals, s."""


class Manager(Watchdog, Protocol):
    """Who started the daemon and looks after it: systemd."""

    def ready(self, what: str) -> None:
        """Model and drivers are there."""

    def reloading(self) -> None:
        """The scene is read again; `ready` follows."""

    def status(self, status: Status) -> None:
        """How it goes."""


@dataclass(frozen=True, slots=True, eq=False)
class Parts:
    """A scene and what it needs, nothing of it open yet."""

    scene: scene.Scene
    model: TactileModel
    pipeline: Pipeline
    drivers: list[Driver]


def prepare(path: Path) -> Parts:
    """Read a scene, load its model and warm it.

    Raises `SceneError`, `ModelError` or `RecordingError`.
    """
    wanted = scene.load(path)
    return _built(wanted, assembly.load_model(wanted))


def _built(wanted: scene.Scene, model: TactileModel) -> Parts:
    pipeline = assembly.build_pipeline(wanted, model, learns=wanted.session_learns)
    return Parts(wanted, model, pipeline, assembly.build_drivers(wanted))


class Runner:
    """Runs what a scene file says."""

    def __init__(
        self,
        path: Path,
        stop: StopSignal,
        *,
        printer: Printer | None = None,
        manager: Manager | None = None,
    ) -> None:
        self._path = path
        self._stop = stop
        self._printer = printer
        self._manager = manager
        self._sockets: Sockets | None = None
        self._next: Parts | None = None
        self._running = False

    def run(self) -> None:
        """Run until stopped or until a recording ends.

        Raises `SceneError`, `ModelError`, `RecordingError`, `PublishError` or `DriverError`; at a
        reload it logs them, and what ran before goes on.
        """
        try:
            self._run(prepare(self._path))
        finally:
            if self._sockets is not None:
                self._sockets.close()
        if self._printer is not None:
            self._printer.summary()

    def _run(self, parts: Parts) -> None:
        former: Parts | None = None
        woken = False
        while True:
            self._running = False
            try:
                if woken:
                    parts = _built(parts.scene, parts.model)
                ended = self._work(parts)
            except (scene.SceneError, ModelError, PublishError, DriverError) as error:
                if self._running or (former is None and not woken):
                    raise
                if former is not None:
                    self._refuse(error)
                    parts, former = former, None
                elif not self._waits_for_the_rest(error):
                    return
                continue
            woken = ended is Ended.SLEPT
            if woken:
                log.warning("the computer has slept: everything starts anew")
                former = None
            elif ended is Ended.RELOAD and self._next is not None:
                parts, former = self._next, parts
            else:
                return

    def _waits_for_the_rest(self, error: Exception) -> bool:
        """Networks and disks may wake later than we do; whether to try again then."""
        log.warning("%s; another try in %g s", error, AWAKE_RETRY_S)
        until_s = time.monotonic() + AWAKE_RETRY_S
        while self._stop.received is None and time.monotonic() < until_s:
            if self._manager is not None:
                self._manager.feed()
            time.sleep(AWAKE_LOOK_S)
        return self._stop.received is None

    def _open_sockets(self, wanted: scene.Scene) -> Sockets:
        """Those that are open, if the scene wants the same ones."""
        if self._sockets is not None and self._sockets.plan == plan(wanted):
            return self._sockets
        if self._sockets is not None:
            self._sockets.close()
            self._sockets = None
        self._sockets = Sockets(wanted)
        return self._sockets

    def _work(self, parts: Parts) -> Ended:
        """Open everything and go round until something ends it."""
        wanted = parts.scene
        with ExitStack() as stack:
            sockets = self._open_sockets(wanted)
            tap = _tap(parts)
            for driver in parts.drivers:
                stack.callback(driver.close)
                assembly.open_driver(driver)
            kept = assembly.build_keeper(wanted, parts.pipeline, parts.drivers[0], stack)
            if kept is not None:
                stack.callback(kept.save)
            hot = self._hot(parts, stack)
            boot_id = uuid.uuid4().hex
            recorder = self._recorder(parts, boot_id, tap, stack)
            output: Sockets | Recorded = sockets
            if recorder is not None:
                from daemon.record.recorder import Recorded

                output = Recorded(sockets, recorder)
            reporter = Reporter(
                wanted.hand.name,
                wanted.hand.fingers,
                parts.model.contract.name,
                parts.model.sha256,
                output,
                boot_id=boot_id,
            )
            service = Service(
                parts.drivers,
                parts.pipeline,
                reporter,
                self._stop,
                max_age_ns=wanted.max_age_ns,
                listener=None if self._printer is None else self._printer.verdict,
                chore=None if kept is None else kept.mind,
                on_joints=None if recorder is None else recorder.joints,
                on_asked=None if recorder is None else recorder.asked,
                sockets=output,
                watchdog=self._manager,
                on_status=self._on_status(sockets, hot),
                reload=self._reload,
            )
            self._running = True
            _announce(wanted)
            if self._manager is not None:
                self._manager.ready(f"ready: {wanted.tactile.driver}, {parts.model.contract.name}")
            try:
                return service.run()
            finally:
                sockets.publisher.forget()

    def _recorder(
        self, parts: Parts, boot_id: str, tap: Tap | None, stack: ExitStack
    ) -> Recorder | None:
        """Who records; None if the scene wants nobody to. Imported only where it does."""
        if parts.scene.record is None:
            return None
        from daemon.assembly.recorder import build_recorder

        recorder = build_recorder(parts.scene, parts.model, parts.pipeline, boot_id, tap)
        if recorder is not None:
            stack.callback(recorder.close)
        return recorder

    def _on_status(self, sockets: Sockets, hot: Hot | None) -> Callable[[Status], None]:
        """What there is time for once a second."""

        def once_a_second(status: Status) -> None:
            if self._manager is not None:
                self._manager.status(status)
            sockets.mind_keys()
            if hot is not None:
                hot.tidy()

        return once_a_second

    def _hot(self, parts: Parts, stack: ExitStack) -> Hot | None:
        """Realtime, rehearsed; None if the scene wants none. Imported only where it does."""
        if parts.scene.realtime is None:
            return None
        from daemon.run.realtime import Hot
        from daemon.run.rehearsal import rehearse

        # With a model of its own: how a model's inputs are scaled follows who judges with it.
        try:
            model = assembly.load_model(parts.scene)
            rehearse(
                lambda clock: assembly.build_pipeline(parts.scene, model, clock),
                model.contract.seen,
            )
        except ModelError as error:  # the file has changed since; the one in memory is sound
            log.warning("no rehearsal: %s", error)
        return stack.enter_context(Hot(parts.scene.realtime))

    def _reload(self) -> bool:
        """Prepare what the scene file says now; whether that is fine."""
        if self._manager is not None:
            self._manager.reloading()
        try:
            self._next = prepare(self._path)
        except (scene.SceneError, ModelError, RecordingError) as error:
            self._refuse(error)
            if self._manager is not None:
                self._manager.ready("the new scene is wrong, the former one goes on")
            return False
        log.info("%s: taken anew", self._path)
        return True

    def _refuse(self, error: Exception) -> None:
        for line in str(error).splitlines():
            log.error("%s", line)
        log.error("%s: not taken anew, the former scene goes on", self._path)


def _tap(parts: Parts) -> Tap | None:
    """What holds all that comes over the link from its opening on; None if the scene wants none."""
    record = parts.scene.record
    if record is None or not record.raw:
        return None
    from daemon.record.raw import tap_of

    return tap_of(parts.drivers[0], parts.scene.tactile)


def _announce(wanted: scene.Scene) -> None:
    """Say where everything is."""
    log.info("verdict.%s on %s", wanted.hand.name, wanted.endpoint)
    if wanted.ask_endpoint is not None:
        log.info("questions on %s", wanted.ask_endpoint)
