"""What the loop does when readings come faster than it can judge them: leave out, rest, say so.

Judging all that piles up would make every verdict one on the past, and a loop that finds work in
each round would never sleep: one in realtime would take the whole processor, until the kernel ends
it (RLIMIT_RTTIME).
"""

from __future__ import annotations

import logging
import time
from collections import deque
from collections.abc import Callable
from typing import Final

import msgspec
import numpy as np

from drivers.base import ElectrodeFault, TactileReading

WAIT_MAX_NS: Final = 10_000_000
"""What is there at once is judged one by one if that takes so long at most, ns, or a period."""
COSTS: Final = 4
"""What judging a reading takes is the least of the last four times: a stall is none of it."""
LASTING_NS: Final = 3_000_000_000
APART_NS: Final = 1_000_000_000
"""What leaves readings out for so long, ns, at most a second apart, is overload and no stall."""
OVER_NS: Final = 5_000_000_000
"""So long without a reading left out, ns, and the overload is over."""
REST_AFTER_NS: Final = 10_000_000
REST_AFTER_RECORDED_NS: Final = 1_000_000_000
"""So long at work without a wait, ns, and the loop sleeps: seldom where nobody else waits."""
REST_SHARE: Final = 10
REST_MAX_NS: Final = 5_000_000
"""It sleeps for a tenth of that time: in realtime, the kernel takes 5 % away in one go if nothing
is left to others (sched(7), sched_rt_runtime_us)."""

log = logging.getLogger("graspd")


class Overload:
    """Decides when readings are left out, and notices when that lasts."""

    def __init__(
        self, now_ns: int, *, live: bool, sleep: Callable[[float], None] = time.sleep
    ) -> None:
        """`live` readings come whether they are judged or not; of a recording none is left out.

        `sleep` takes seconds, and must have the kernel put this thread to sleep.
        """
        self._live = live
        self._sleep = sleep
        self._rest_after_ns = REST_AFTER_NS if live else REST_AFTER_RECORDED_NS
        self._rested_ns = now_ns
        self._costs_ns: deque[int] = deque(maxlen=COSTS)
        self._skipping_since_ns = self._skipped_ns = now_ns - APART_NS
        self.skipped_readings = 0
        """Tactile readings that were left out since the start."""
        self.overloaded = False
        """Whether that lasts, or did within `OVER_NS`."""

    def waited(self, now_ns: int) -> None:
        """The loop had nothing to do and has slept until now."""
        self._rested_ns = now_ns
        self._look_for_the_end(now_ns)

    def rest(self, now_ns: int) -> None:
        """Sleep a little if the loop has been at work for long, whatever there is to do."""
        worked_ns = now_ns - self._rested_ns
        if worked_ns >= self._rest_after_ns:
            self._sleep(min(worked_ns // REST_SHARE, REST_MAX_NS) / 1e9)
            self._rested_ns = now_ns
        self._look_for_the_end(now_ns)

    def is_too_much(self, waiting: int, elapsed_ns: int, period_ns: int | None) -> bool:
        """Whether, of so many readings that wait, only the newest is to be judged.

        They came at once, `elapsed_ns` ago; `period_ns` is the time between readings, if known.
        """
        if waiting < 2 or not self._live:
            return False
        cost_ns = min(self._costs_ns, default=0)
        return elapsed_ns + waiting * cost_ns > max(WAIT_MAX_NS, period_ns or 0)

    def judged(self, took_ns: int) -> None:
        """A reading was judged and reported, which took so long."""
        self._costs_ns.append(took_ns)

    def skip(self, readings: int, now_ns: int) -> None:
        """Readings are left out."""
        self.skipped_readings += readings
        if now_ns - self._skipped_ns >= APART_NS:
            self._skipping_since_ns = now_ns
        self._skipped_ns = now_ns
        if not self.overloaded and now_ns - self._skipping_since_ns >= LASTING_NS:
            self.overloaded = True
            log.warning("overloaded: readings come faster than they are judged; some are left out")

    def _look_for_the_end(self, now_ns: int) -> None:
        if self.overloaded and now_ns - self._skipped_ns >= OVER_NS:
            self.overloaded = False
            log.info("overload is over: %d readings left out since start", self.skipped_readings)


def after(skipped: TactileReading, newest: TactileReading) -> TactileReading:
    """The newest reading, as it is to be judged when the one before it is not.

    Fingers that only repeat what they read before, as far as both were read, are held, as the judge
    would have seen.
    """
    sound = (newest.faults | skipped.faults) == 0
    differs = newest.counts != skipped.counts
    held = sound.any(axis=1) & ~(differs & sound).any(axis=1)
    if not held.any():
        return newest
    faults = newest.faults | np.uint8(ElectrodeFault.HELD) * (sound & held[:, np.newaxis])
    return msgspec.structs.replace(newest, faults=faults)
