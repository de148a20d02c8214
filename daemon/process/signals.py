"""SIGINT, SIGTERM and SIGHUP as a descriptor that a selector can wait on."""

from __future__ import annotations

import contextlib
import os
import select
import signal
from types import FrameType
from typing import Any, Self

WAKEUPS_MAX = 4096
"""Most bytes of one read from the pipe; each signal is one byte."""


def stopping() -> list[signal.Signals]:
    """Return the signals that stop the process; not SIGHUP where `nohup` has it ignored."""
    kept = signal.getsignal(signal.SIGHUP) is signal.SIG_IGN
    return [signal.SIGINT, signal.SIGTERM, *([] if kept else [signal.SIGHUP])]


class StopSignal:
    """Handler that keeps the signal that stops the process."""

    def __init__(self) -> None:
        self.received: signal.Signals | None = None
        self._former: dict[signal.Signals, Any] = {}
        self._former_wakeup = -1
        self._read, self._write = os.pipe2(os.O_NONBLOCK | os.O_CLOEXEC)

    def fileno(self) -> int:
        """Return a descriptor that becomes readable when a signal arrives."""
        return self._read

    def wait(self, seconds: float) -> bool:
        """Wait up to `seconds` for a signal; return True if one has stopped the process."""
        poll = select.poll()
        poll.register(self._read, select.POLLIN)
        poll.poll(seconds * 1000)
        with contextlib.suppress(BlockingIOError):
            os.read(self._read, WAKEUPS_MAX)
        return self.received is not None

    def __enter__(self) -> Self:
        """Take over the signals. Only the main thread can."""
        self._former_wakeup = signal.set_wakeup_fd(self._write, warn_on_full_buffer=False)
        self._former = {signum: signal.signal(signum, self._handle) for signum in stopping()}
        return self

    def __exit__(self, *_details: object) -> None:
        for signum, handler in self._former.items():
            signal.signal(signum, handler)
        signal.set_wakeup_fd(self._former_wakeup)
        os.close(self._read)
        os.close(self._write)

    def _handle(self, signum: int, _frame: FrameType | None) -> None:
        self.received = signal.Signals(signum)
