"""Realtime mode: priority, processors, locked memory, no garbage collection while judging."""

from __future__ import annotations

import ctypes
import gc
import logging
import os
from contextlib import suppress
from typing import Self

from graspd.daemon.publish.companion import Companion
from graspd.daemon.publish.messages import Status
from graspd.daemon.scene.scene import Realtime

log = logging.getLogger("graspd")

MCL_CURRENT, MCL_FUTURE, MCL_ONFAULT = 1, 2, 4
CAP_IPC_LOCK = 14
"""Bit of the capability to lock any amount of memory (linux/capability.h)."""


class RealtimeMode(Companion):
    """Run the process in realtime from `__enter__` to `__exit__`.

    Only the loop's thread gets the priority, not libzmq's threads, which copy messages. One warning
    lists everything that the system refuses.
    """

    def __init__(self, options: Realtime) -> None:
        self._options = options
        self._processors = os.sched_getaffinity(0)
        self.lacking: dict[str, str] = {}
        """Refused parts of realtime mode, each with advice on how to allow it."""

    def __enter__(self) -> Self:
        """Set this thread's priority; pin the process, lock its memory, stop garbage collection."""
        options = self._options
        if options.cpus is not None:
            self._pin(set(options.cpus))
        self._lock()
        if options.priority is not None:
            self._raise(options.priority)
        gc.collect()
        gc.freeze()
        gc.disable()
        if self.lacking:
            refused = (f"{what} ({advice})" for what, advice in self.lacking.items())
            log.warning("not quite realtime: %s", "; ".join(refused))
        return self

    def __exit__(self, *_details: object) -> None:
        gc.enable()
        gc.unfreeze()
        with suppress(OSError):
            os.sched_setscheduler(0, os.SCHED_OTHER | os.SCHED_RESET_ON_FORK, os.sched_param(0))
        for thread in _threads():
            with suppress(OSError):
                os.sched_setaffinity(thread, self._processors)
        _libc().munlockall()

    def on_status(self, status: Status) -> None:
        """Collect garbage, once a second."""
        gc.collect()

    def _pin(self, processors: set[int]) -> None:
        try:
            for thread in _threads():
                os.sched_setaffinity(thread, processors)
        except OSError as error:
            have = ", ".join(map(str, sorted(self._processors)))
            self.lacking[f"realtime.cpus: {error.strerror}"] = f"there are {have}"

    def _raise(self, priority: int) -> None:
        try:
            # The flag gives threads started later ordinary priority. Only root may clear it.
            policy = os.SCHED_FIFO | os.SCHED_RESET_ON_FORK
            os.sched_setscheduler(0, policy, os.sched_param(priority))
        except OSError as error:
            self.lacking[f"realtime.priority {priority}: {error.strerror}"] = (
                f"grant LimitRTPRIO={priority} in the unit, or `rtprio {priority}` in limits.conf"
            )

    def _lock(self) -> None:
        import resource  # not everywhere; `graspd check` loads this module

        # With a limit, later allocations would fail, which is worse than unlocked memory.
        unlimited = resource.getrlimit(resource.RLIMIT_MEMLOCK)[0] == resource.RLIM_INFINITY
        problem = "limited"
        if unlimited or _may_lock():
            # Only used pages are locked: most of a library of 20 MB is never used.
            if _libc().mlockall(MCL_CURRENT | MCL_FUTURE | MCL_ONFAULT) == 0:
                return
            problem = os.strerror(ctypes.get_errno())
        self.lacking[f"locked memory: {problem}"] = (
            "grant LimitMEMLOCK=infinity in the unit, or `memlock unlimited` in limits.conf"
        )


def _threads() -> list[int]:
    return [int(name) for name in os.listdir("/proc/self/task")]


def _may_lock() -> bool:
    with open("/proc/self/status", encoding="utf-8") as file:
        effective = next((line for line in file if line.startswith("CapEff:")), "CapEff: 0")
    return bool(int(effective.split()[1], 16) >> CAP_IPC_LOCK & 1)


def _libc() -> ctypes.CDLL:
    return ctypes.CDLL(None, use_errno=True)
