"""Prepare a changed scene file while the former scene runs."""

from __future__ import annotations

import signal
import time
from collections.abc import Callable, Iterator
from typing import Final

from graspd.daemon.assembly.parts import Parts
from graspd.daemon.judge.pipeline import Pipeline
from graspd.daemon.process.signals import StopSignal
from graspd.daemon.process.worker import Worker
from graspd.daemon.publish.companion import Companion
from graspd.daemon.trust.lift_book import OutcomeStatus

PERIOD_NS: Final = 1_000_000_000
"""Shortest time between two preparations, ns, from start to start."""
END_S: Final = 0.5
"""Longest wait of `close` for a preparation, s."""


class Reload(Companion):
    """Wrapper of a `StopSignal` that reports a reload only when the new scene is ready."""

    def __init__(
        self, stop: StopSignal, prepare: Callable[[], Parts], began: Callable[[], None]
    ) -> None:
        """`prepare`: called in a thread; it may raise anything.

        `began`: called in the loop's thread when a preparation begins.
        """
        self._stop = stop
        self._prepare = prepare
        self._began = began
        self._is_requested = False
        self._not_before_ns = 0
        self._worker: Worker[Parts] = Worker("reload")
        self._result: Parts | Exception | None = None

    @property
    def received(self) -> signal.Signals | None:
        return self._stop.received

    def fileno(self) -> int:
        return self._stop.fileno()

    def filenos(self) -> list[int]:
        return self._worker.filenos()

    def due_ns(self) -> int | None:
        """Return the time of the next preparation, monotonic ns; None: none is due."""
        return self._not_before_ns if self._is_requested and not self._worker.busy else None

    def take_reload(self) -> bool:
        """Return True if `take` has a result. Start a preparation if one is due."""
        if self._stop.take_reload():
            self._is_requested = True
        if self._result is None:
            self._result = self._worker.take()
        if self._result is not None:
            return True
        due_ns = self.due_ns()
        if due_ns is not None and time.monotonic_ns() >= due_ns:
            self._start()
        return False

    def take(self) -> Parts | Exception:
        """Return the prepared parts, or the exception. Call after `take_reload` was True."""
        result, self._result = self._result, None
        if result is None:
            raise RuntimeError("nothing has been prepared")
        return result

    def close(self) -> None:
        self._worker.close(END_S)

    def _start(self) -> None:
        self._is_requested = False
        self._not_before_ns = time.monotonic_ns() + PERIOD_NS
        if self._worker.submit(self._prepare):
            self._began()


def losses(pipeline: Pipeline, *, kept: bool) -> Iterator[str]:
    """Yield what is lost when another pipeline takes over, for the log.

    `kept`: True if outcomes and session are in a file, from which the other one restores them.
    """
    outcomes, session = pipeline.lifts.told[OutcomeStatus.TAKEN], pipeline.session
    grasps = 0 if session is None else session.grasps
    if not kept and (outcomes or grasps):
        yield (
            f"{outcomes} told outcomes and a session of {grasps} grasps are forgotten: "
            "only [session] keep = true keeps them"
        )
    grasp = pipeline.hand.grasp
    if pipeline.hand.holds(grasp):
        yield f"grasp {grasp} was held: release it, because the hand must be tared again"


def start_again(pipeline: Pipeline) -> None:
    """Let a pipeline go on whose successor failed; the hand must be tared again.

    Grasps have other names from now on, so a held grasp whose outcome was told would be judged
    as if it were another.
    """
    pipeline.restart()
    pipeline.hand.forget()
