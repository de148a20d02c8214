"""SIGINT, SIGTERM and SIGHUP as a socket that a selector can wait on."""

from __future__ import annotations

import contextlib
import selectors
import signal
import socket
from types import FrameType
from typing import Any, Self

WAKEUPS_MAX = 4096
"""Most bytes that are read at once; each signal is one byte."""
HANGUP: signal.Signals | None = getattr(signal, "SIGHUP", None)
"""SIGHUP, where the system has it."""


def stopping() -> list[signal.Signals]:
    """Return the signals that stop the process, without SIGHUP if `nohup` has it ignored."""
    if HANGUP is None or signal.getsignal(HANGUP) is signal.SIG_IGN:
        return [signal.SIGINT, signal.SIGTERM]
    return [signal.SIGINT, signal.SIGTERM, HANGUP]


class StopSignal:
    """Handler that records the last signal that asked the process to stop."""

    def __init__(self) -> None:
        self.received: signal.Signals | None = None
        self._former: dict[signal.Signals, Any] = {}
        self._former_wakeup = -1
        self._read, self._write = socket.socketpair()
        self._read.setblocking(False)
        self._write.setblocking(False)

    def fileno(self) -> int:
        """Return a descriptor that becomes readable when a signal arrives."""
        return self._read.fileno()

    def wait(self, seconds: float) -> bool:
        """Wait up to `seconds` for a signal; return True if one asked to stop, now or before."""
        with selectors.DefaultSelector() as selector:
            selector.register(self._read, selectors.EVENT_READ)
            selector.select(seconds)
        with contextlib.suppress(BlockingIOError):
            self._read.recv(WAKEUPS_MAX)
        return self.received is not None

    def __enter__(self) -> Self:
        """Handle the signals until `__exit__`. Only the main thread can."""
        self._former_wakeup = signal.set_wakeup_fd(self._write.fileno(), warn_on_full_buffer=False)
        self._former = {signum: signal.signal(signum, self._handle) for signum in stopping()}
        return self

    def __exit__(self, *_details: object) -> None:
        for signum, handler in self._former.items():
            signal.signal(signum, handler)
        signal.set_wakeup_fd(self._former_wakeup)
        self._read.close()
        self._write.close()

    def _handle(self, signum: int, _frame: FrameType | None) -> None:
        self.received = signal.Signals(signum)
