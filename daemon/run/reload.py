"""A scene taken anew while the former one goes on: prepared in a thread, one after another."""

from __future__ import annotations

import logging
import os
import signal
import sys
import threading
import time
from collections.abc import Callable
from contextlib import suppress

from daemon.assembly.parts import Parts
from daemon.process.signals import StopSignal
from daemon.publish.companion import Companion

log = logging.getLogger("graspd")

PERIOD_S = 1.0
"""From the beginning of one preparation to that of the next at least, s."""
SWITCH_S = 0.0005
"""How long the thread that prepares may keep Python from the loop, s, rather than 5 ms: the loop
asks for it several times for each reading."""
END_S = 0.5
"""How long the end waits for a preparation, s: it is of no use any more."""


class Reload(Companion):
    """Stands before a `StopSignal`: to the loop, a reload is asked for once there is what to run.

    Whoever asks while a scene is prepared has one more prepared after it, however often.
    """

    def __init__(
        self, stop: StopSignal, prepare: Callable[[], Parts], began: Callable[[], None]
    ) -> None:
        """`prepare` is called in a thread of ordinary priority and may raise what it likes.

        `began` is called in the loop's thread, before that.
        """
        self._stop = stop
        self._prepare = prepare
        self._began = began
        self._wanted = False
        self._thread: threading.Thread | None = None
        self._result: Parts | Exception | None = None
        self._not_before_s = 0.0
        self._switch_s = sys.getswitchinterval()
        self._cancelled = threading.Event()
        self._processors = os.sched_getaffinity(0)
        self._ended = os.eventfd(0, os.EFD_CLOEXEC | os.EFD_NONBLOCK)

    @property
    def received(self) -> signal.Signals | None:
        """The signal that stops the process; None before it."""
        return self._stop.received

    def fileno(self) -> int:
        """Descriptor that becomes readable when a signal arrives."""
        return self._stop.fileno()

    def filenos(self) -> list[int]:
        """Become readable when a preparation has ended."""
        return [] if self._thread is None else [self._ended]

    def take_reload(self) -> bool:
        """Whether a preparation has ended, for `take`; begins one where that was asked for."""
        if self._stop.take_reload():
            self._wanted = True
        if self._thread is not None:
            return self._result is not None
        if self._wanted:
            self._begin()
        return False

    def take(self) -> Parts | Exception:
        """What has been prepared, or what was raised, once `take_reload` has said that it is there.

        Raises `RuntimeError` otherwise.
        """
        result, self._result = self._result, None
        if self._thread is None or result is None:
            raise RuntimeError("nothing has been prepared")
        self._thread.join()
        self._thread = None
        os.eventfd_read(self._ended)
        sys.setswitchinterval(self._switch_s)
        return result

    def close(self) -> None:
        """Give up what is being prepared."""
        self._cancelled.set()
        if self._thread is not None:
            self._thread.join(END_S)
            sys.setswitchinterval(self._switch_s)
            if self._thread.is_alive():
                return  # it may still say that it has ended
            self._thread = None
        os.close(self._ended)

    def _begin(self) -> None:
        self._wanted = False
        thread = threading.Thread(target=self._run, name="reload", daemon=True)
        self._began()
        try:
            thread.start()
        except RuntimeError as error:
            log.error("the scene is not taken anew: %s", error)
            return
        self._thread = thread
        sys.setswitchinterval(SWITCH_S)

    def _run(self) -> None:
        self._be_ordinary()
        if self._cancelled.wait(max(self._not_before_s - time.monotonic(), 0.0)):
            return
        self._not_before_s = time.monotonic() + PERIOD_S
        result: Parts | Exception
        try:
            result = self._prepare()
        except Exception as error:  # noqa: BLE001 - MemoryError too: the running scene goes on
            result = error
        self._result = result
        os.eventfd_write(self._ended, 1)

    def _be_ordinary(self) -> None:
        """Have neither the priority nor the processors that the loop's thread may have by now."""
        with suppress(OSError):
            os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
            os.sched_setaffinity(0, self._processors)
