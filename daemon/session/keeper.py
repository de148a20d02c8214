"""Keeps the session of a running daemon, and what outcomes taught in it, in a file; begins a new
one for other sensors, and says when what was told is on the disk."""

from __future__ import annotations

import contextlib
import logging
import os
import select
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from queue import SimpleQueue
from typing import Final, NamedTuple

from daemon.judge.calibration import SessionCalibration
from daemon.publish.companion import Answer, Requests
from daemon.session.file import (
    OTHERS_MAX,
    KeptSession,
    SessionFile,
    SessionFileError,
    kept_now,
    of_fingers,
    others,
    statistics_of,
)
from daemon.session.sensors import SensorWatch
from daemon.trust.learner import LearnerState
from daemon.trust.trust import Trust, TrustState, decode
from drivers.base import Driver
from models.session_statistics import SessionState

log = logging.getLogger("graspd")

WAIT_S = 0.4
"""How long the end waits for the disk, s: the daemon is given a second to stop."""
SAVE_PERIOD_NS = 10_000_000_000
"""Between two saves where nobody waits for one, ns: a power cut costs the grasps of ten seconds."""
WAITING_MAX: Final = 64
"""Answers that wait for the disk; the oldest is given up for a newer one."""
BUSY: Final = "busy: too many wait for the disk, tell it again"
UNEXPECTED: Final = "it could not be written"
OnExchange = Callable[[SessionState | None, LearnerState | None], None]
HANGS: Final = "not kept: the disk does not answer"


class Known(NamedTuple):
    """What is kept, as it is at one moment."""

    serials: dict[str, str]
    statistics: SessionState | None = None
    trust: TrustState | None = None

    @property
    def is_nothing(self) -> bool:
        """Whether no grasp and no outcome is known."""
        no_grasps = self.statistics is None or not self.statistics.grasps
        return no_grasps and (self.trust is None or not self.trust.learner.outcomes)


class SessionKeeper(SensorWatch):
    """Restores, saves and drops one session; a file that fails costs a warning, not the run."""

    def __init__(
        self,
        session: SessionCalibration | None,
        fingers: Sequence[str],
        tactile: Driver,
        file: SessionFile,
        clock: Callable[[], int] = time.monotonic_ns,
        on_exchange: OnExchange | None = None,
        trust: Trust | None = None,
    ) -> None:
        """Restore what `file` holds; if that is no session of these fingers, warn and begin anew.

        `session` is None for a model without one, `trust` where nothing learns: what is kept for
        those stays as it is. `tactile` knows the serial numbers of the sensors. `on_exchange` is
        called when one of them is another than before, with what is kept of the new ones, and must
        reset session and trust to that; unless given, only that is done.
        """
        self._session = session
        self._trust = trust
        self._exchanged = on_exchange or self._reset
        super().__init__(tactile, lambda: self._exchanged(None, None))
        self._fingers = tuple(fingers)
        self._file = file
        self._clock = clock
        self._unused = Known({})
        """What was kept and this run has no use for."""
        self._restore()
        self._others = [
            _known_of(kept) for kept in others(file.path) if kept.fingers == self._fingers
        ]
        """What is kept of other sensors, the newest first."""
        self._leaving: deque[Known] = deque(maxlen=OTHERS_MAX)
        """Of these, what is not yet on the disk."""
        self._saved = self._known()
        self._save_due_ns = clock() + SAVE_PERIOD_NS
        self._warned = False
        self._waiting: deque[Answer] = deque()
        self._in_writing = 0
        """How many of them, the first ones, wait for what is being written."""
        self._jobs: SimpleQueue[tuple[Known, int] | None] = SimpleQueue()
        """What the thread is to write, and where to say so, one at a time; None ends it."""
        self._written: int | None = None
        """While it writes: the descriptor that becomes readable when it has done what it could."""
        self._failure: str | None = None
        """Why it failed."""
        self._thread: threading.Thread | None = None
        """From the first save on: a disk may take its time, and readings do not wait."""

    def filenos(self) -> list[int]:
        """Becomes readable when a save has ended."""
        return [] if self._written is None else [self._written]

    def before_wait(self, requests: Requests) -> None:
        """Answer those whose save has ended, and begin the next one if others wait."""
        self.wait(0.0)
        if self._waiting and self._written is None:
            self._begin_to_save()

    def before_readings(self) -> None:
        """Drop the session if a sensor has been exchanged; save it if it is time."""
        super().before_readings()
        if self._clock() >= self._save_due_ns and self._written is None:
            self._begin_to_save()

    def keep(self, answer: Answer) -> None:
        """Call `answer` once what is known now is on the disk, with None, or with why it is not."""
        if len(self._waiting) == WAITING_MAX:
            self._waiting.popleft()(BUSY)
            self._in_writing = max(self._in_writing - 1, 0)
        self._waiting.append(answer)
        if self._written is None:
            self._begin_to_save()

    def save(self) -> None:
        """Save what is new, for the last time; whoever waits is answered. At most `2 * WAIT_S`."""
        self.wait()
        if self._written is None:
            self._begin_to_save()
            self.wait()
        self._answer(len(self._waiting), HANGS)
        if self._thread is not None:
            self._jobs.put(None)
            if self._written is None:
                self._thread.join()
            self._thread = None

    def wait(self, seconds: float = WAIT_S) -> None:
        """Wait until saving has ended, for so long at most, and answer those who waited for it."""
        if self._written is None or not select.select([self._written], [], [], seconds)[0]:
            return
        os.close(self._written)
        self._written = None
        failure = self._failure
        if failure is not None and not self._warned:
            log.warning("%s; the next start begins without what is new", failure)
        self._warned = failure is not None
        self._answer(self._in_writing, None if failure is None else f"not kept: {failure}")

    def _begin_to_save(self) -> None:
        self._save_due_ns = self._clock() + SAVE_PERIOD_NS
        known = self._known()
        if known == self._saved and not self._leaving:
            self._answer(len(self._waiting), None)
            return
        self._in_writing = len(self._waiting)
        self._written = os.eventfd(0, os.EFD_CLOEXEC)
        self._jobs.put((known, self._written))
        if self._thread is None:
            self._thread = threading.Thread(target=self._write, name="session", daemon=True)
            self._thread.start()

    def _write(self) -> None:
        with contextlib.suppress(OSError):  # a thread begins with the priority of the loop
            os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
        while (job := self._jobs.get()) is not None:
            known, written = job
            self._failure = UNEXPECTED
            try:
                self._put_aside()  # first, so that a session is always in one of the files
                self._file.save(known.statistics, self._fingers, known.serials, known.trust)
                self._saved, self._failure = known, None
            except SessionFileError as error:
                self._failure = str(error)
            finally:  # whoever waits is answered, also where a mistake of ours ends this thread
                if self._failure is UNEXPECTED:
                    self._thread = None
                os.eventfd_write(written, 1)

    def _put_aside(self) -> None:
        """Write the sessions of sensors that have left. Raises `SessionFileError`."""
        while self._leaving:
            left = self._leaving.popleft()
            kept = kept_now(left.statistics, self._fingers, left.serials, left.trust)
            try:
                self._file.put_aside(kept)
            except SessionFileError:
                self._leaving.appendleft(left)  # to be tried again with the next save
                raise

    def _answer(self, number: int, why: str | None) -> None:
        """Answer those who have waited longest."""
        self._in_writing = 0
        for _ in range(number):
            self._waiting.popleft()(why)

    def _known(self) -> Known:
        statistics, trust = self._unused.statistics, self._unused.trust
        if self._session is not None:
            statistics = self._session.state()
        if self._trust is not None:
            trust = self._trust.state()
        return Known(dict(self._serials), statistics, trust)

    def _restore(self) -> None:
        try:
            kept = self._file.load()
            if kept is None:
                return
            if self._session is None:
                of_fingers(kept, self._fingers)
                self._unused = self._unused._replace(statistics=kept.statistics)
            else:
                self._session.restore(statistics_of(kept, self._fingers))
        except (SessionFileError, ValueError) as error:
            log.warning("%s; a new session begins", error)
            return
        self._serials = dict(kept.serials)
        grasps = "" if self._session is None else f" of {self._session.grasps} grasps"
        log.info("session%s restored from %s", grasps, self._file.path)
        self._restore_trust(kept)

    def _restore_trust(self, kept: KeptSession) -> None:
        if kept.trust is None:
            return
        try:
            learned = decode(kept.trust)
            if self._trust is None:
                self._unused = self._unused._replace(trust=learned)
            else:
                self._trust.restore(learned)
                log.info("%d outcomes restored", learned.learner.outcomes)
        except ValueError as error:
            log.warning("%s: what was learned %s; learning begins anew", self._file.path, error)

    def _reset(
        self, session: SessionState | None = None, learned: LearnerState | None = None
    ) -> None:
        if self._session is not None:
            self._session.reset()
            if session is not None:
                self._session.restore(session)
        if self._trust is not None:
            self._trust.sensors_exchanged(learned)

    def _exchange(self, changed: list[str], serials: Mapping[str, str]) -> None:
        """Put the session aside, and take up that of the sensors that are there now, if any."""
        grasps = "" if self._session is None else f"'s {self._session.grasps} grasps"
        log.warning("new sensor on %s: the session%s no longer count", ", ".join(changed), grasps)
        now = serials.items()
        former = next((each for each in self._others if now <= each.serials.items()), None)
        leaving = self._known()
        if not leaving.is_nothing:
            rest = [each for each in self._others if each.serials != leaving.serials]
            self._others = [leaving, *rest[: OTHERS_MAX - 1]]
            self._leaving.append(leaving)
        self._unused = Known({})
        if former is None or not self._take_up(former):
            self._on_exchange()
        self._save_due_ns = self._clock()

    def _take_up(self, former: Known) -> bool:
        """Go on with the session of sensors that were there before; False if it is of no use."""
        trust = former.trust
        if trust is not None and self._trust is not None and not self._trust.fits(trust):
            trust = None
        try:
            self._exchanged(former.statistics, None if trust is None else trust.learner)
        except ValueError as error:
            log.warning("what was kept of these sensors %s; a new session begins", error)
            return False
        self._unused = Known(
            {},
            former.statistics if self._session is None else None,
            trust if self._trust is None else None,
        )
        self._serials = dict(former.serials)
        grasps = "" if self._session is None else f" of {self._session.grasps} grasps"
        log.warning("these sensors were there before: their session%s goes on", grasps)
        return True


def _known_of(kept: KeptSession) -> Known:
    """What a file holds; without what was learned where that cannot be read."""
    learned = None
    if kept.trust is not None:
        with contextlib.suppress(ValueError):
            learned = decode(kept.trust)
    return Known(dict(kept.serials), kept.statistics, learned)
