"""Keep the session of a running daemon in a file; answer outcomes once they are on the disk."""

from __future__ import annotations

import contextlib
import logging
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Final

import numpy as np

from graspd.daemon.judge.pipeline import Pipeline
from graspd.daemon.process.worker import Worker
from graspd.daemon.publish.companion import Answer, Requests
from graspd.daemon.session.file import (
    OTHERS_MAX,
    KeptSession,
    SavedState,
    SessionFile,
    SessionFileError,
    kept_now,
    of_fingers,
    others,
    restore_kept,
)
from graspd.daemon.session.sensors import Rest, SensorWatch, moved_fingers
from graspd.daemon.trust.trust import decode
from graspd.drivers.base import ELECTRODES, Driver

log = logging.getLogger("graspd")

WAIT_S: Final = 0.4
"""Longest wait for the disk at the end, s; the daemon has a second to stop."""
SAVE_PERIOD_NS: Final = 10_000_000_000
"""Time between two saves, ns, while no outcome waits."""
WAITING_MAX: Final = 64
"""Most answers that wait for the disk; a new one replaces the oldest."""
BUSY: Final = "busy: too many wait for the disk, tell it again"
UNEXPECTED: Final = "it could not be written"
HANGS: Final = "not kept: the disk does not answer"


class SessionKeeper(SensorWatch):
    """Restore, save and drop one session. A failure of the file is only a warning."""

    def __init__(
        self,
        pipeline: Pipeline,
        fingers: Sequence[str],
        tactile: Driver,
        file: SessionFile,
        clock: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        """Restore the session in `file`; warn, and start a new one, if it is of other fingers.

        The file keeps its session or trust if `pipeline` has none.
        """
        self._session = pipeline.session
        self._trust = pipeline.trust
        super().__init__(pipeline, tactile)
        self._fingers = tuple(fingers)
        self._file = file
        self._clock = clock
        self._unused = SavedState({})
        """Content of the file that this run does not use."""
        self._restore()
        self._others = [
            _state_of(kept) for kept in others(file.path).values() if kept.fingers == self._fingers
        ]
        """Sessions of other sensors, newest first."""
        self._leaving: deque[SavedState] = deque(maxlen=OTHERS_MAX)
        """Sessions of other sensors that are not on the disk yet."""
        self._saved = self._now()
        self._save_due_ns = clock() + SAVE_PERIOD_NS
        self._warned = False
        self._waiting: deque[Answer] = deque()
        self._in_writing = 0
        """Number of the first answers, which wait for the current save."""
        self._worker: Worker[SavedState] = Worker("session")

    def filenos(self) -> list[int]:
        return self._worker.filenos()

    def before_wait(self, requests: Requests) -> None:
        """Answer saved outcomes; start the next save if it is due."""
        self.wait(0.0)
        if self._waiting or self._clock() >= self._save_due_ns:
            self._start_save()

    def keep(self, answer: Answer) -> None:
        """Call `answer` after the present state is saved: with None, or with the failure."""
        if len(self._waiting) == WAITING_MAX:
            self._waiting.popleft()(BUSY)
            self._in_writing = max(self._in_writing - 1, 0)
        self._waiting.append(answer)
        self._start_save()

    def save(self) -> None:
        """Save for the last time and give all answers, within `2 * WAIT_S`."""
        self.wait(WAIT_S)
        self._start_save()
        self.wait(WAIT_S)
        self._answer(len(self._waiting), HANGS)
        self._worker.close(0.0)

    def wait(self, seconds: float) -> None:
        """Wait up to `seconds` for the current save, then answer the outcomes in it."""
        result = self._worker.take(seconds)
        if result is None:
            return
        if not isinstance(result, Exception):
            self._saved, self._warned = result, False
            self._answer(self._in_writing, None)
            return
        why = str(result) if isinstance(result, SessionFileError) else UNEXPECTED
        if not self._warned:
            unexpected = None if isinstance(result, SessionFileError) else result
            warning = "%s; the next start begins without what is new"
            log.warning(warning, why, exc_info=unexpected)
        self._warned = True
        self._answer(self._in_writing, f"not kept: {why}")

    def _start_save(self) -> None:
        """Start a save of the present state, with all waiting outcomes, unless one runs."""
        if self._worker.busy:
            return
        self._save_due_ns = self._clock() + SAVE_PERIOD_NS
        state = self._now()
        if state == self._saved and not self._leaving:
            self._answer(len(self._waiting), None)
        elif self._worker.submit(partial(self._write, state)):
            self._in_writing = len(self._waiting)
        else:
            self._answer(len(self._waiting), f"not kept: {UNEXPECTED}")

    def _write(self, state: SavedState) -> SavedState:
        """Write `state` in the worker, and return it. Raises `SessionFileError`."""
        while self._leaving:  # first, so that one of the files always has the session
            left = self._leaving.popleft()
            try:
                self._file.put_aside(self._kept(left))
            except SessionFileError:
                self._leaving.appendleft(left)  # the next save tries again
                raise
        self._file.save(self._kept(state))
        return state

    def _kept(self, state: SavedState) -> KeptSession:
        return kept_now(state.statistics, self._fingers, state.serials, state.trust, state.rest)

    def _answer(self, count: int, why: str | None) -> None:
        """Give the first `count` answers, with the failure `why` or None."""
        self._in_writing = 0
        for _ in range(count):
            self._waiting.popleft()(why)

    def _now(self) -> SavedState:
        statistics, trust = self._unused.statistics, self._unused.trust
        if self._session is not None:
            statistics = self._session.state()
        if self._trust is not None:
            trust = self._trust.state()
        rest = None if self._rest is None else tuple(self._rest.ravel().tolist())
        return SavedState(dict(self._serials), statistics, trust, rest)

    def _restore(self) -> None:
        try:
            kept = self._file.load()
            if kept is None:
                return
            if self._session is None:
                of_fingers(kept, self._fingers)
                self._unused = self._unused._replace(statistics=kept.statistics)
            else:
                restore_kept(kept, self._fingers, self._session)
        except SessionFileError as error:
            log.warning("%s; a new session begins", error)
            return
        self._serials = dict(kept.serials)
        self._rest = self._rest_of(kept.rest)
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
            lost = "learning and the count of the risk begin again"
            log.warning("%s: what was learned %s; %s", self._file.path, error, lost)

    def _with_serials(self, serials: Mapping[str, str]) -> SavedState | None:
        now = serials.items()
        return next((each for each in self._others if now <= each.serials.items()), None)

    def _with_rest(self, rest: Rest) -> SavedState | None:
        for each in self._others:
            former = self._rest_of(each.rest)
            same_serials = each.serials == self._serials
            if same_serials and former is not None and not moved_fingers(former, rest):
                return each
        return None

    def _rest_of(self, kept: tuple[float, ...] | None) -> Rest | None:
        shape = len(self._fingers), ELECTRODES
        if kept is None or len(kept) != shape[0] * shape[1]:
            return None
        return np.array(kept).reshape(shape)

    def _begin(self, former: SavedState | None) -> None:
        """Put the session aside; continue that of the new sensors, if there is one."""
        leaving = self._now()
        if not leaving.is_empty:
            rest = [each for each in self._others if each.serials != leaving.serials]
            self._others = [leaving, *rest[: OTHERS_MAX - 1]]
            self._leaving.append(leaving)
        self._unused = SavedState({})
        if former is None or not self._take_up(former):
            self._sensors_exchanged()
        self._save_due_ns = self._clock()

    def _take_up(self, former: SavedState) -> bool:
        """Continue a session of the new sensors; return False if it cannot be used."""
        trust = former.trust
        if trust is not None and self._trust is not None and not self._trust.fits(trust):
            trust = None
        try:
            learned = None if trust is None else trust.learner
            self._sensors_exchanged(former.statistics, learned)
        except ValueError as error:
            log.warning("what was kept of these sensors %s; a new session begins", error)
            return False
        self._unused = SavedState(
            {},
            former.statistics if self._session is None else None,
            trust if self._trust is None else None,
        )
        self._serials = dict(former.serials)
        grasps = "" if self._session is None else f" of {self._session.grasps} grasps"
        log.warning("these sensors were there before: their session%s goes on", grasps)
        return True


def _state_of(kept: KeptSession) -> SavedState:
    """Return the content of a file, without unreadable parts."""
    learned = None
    if kept.trust is not None:
        with contextlib.suppress(ValueError):
            learned = decode(kept.trust)
    return SavedState(dict(kept.serials), kept.statistics, learned, kept.rest)
