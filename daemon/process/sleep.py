"""Sleep of the computer: the monotonic clock stands still then, and old readings look fresh."""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial

SLEPT_NS = 50_000_000
"""Least difference of the clocks that is a sleep, ns: the scheduler takes less."""
LOOKS = 3
"""Looks at the clocks at the start: the scheduler interrupts at most some."""

boottime_ns = partial(time.clock_gettime_ns, time.CLOCK_BOOTTIME)
"""Time since the computer was started, ns, with its sleep (clock_gettime(2))."""


class Sleep:
    """Notices that the computer has slept since this object was made."""

    def __init__(
        self,
        clock: Callable[[], int] = time.monotonic_ns,
        boot_clock: Callable[[], int] = boottime_ns,
    ) -> None:
        """Only `boot_clock` goes on in a sleep; both give ns."""
        self._clock = clock
        self._boot_clock = boot_clock
        # In this order a look that the scheduler interrupts makes no sleep.
        self._slept_from_ns = SLEPT_NS + max(boot_clock() - clock() for _ in range(LOOKS))

    def has_slept(self) -> bool:
        return self._boot_clock() - self._clock() > self._slept_from_ns
