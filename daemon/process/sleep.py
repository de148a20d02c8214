"""Whether the computer has slept: the monotonic clock stands still then, and what is old looks
fresh afterwards."""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial

SLEPT_NS = 50_000_000
"""By which the clocks must move apart, ns: a sleep takes seconds, the scheduler a moment between
two looks at the clocks."""

LOOKS = 3
"""At the start, so that one of them is not interrupted."""


boottime_ns = partial(time.clock_gettime_ns, time.CLOCK_BOOTTIME)
"""ns since the computer was started, those that it slept included (clock_gettime(2))."""


class Sleep:
    """Tells whether the computer has slept since this object was made."""

    def __init__(
        self,
        clock: Callable[[], int] = time.monotonic_ns,
        boot_clock: Callable[[], int] = boottime_ns,
    ) -> None:
        """Both give ns; only `boot_clock` goes on in a sleep."""
        self._clock = clock
        self._boot_clock = boot_clock
        # In this order a look that the scheduler interrupts takes no sleep for granted.
        self._slept_from_ns = SLEPT_NS + max(boot_clock() - clock() for _ in range(LOOKS))

    def has_slept(self) -> bool:
        """True once the computer has slept. Takes a microsecond."""
        return self._boot_clock() - self._clock() > self._slept_from_ns
