"""Keeps the session of a running daemon in a file, and begins a new one for other sensors."""

from __future__ import annotations

import contextlib
import logging
import os
import threading
import time
from collections.abc import Callable, Sequence

from daemon.judge.calibration import SessionCalibration
from daemon.publish.companion import Companion
from daemon.session.file import SessionFile, SessionFileError, exchanged, statistics_of
from drivers.base import Driver
from models.session_statistics import SessionState

log = logging.getLogger("graspd")

WAIT_S = 0.4
"""How long the end waits for the disk, s: the daemon is given a second to stop."""
SAVE_PERIOD_NS = 10_000_000_000
"""Between two saves, ns: a power cut costs the grasps of ten seconds."""


class SessionKeeper(Companion):
    """Restores, saves and drops one session; a file that fails costs a warning, not the run."""

    def __init__(
        self,
        session: SessionCalibration,
        fingers: Sequence[str],
        tactile: Driver,
        file: SessionFile,
        clock: Callable[[], int] = time.monotonic_ns,
        on_exchange: Callable[[], None] | None = None,
    ) -> None:
        """Restore what `file` holds; if that is no session of these fingers, warn and begin anew.

        `tactile` knows the serial numbers of the sensors. `on_exchange` is called when one of them
        is another than before, and must reset the session; unless given, only that is done.
        """
        self._session = session
        self._on_exchange = on_exchange or session.reset
        self._fingers = tuple(fingers)
        self._tactile = tactile
        self._file = file
        self._clock = clock
        self._serials: dict[str, str] = {}
        self._restore()
        self._saved = self._what_is_known()
        self._save_due_ns = clock() + SAVE_PERIOD_NS
        self._warned = False
        self._thread: threading.Thread | None = None

    def before_readings(self) -> None:
        """Drop the session if a sensor has been exchanged; save it if it is time."""
        self._check_serials()
        if self._clock() >= self._save_due_ns and not self._saving():
            self._begin_to_save()

    def save(self) -> None:
        """Save now if there is anything new; a failure is one warning."""
        self.wait()
        self._begin_to_save()
        self.wait()

    def wait(self) -> None:
        """Wait until saving has ended, for `WAIT_S` at most."""
        if self._thread is not None:
            self._thread.join(WAIT_S)
            self._thread = None

    def _saving(self) -> bool:
        return self._thread is not None and self._thread.is_alive()

    def _begin_to_save(self) -> None:
        """In a thread: a disk may take its time, and readings do not wait."""
        self._save_due_ns = self._clock() + SAVE_PERIOD_NS
        known = self._what_is_known()
        if known == self._saved:
            return
        what = (self._session.state(), dict(self._serials), known)
        self._thread = threading.Thread(target=self._write, args=what, name="session", daemon=True)
        self._thread.start()

    def _write(
        self, state: SessionState, serials: dict[str, str], known: tuple[int, dict[str, str]]
    ) -> None:
        with contextlib.suppress(OSError):  # a thread begins with the priority of the loop
            os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
        try:
            self._file.save(state, self._fingers, serials)
        except SessionFileError as error:
            if not self._warned:
                log.warning("%s; the next start begins a new session", error)
            self._warned = True
        else:
            self._saved = known
            self._warned = False

    def _what_is_known(self) -> tuple[int, dict[str, str]]:
        return self._session.grasps, dict(self._serials)

    def _restore(self) -> None:
        try:
            kept = self._file.load()
            if kept is None:
                return
            self._session.restore(statistics_of(kept, self._fingers))
        except (SessionFileError, ValueError) as error:
            log.warning("%s; a new session begins", error)
            return
        self._serials = dict(kept.serials)
        log.info("session of %d grasps restored from %s", self._session.grasps, self._file.path)

    def _check_serials(self) -> None:
        serials = self._tactile.serials
        changed = exchanged(self._serials, serials)
        if changed:
            log.warning(
                "new sensor on %s: the session's %d grasps no longer count",
                ", ".join(changed),
                self._session.grasps,
            )
            self._on_exchange()
            self._save_due_ns = self._clock()
        self._serials.update(serials)
