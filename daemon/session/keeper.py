"""Keep the session of a running daemon in its folder; answer outcomes once they are on the disk."""

from __future__ import annotations

import logging
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from typing import Final, NamedTuple

import numpy as np
from msgspec.structs import replace

from graspd.biotac import ELECTRODES
from graspd.daemon.judge.exchange import Exchanged
from graspd.daemon.judge.pipeline import Pipeline
from graspd.daemon.judge.reasons import Reason
from graspd.daemon.process.worker import Worker
from graspd.daemon.publish.companion import KEPT, Answer, Reply, Requests, Told
from graspd.daemon.session.file import KeptSession, SessionFileError, of_fingers, restore_kept
from graspd.daemon.session.folder import KEPT_MAX, SessionFolder
from graspd.daemon.session.sensors import (
    FIT_GRASPS,
    Rest,
    SensorWatch,
    fits,
    moved_fingers,
    numbers,
)
from graspd.daemon.trust.trust import Trust, TrustState
from graspd.drivers.base import Driver

log = logging.getLogger("graspd")

WAIT_S: Final = 0.4
"""Longest wait, s, for each of two saves at the end; the daemon has a second to stop."""
SAVE_PERIOD_NS: Final = 10_000_000_000
"""Time between two saves, ns, while no outcome waits."""
WAITING_MAX: Final = 64
"""Most answers that wait for the disk. With one more, the oldest gets the reply `busy`."""
BUSY: Final = Reply(Told.BUSY, "too many wait for the disk, tell it again")
HANGS: Final = Reply(Told.NOT_KEPT, "the disk does not answer")
UNEXPECTED: Final = "it could not be written"
SEEDED: Final = "the seeded session names no sensors: it is used once %d grasps fit it"

Sessions = tuple[KeptSession, ...]
"""All sessions to save: the one that runs, then the others."""


class SessionKeeper(SensorWatch):
    """Restores and saves the sessions of a run. A failure of the disk is only a warning."""

    def __init__(
        self,
        pipeline: Pipeline,
        fingers: Sequence[str],
        tactile: Driver,
        folder: SessionFolder,
        clock: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        """Restore the last session of these fingers, and what this model learned with its sensors.
        State that `pipeline` does not use stays kept. A folder in use is locked later, when
        free."""
        self._session = pipeline.session
        self._trust = pipeline.trust
        super().__init__(pipeline, tactile)
        self._fingers = tuple(fingers)
        self._folder = folder
        self._clock = clock
        self._unused: TrustState | None = None
        """Kept state of learning, to be saved again unchanged, in a run that does not learn."""
        self._others: tuple[KeptSession, ...] = ()
        """Sessions of other fingers, models or sensors, the last used first."""
        self._warned = ""
        """Logged reason why the last save failed; empty: it succeeded."""
        try:
            folder.lock()
        except SessionFileError as error:
            log.warning("%s; outcomes are `not kept` until it can be", error)
            self._warned = str(error)
        self._restore(pipeline)
        self._saved: Sessions = (self._now(), *self._others)
        self._save_due_ns = clock() + SAVE_PERIOD_NS
        self._waiting: deque[Answer] = deque()
        self._in_writing = 0
        """Number of answers, the first in the queue, that the current save makes due."""
        self._worker: Worker[Sessions] = Worker("session")
        self.filenos = self._worker.filenos

    def before_wait(self, requests: Requests) -> None:
        """Answer saved outcomes; start the next save if it is due."""
        self.wait(0.0)
        if self._waiting or self._clock() >= self._save_due_ns:
            self._start_save()

    def keep(self, answer: Answer) -> None:
        """Call `answer` once the present state is saved, or saving it has failed."""
        if len(self._waiting) == WAITING_MAX:
            self._waiting.popleft()(BUSY)
            self._in_writing = max(self._in_writing - 1, 0)
        self._waiting.append(answer)
        self._start_save()

    def save(self) -> None:
        """Save for the last time and give all answers, in at most `2 * WAIT_S`."""
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
            self._saved, self._warned = result, ""
            self._answer(self._in_writing, KEPT)
            return
        why = str(result) if isinstance(result, SessionFileError) else UNEXPECTED
        if why != self._warned:
            unexpected = None if isinstance(result, SessionFileError) else result
            log.warning("%s; the next start begins without what is new", why, exc_info=unexpected)
        self._warned = why
        self._answer(self._in_writing, Reply(Told.NOT_KEPT, why))

    @property
    def health(self) -> dict[str, Reason]:
        return {"session": Reason.NOT_KEPT} if self._warned else {}

    def _start_save(self) -> None:
        """Start a save of the present state, unless one runs; answer at once if nothing is new."""
        if self._worker.busy:
            return
        self._save_due_ns = self._clock() + SAVE_PERIOD_NS
        state = self._now(), *self._others
        if state == self._saved:
            self._answer(len(self._waiting), KEPT)
        elif self._worker.submit(partial(self._write, state)):
            self._in_writing = len(self._waiting)
        else:
            self._answer(len(self._waiting), Reply(Told.NOT_KEPT, UNEXPECTED))

    def _write(self, state: Sessions) -> Sessions:
        """Write `state` in the worker, and return it. Raises `SessionFileError`."""
        self._folder.save(state)
        return state

    def _answer(self, count: int, reply: Reply) -> None:
        """Call the first `count` waiting answers with `reply`."""
        self._in_writing = 0
        for _ in range(count):
            self._waiting.popleft()(reply)

    def _now(self) -> KeptSession:
        statistics = None if self._session is None else self._session.state()
        trust = self._unused if self._trust is None else self._trust.state()
        rest = None if self._rest is None else tuple(self._rest.ravel().tolist())
        return KeptSession(statistics, self._fingers, numbers(self._serials), trust, rest)

    def _restore(self, pipeline: Pipeline) -> None:
        try:
            found = [*self._folder.load().values()]
        except SessionFileError as error:
            found = [error]
        for at, damaged in enumerate(found):
            if isinstance(damaged, SessionFileError):
                then = "" if at else ", and a new session begins"
                log.warning("%s; it stays as it is%s", damaged, then)
        kept = newest_of_each([each for each in found if isinstance(each, KeptSession)])
        used, learned, problems = continue_kept(pipeline, self._fingers, kept)
        for problem in problems:
            log.warning("%s", problem)
        continued = used if used is not None and used.trust is None else learned
        self._others = tuple(each for each in kept if each not in (continued, learned))
        if used is None:
            if any(is_of_unknown_sensors(each) for each in self._others):
                self._sensors_exchanged()  # nothing is judged before the sensors are known
            return
        self._serials, self._rest = numbers(used.serials), self._rest_of(used.rest)
        grasps = "" if self._session is None else f" of {self._session.grasps} grasps"
        log.info("session%s restored from %s", grasps, self._folder.path)
        if learned is not None and self._trust is None:
            self._unused = learned.trust
        elif learned is not None and self._trust is not None:
            log.info("%d outcomes restored", self._trust.learner.outcomes)
        session = self._session
        if session is not None and not session.calibrated and self._has_other_sensors(used):
            pipeline.needs_session = True  # so was it before this start, as they were exchanged
        if isinstance(found[0], SessionFileError):  # the unreadable session may be of other sensors
            self._begin(None)

    def _has_other_sensors(self, used: KeptSession) -> bool:
        """Return True if a session of these fingers with other sensors than `used` is kept too."""
        return any(
            each.fingers == self._fingers and not is_of_sensors(each, used) for each in self._others
        )

    def _with_serials(self, serials: Mapping[str, str]) -> KeptSession | None:
        now = numbers(serials).items()
        return self._former(lambda each: bool(now) and now <= each.serials.items())

    def _with_rest(self, rest: Rest, *, is_known: bool) -> KeptSession | None:
        is_known = is_known or (self._rest is None and not self._now().is_empty)
        resting = tuple(rest.ravel().tolist())
        now = KeptSession(None, self._fingers, numbers(self._serials), rest=resting)

        def is_there(each: KeptSession) -> bool:
            if is_of_unknown_sensors(each):
                return self._fits(each)
            return not is_known and is_of_sensors(each, now)

        return self._former(is_there)

    def _former(self, is_there: Callable[[KeptSession], bool]) -> KeptSession | None:
        """Return the last used kept session of the sensors that are present now; None: no such one.

        `is_there`: True for a session of these sensors. The session comes with this model's
        learning with them, even if that was kept in another session.
        """
        needs_none = self._session is None
        usable = (
            each
            for each in self._others
            if each.fingers == self._fingers and (each.statistics is None) is needs_none
        )
        used = next(filter(is_there, usable), None)
        if used is None:
            return None
        learned = (
            trust
            for _, trust in _taught_with(used, self._others)
            if self._trust is None or self._trust.fits(trust)
        )
        return replace(used, trust=next(learned, None))

    def _fits(self, seeded: KeptSession) -> bool:
        """Return True if the session that runs is not calibrated and fits `seeded`; False with
        fewer than `FIT_GRASPS` grasps."""
        session, known = self._session, seeded.statistics
        if session is None or session.calibrated or session.grasps < FIT_GRASPS:
            return False
        return known is not None and fits(known, session.state(), len(self._fingers))

    def _rest_of(self, kept: tuple[float, ...] | None) -> Rest | None:
        shape = len(self._fingers), ELECTRODES
        if kept is None or len(kept) != shape[0] * shape[1]:
            return None
        return np.array(kept).reshape(shape)

    def _begin(self, former: KeptSession | None, *, tared: bool = False) -> None:
        """Keep the running session for later; continue `former`, the session of the new sensors.

        None: begin an empty one. `tared`: the present tare was made with the new sensors; it stays,
        and their warm-up counts again.
        """
        leaving = self._now()
        if not leaving.is_empty:
            self._others = tuple(newest_of_each([leaving, *self._others])[:KEPT_MAX])
        self._unused = self._rest = None
        if former is None or not self._take_up(former, tared=tared):
            self._sensors_exchanged()
        self._save_due_ns = self._clock()

    def _take_up(self, former: KeptSession, *, tared: bool) -> bool:
        """Continue `former`, the session of the new sensors; return False if it cannot be used.
        `tared`: as in `_begin`; False: the present tare is forgotten."""
        trust = former.trust
        learned = None if trust is None else trust.learner
        proves = tared and not is_of_unknown_sensors(former)
        proven = trust.risk.proven if proves and trust is not None else 0
        budget = None if trust is None else self._budget_of(trust)
        try:
            self._sensors_exchanged(Exchanged(former.statistics, learned, proven, budget, tared))
        except ValueError as error:
            log.warning("what was kept of these sensors %s; a new session begins", error)
            return False
        self._others = tuple(newest_of_each([former, *self._others])[1:])
        self._unused = trust
        self._serials, self._rest = numbers(former.serials), self._rest_of(former.rest)
        if self._session is not None or trust is not None:
            grasps = "" if self._session is None else f" of {self._session.grasps} grasps"
            log.warning("these sensors were there before: their session%s continues", grasps)
        return True

    def _budget_of(self, former: TrustState) -> float | None:
        """Return the kept budget of slips; None without learning, or if the risk limit differs."""
        if self._trust is None:
            return None
        is_same = former.risk.max_slip_when_stable == self._trust.risk.limits.max_slip_when_stable
        return former.risk.budget if is_same else None


class Continued(NamedTuple):
    """Kept sessions that a start of the daemon continues."""

    used: KeptSession | None
    """Session whose calibration continues; None: no kept one fits."""
    learned: KeptSession | None
    """Session whose learning, by this model with the same sensors, continues; None: no such one."""
    problems: list[str]
    """Why other sessions are not continued."""


def continue_kept(
    pipeline: Pipeline, fingers: Sequence[str], kept: Sequence[KeptSession]
) -> Continued:
    """Restore calibration and learning at a start of the daemon; return from which sessions.

    `kept`: all kept sessions, the last used first. The first that fits is `used`.
    """
    problems: list[str] = []
    used = next((each for each in kept if _continues(pipeline, fingers, each, problems)), None)
    learned = None if used is None else _restore_trust(pipeline.trust, used, kept, problems)
    return Continued(used, learned, problems)


def _continues(
    pipeline: Pipeline, fingers: Sequence[str], kept: KeptSession, problems: list[str]
) -> bool:
    """Restore a session; return False if it is of other fingers, does not fit the model, or may be
    of other sensors. Adds the reason to `problems`, but none if the model needs no statistics and
    the session has some."""
    try:
        of_fingers(kept, fingers)
        if pipeline.session is None:
            return kept.statistics is None
        if pipeline.read_rest is not None and is_of_unknown_sensors(kept):
            problems.append(SEEDED % FIT_GRASPS)
            return False
        restore_kept(kept, fingers, pipeline.session)
    except SessionFileError as error:
        problems.append(f"{error}; it stays kept")
        return False
    return True


def _restore_trust(
    trust: Trust | None, used: KeptSession, kept: Sequence[KeptSession], problems: list[str]
) -> KeptSession | None:
    """Restore this model's last learning with the sensors of `used`; return its session. None: it
    has none, or it cannot be restored, which is added to `problems`. `trust` None: restore nothing,
    and return the session with the last learning of any model.
    """
    why: list[str] = []
    for each, learned in _taught_with(used, kept):
        try:
            if trust is not None:
                trust.restore(learned)
        except ValueError as error:
            why.append(str(error))
            continue
        return each
    lost = "learning and the count of the risk begin again"
    problems += [f"what was learned {problem}; {lost}" for problem in why[:1]]
    return None


def _taught_with(
    used: KeptSession, kept: Sequence[KeptSession]
) -> Iterator[tuple[KeptSession, TrustState]]:
    """Yield each session with the sensors of `used` that holds learning, and the learning. `used`
    itself comes first."""
    for each in (used, *kept):
        if each.trust is not None and is_of_sensors(each, used):
            yield each, each.trust


def is_of_unknown_sensors(kept: KeptSession) -> bool:
    """Return True for a session seeded from recorded grasps: it has grasps, but neither rest nor
    serials. (A session that ended before its first tare has no grasps.)"""
    return kept.grasps > 0 and kept.rest is None and not numbers(kept.serials)


def is_of_sensors(one: KeptSession, other: KeptSession) -> bool:
    """Return True if two sessions have the same fingers and serial numbers, and either rest alike
    or both have no rest."""
    if one.fingers != other.fingers or numbers(one.serials) != numbers(other.serials):
        return False
    shape = len(one.fingers), ELECTRODES
    rests = [np.array(each.rest) for each in (one, other) if each.rest is not None]
    if [rest.size for rest in rests] != [shape[0] * shape[1]] * 2:
        return not rests
    return not moved_fingers(*(rest.reshape(shape) for rest in rests))


def newest_of_each(kept: Sequence[KeptSession]) -> list[KeptSession]:
    """Return the first session of each set of fingers, model and sensors; an empty one only where
    all are. They stand where the first of their set did."""
    newest: list[KeptSession] = []
    for each in kept:
        of_model = [n for n, one in enumerate(newest) if one.model == each.model]
        same = next((n for n in of_model if is_of_sensors(newest[n], each)), None)
        if same is None:
            newest.append(each)
        elif newest[same].is_empty and not each.is_empty:  # one that was unreadable at its start
            newest[same] = each
    return newest
