"""Waits for any number of descriptors, and no longer than told to the microsecond."""

from __future__ import annotations

import ctypes
import os
import select
import time

NS_PER_S = 1_000_000_000
ABSOLUTE = 1
"""TFD_TIMER_ABSTIME of timerfd_settime(2), which Python has from 3.13 on."""

Ready = list[tuple[int, int]]
"""Descriptors and what they are ready for, as poll(2) says it."""


class _TimerSpec(ctypes.Structure):
    """`struct itimerspec`: the period, none, and when the timer expires."""

    _fields_ = tuple((name, ctypes.c_long) for name in ("every_s", "every_ns", "at_s", "at_ns"))
    at_s: int
    at_ns: int


class ExactSelector:
    """poll(2), whose own timeout counts whole milliseconds, with a timer among its descriptors.

    Unlike select(2) it knows descriptors above 1024, and its waits are not lengthened by the slack
    that the kernel gives ordinary threads, 50 us. Unlike epoll(7) it takes a descriptor for what it
    is now: a driver that closes a device and opens it again within a round mostly gets the same
    number, which epoll would never hear of again.

    The timer is set only where it would come too late or has come already: to set it costs more
    than to wait.
    """

    def __init__(self) -> None:
        """Where the process has no descriptor left for the timer, waits are whole milliseconds."""
        self._poll = select.poll()
        self.register, self.unregister = self._poll.register, self._poll.unregister
        libc = ctypes.CDLL(None)
        self._set = libc.timerfd_settime
        self._set.argtypes = (ctypes.c_int, ctypes.c_int, ctypes.c_void_p, ctypes.c_void_p)
        self._spec = _TimerSpec()
        self._due_ns: int | None = None
        """When the timer comes, or has come before that was seen; None: it is not set."""
        self._timer: int = libc.timerfd_create(time.CLOCK_MONOTONIC, os.O_NONBLOCK | os.O_CLOEXEC)
        if self._timer >= 0:
            self._poll.register(self._timer, select.POLLIN)

    def select(self, timeout: float | None = None) -> Ready:
        """What is ready, once anything is, after `timeout` s at the latest; None: no limit."""
        if self._timer < 0 or (timeout is not None and timeout <= 0):
            return self._others(self._poll.poll(None if timeout is None else max(timeout, 0) * 1e3))
        due_ns = None if timeout is None else time.monotonic_ns() + round(timeout * NS_PER_S)
        while True:
            if due_ns is not None and (self._due_ns is None or due_ns < self._due_ns):
                self._arm(due_ns)
            ready = self._poll.poll()
            others = self._others(ready)
            # Without any, a signal has come, or the timer, which may be that of an earlier wait.
            if others or not ready or (due_ns is not None and time.monotonic_ns() >= due_ns):
                return others

    def _arm(self, due_ns: int) -> None:
        self._due_ns = due_ns
        self._spec.at_s, self._spec.at_ns = divmod(due_ns, NS_PER_S)
        self._set(self._timer, ABSOLUTE, ctypes.addressof(self._spec), None)

    def _others(self, ready: Ready) -> Ready:
        """What is ready but the timer; that is set anew before it is waited for again."""
        others = [each for each in ready if each[0] != self._timer]
        if len(others) != len(ready):
            self._due_ns = None
        return others

    def close(self) -> None:
        """Close it, but none of the descriptors that were registered."""
        if self._timer >= 0:
            os.close(self._timer)
            self._timer = -1
