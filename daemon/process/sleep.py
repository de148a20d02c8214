"""Detect sleep of the computer. The monotonic clock stops in it, so old readings look new."""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial

SLEPT_NS = 50_000_000
"""Smallest difference of the clocks that counts as sleep, ns; the scheduler causes less."""
LOOKS = 3
"""Number of times that the clocks are compared at the start; some comparisons are interrupted."""

boottime_ns = (
    partial(time.clock_gettime_ns, time.CLOCK_BOOTTIME)
    if hasattr(time, "CLOCK_BOOTTIME")
    else time.monotonic_ns
)
"""Time since the computer was started, ns, sleep included (clock_gettime(2)).

Elsewhere than on Linux: the monotonic clock, which may leave sleep out."""


class Sleep:
    """Detector of a sleep of the computer since this object was made."""

    def __init__(
        self,
        clock: Callable[[], int] = time.monotonic_ns,
        boot_clock: Callable[[], int] = boottime_ns,
    ) -> None:
        """`clock`, `boot_clock`: functions that return ns; only the second runs on in a sleep."""
        self._clock = clock
        self._boot_clock = boot_clock
        # In this order an interruption by the scheduler does not look like a sleep.
        self._slept_from_ns = SLEPT_NS + max(boot_clock() - clock() for _ in range(LOOKS))

    def has_slept(self) -> bool:
        return self._boot_clock() - self._clock() > self._slept_from_ns
