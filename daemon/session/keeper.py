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
from msgspec.structs import replace

from graspd.daemon.judge.calibration import Exchanged
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
    restore_kept,
)
from graspd.daemon.session.sensors import (
    FIT_GRASPS,
    Rest,
    SensorWatch,
    fits,
    moved_fingers,
    numbers,
)
from graspd.daemon.trust.trust import TrustState, decode
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
SEEDED: Final = "the seeded session names no sensors: it is used once %d grasps fit it"
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
        """Restore the session in `file` that is of these fingers, model and sensors, if one is.

        The file keeps what `pipeline` has no use for. A file that cannot be locked is tried again.
        """
        self._session = pipeline.session
        self._trust = pipeline.trust
        super().__init__(pipeline, tactile)
        self._fingers = tuple(fingers)
        self._file = file
        self._clock = clock
        self._unused = SavedState({})
        """Content of the file that this run does not use."""
        self._others: list[KeptSession] = []
        """Sessions of other fingers, models or sensors, newest first."""
        self._warned = False
        try:
            file.lock()
        except SessionFileError as error:
            log.warning("%s; outcomes are `not kept` until it can be", error)
            self._warned = True
        self._restore()
        self._saved = self._now()
        self._save_due_ns = clock() + SAVE_PERIOD_NS
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
        if state == self._saved:
            self._answer(len(self._waiting), None)
        elif self._worker.submit(partial(self._write, state)):
            self._in_writing = len(self._waiting)
        else:
            self._answer(len(self._waiting), f"not kept: {UNEXPECTED}")

    def _write(self, state: SavedState) -> SavedState:
        """Write `state` in the worker, and return it. Raises `SessionFileError`."""
        self._file.save(self._kept(state))
        return state

    def _kept(self, state: SavedState) -> KeptSession:
        fingers, serials, statistics, trust, rest, others = self._fingers, *state
        return kept_now(statistics, fingers, serials, trust, rest, others)

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
        serials = numbers(self._serials)
        return SavedState(serials, statistics, trust, rest, tuple(self._others))

    def _restore(self) -> None:
        try:
            newest = self._file.load()
        except SessionFileError as error:
            log.warning("%s; it is put aside, and a new session begins", error)
            return
        if newest is None:
            return
        kept = [newest, *newest.others]
        used = next((each for each in kept if self._goes_on(each)), None)
        learned = None if used is None else self._restore_trust(used, kept)
        self._others = list(newest.others)
        if newest is not used or (newest.trust is not None and newest is not learned):
            self._others = with_other(newest.others, newest)
        if used is None:
            if any(is_of_unknown_sensors(each) for each in self._others):
                self._sensors_exchanged()  # nothing is judged before they are known
            return
        self._serials, self._rest = numbers(used.serials), self._rest_of(used.rest)
        grasps = "" if self._session is None else f" of {self._session.grasps} grasps"
        log.info("session%s restored from %s", grasps, self._file.path)

    def _goes_on(self, kept: KeptSession) -> bool:
        """Continue a session; return False if it is of other fingers or may be of other sensors."""
        try:
            of_fingers(kept, self._fingers)
            if self._session is None:
                self._unused = self._unused._replace(statistics=kept.statistics)
            elif self._read_rest is not None and is_of_unknown_sensors(kept):
                log.warning(SEEDED, FIT_GRASPS)
                return False
            else:
                restore_kept(kept, self._fingers, self._session)
        except SessionFileError as error:
            log.warning("%s; it is kept beside that of this start", error)
            return False
        return True

    def _restore_trust(self, used: KeptSession, kept: Sequence[KeptSession]) -> KeptSession | None:
        """Restore what this model learned last with the sensors of `used`; return where it was."""
        problem: ValueError | None = None
        for each in (used, *kept):
            if each.trust is None or not is_of_sensors(each, used):
                continue
            try:
                learned = decode(each.trust)
                if self._trust is None:
                    self._unused = self._unused._replace(trust=learned)
                else:
                    self._trust.restore(learned)
                    log.info("%d outcomes restored", learned.learner.outcomes)
                return each
            except ValueError as error:
                problem = problem or error
        if problem is not None:
            lost = "learning and the count of the risk begin again"
            log.warning("%s: what was learned %s; %s", self._file.path, problem, lost)
        return None

    def _with_serials(self, serials: Mapping[str, str]) -> KeptSession | None:
        now = numbers(serials).items()
        return next((each for each in self._others if now and now <= each.serials.items()), None)

    def _with_rest(self, rest: Rest, *, is_known: bool) -> KeptSession | None:
        is_known = is_known or (self._rest is None and not self._now().is_empty)
        now = KeptSession(
            self._fingers, self._serials, 0.0, None, rest=tuple(rest.ravel().tolist())
        )
        for each in self._others:
            is_seed = is_of_unknown_sensors(each)
            if self._fits(each) if is_seed else not is_known and is_of_sensors(each, now):
                return each
        return None

    def _fits(self, seeded: KeptSession) -> bool:
        """Return True if the grasps of this session, still a young one, fit a seeded one."""
        session, known = self._session, seeded.statistics
        if session is None or session.now.calibrated or session.grasps < FIT_GRASPS:
            return False
        return known is not None and fits(known, session.state(), len(self._fingers))

    def _rest_of(self, kept: tuple[float, ...] | None) -> Rest | None:
        shape = len(self._fingers), ELECTRODES
        if kept is None or len(kept) != shape[0] * shape[1]:
            return None
        return np.array(kept).reshape(shape)

    def _begin(self, former: KeptSession | None, *, tared: bool = False) -> None:
        """Keep the session for later; continue that of the new sensors, if there is one.

        With `tared` these rest as they did: then they have their warm-up back too.
        """
        leaving = self._now()
        if not leaving.is_empty:
            self._others = with_other(self._others, self._kept(leaving))
        self._unused, self._rest = SavedState({}), None
        if former is None or not self._take_up(former, tared=tared):
            self._sensors_exchanged()
        self._save_due_ns = self._clock()

    def _take_up(self, former: KeptSession, *, tared: bool) -> bool:
        """Continue a session of the new sensors; return False if it cannot be used."""
        trust: TrustState | None = None
        if former.trust is not None:
            with contextlib.suppress(ValueError):
                trust = decode(former.trust)
        if trust is not None and self._trust is not None and not self._trust.fits(trust):
            trust = None
        learned = None if trust is None else trust.learner
        proves = tared and not is_of_unknown_sensors(former)
        proven = trust.risk.proven if proves and trust is not None else 0
        try:
            self._sensors_exchanged(Exchanged(former.statistics, learned, proven, tared))
        except ValueError as error:
            log.warning("what was kept of these sensors %s; a new session begins", error)
            return False
        self._unused = SavedState(
            {},
            former.statistics if self._session is None else None,
            trust if self._trust is None else None,
        )
        self._serials, self._rest = numbers(former.serials), self._rest_of(former.rest)
        grasps = "" if self._session is None else f" of {self._session.grasps} grasps"
        log.warning("these sensors were there before: their session%s goes on", grasps)
        return True


def is_of_unknown_sensors(kept: KeptSession) -> bool:
    """Return True if a session is seeded from grasps that say nothing of the sensors."""
    return kept.statistics is not None and kept.rest is None and not numbers(kept.serials)


def is_of_sensors(one: KeptSession, other: KeptSession) -> bool:
    """Return True if two sessions have the same fingers and serial numbers, and rest alike."""
    if one.fingers != other.fingers or numbers(one.serials) != numbers(other.serials):
        return False
    shape = len(one.fingers), ELECTRODES
    rests = [np.array(each.rest) for each in (one, other) if each.rest is not None]
    if [rest.size for rest in rests] != [shape[0] * shape[1]] * 2:
        return not rests
    return not moved_fingers(*(rest.reshape(shape) for rest in rests))


def with_other(others: Sequence[KeptSession], kept: KeptSession) -> list[KeptSession]:
    """Return other sessions with one more, which replaces that of the same model and sensors."""
    rest = [each for each in others if each.model != kept.model or not is_of_sensors(each, kept)]
    return [replace(kept, others=()), *rest[: OTHERS_MAX - 1]]
