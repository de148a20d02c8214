"""A thread for slow jobs, so that a slow disk does not delay the loop."""

from __future__ import annotations

import logging
import os
import select
import sys
import threading
from collections.abc import Callable
from contextlib import suppress
from queue import SimpleQueue
from typing import Final, Generic, TypeVar

R = TypeVar("R")

SWITCH_S: Final = 0.0005
"""Python's switch interval after the first job, s: the longest wait of the loop."""
PROCESSORS: Final = frozenset(os.sched_getaffinity(0) if hasattr(os, "sched_getaffinity") else ())
"""Processors at the start, before realtime mode restricts the loop to some of them."""

log = logging.getLogger("graspd")


class Worker(Generic[R]):
    """Run one job at a time in a thread of ordinary priority, on any processor.

    The thread starts with the first job. Call all methods in the loop's thread.
    """

    def __init__(self, name: str) -> None:
        self._name = name
        self._thread: threading.Thread | None = None
        self._jobs: SimpleQueue[Callable[[], R] | None]
        """Jobs for the thread; None ends it."""
        self._results: SimpleQueue[R | Exception]
        self._ended: int
        """Event descriptor, one count per result; the thread closes it."""
        self.filenos: list[int] = []
        """The descriptor that is readable after the job; empty without a job."""

    @property
    def busy(self) -> bool:
        """True from `submit` until the result is taken."""
        return bool(self.filenos)

    def submit(self, job: Callable[[], R]) -> bool:
        """Start a job; return False if the worker is busy or no thread can be started."""
        if self.busy or (self._thread is None and not self._start_thread()):
            return False
        self.filenos.append(self._ended)
        self._jobs.put(job)
        return True

    def take(self, wait_s: float = 0.0) -> R | Exception | None:
        """Wait up to `wait_s` for the job; return its result or exception. None: no job, or it
        still runs."""
        if not self.busy:
            return None
        poll = select.poll()
        poll.register(self._ended, select.POLLIN)
        if not poll.poll(wait_s * 1e3):
            return None
        os.eventfd_read(self._ended)
        self.filenos.clear()
        return self._results.get()

    def close(self, wait_s: float) -> bool:
        """End the thread; return False if its job still runs after `wait_s`."""
        thread, self._thread = self._thread, None
        if thread is None:
            return True
        self._jobs.put(None)
        thread.join(wait_s if self.busy else None)
        self.filenos.clear()
        return not thread.is_alive()

    def _start_thread(self) -> bool:
        self._jobs, self._results, self._ended = SimpleQueue(), SimpleQueue(), -1
        try:
            self._ended = os.eventfd(0, os.EFD_CLOEXEC)
            ends = self._jobs, self._results, self._ended
            thread = threading.Thread(target=_run, args=ends, name=self._name, daemon=True)
            thread.start()
        except (OSError, RuntimeError) as error:
            log.error("no thread for %s: %s", self._name, error)
            if self._ended >= 0:
                os.close(self._ended)
            return False
        self._thread = thread
        sys.setswitchinterval(SWITCH_S)
        return True


def _run(
    jobs: SimpleQueue[Callable[[], R] | None], results: SimpleQueue[R | Exception], ended: int
) -> None:
    while (job := jobs.get()) is not None:
        _be_ordinary()
        try:
            results.put(job())
        except Exception as error:  # noqa: BLE001 - also MemoryError: the loop continues
            results.put(error)
        del job  # free what the job holds, which may be large
        os.eventfd_write(ended, 1)
    os.close(ended)


def _be_ordinary() -> None:
    """Give up the loop's priority and processors, which a new thread inherits."""
    with suppress(OSError):
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
        os.sched_setaffinity(0, PROCESSORS)
