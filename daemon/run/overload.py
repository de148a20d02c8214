"""Load shedding: what the loop does when readings arrive faster than it can judge them.

Judging the whole backlog would give verdicts on the past. A realtime loop that never sleeps is
ended by the kernel (RLIMIT_RTTIME).
"""

from __future__ import annotations

import logging
import time
from collections import deque
from collections.abc import Callable
from typing import Final

import msgspec
import numpy as np

from graspd.drivers.base import ElectrodeFault, TactileReading

BACKLOG_MAX_NS: Final = 10_000_000
"""Time to judge a backlog above which readings are skipped, ns; the sensor period if longer."""
COST_SAMPLES: Final = 4
"""Number of latest readings. The shortest time to judge one is expected for the next, so that one
stall does not count."""
REPORT_AFTER_NS: Final = 3_000_000_000
"""Duration of skipping after which overload is reported, ns."""
PAUSE_NS: Final = 1_000_000_000
"""Time without a skipped reading that ends a run of skipping, ns."""
RECOVERED_AFTER_NS: Final = 5_000_000_000
"""Time without a skipped reading, ns, after which the overload is over."""
YIELD_AFTER_NS: Final = 10_000_000
YIELD_AFTER_RECORDED_NS: Final = 1_000_000_000
"""Times without a wait after which the loop yields the processor, ns: live, and in a replay."""
YIELD_SHARE: Final = 10
"""Working time divided by the time of a yield. The kernel would take 5 % of a realtime thread. See
sched(7), sched_rt_runtime_us."""
YIELD_MAX_NS: Final = 5_000_000
"""Longest yield, ns."""

log = logging.getLogger("graspd")


class LoadShedder:
    """Decide which readings to skip, report a lasting overload, and yield the processor."""

    def __init__(
        self, now_ns: int, *, live: bool, sleep: Callable[[float], None] = time.sleep
    ) -> None:
        """`live`: False never skips. `sleep`: puts this thread to sleep, s."""
        self._live = live
        self._sleep = sleep
        self._yield_after_ns = YIELD_AFTER_NS if live else YIELD_AFTER_RECORDED_NS
        self._waited_ns = now_ns
        self._costs_ns: deque[int] = deque(maxlen=COST_SAMPLES)
        self._skipping_since_ns = self._skipped_ns = now_ns - PAUSE_NS
        self.skipped_readings = 0
        self.overloaded = False
        """True once skipping has lasted `REPORT_AFTER_NS`, until `RECOVERED_AFTER_NS` after it."""

    def waited(self, now_ns: int) -> None:
        """Note that the loop waited for input until `now_ns`; end an overload that is over."""
        self._waited_ns = now_ns
        self._check_recovered(now_ns)

    def yield_processor(self, now_ns: int) -> None:
        """Sleep a little if the loop has worked for long; call it after a round without a wait."""
        worked_ns = now_ns - self._waited_ns
        if worked_ns >= self._yield_after_ns:
            self._sleep(min(worked_ns // YIELD_SHARE, YIELD_MAX_NS) / 1e9)
            self._waited_ns = now_ns
        self._check_recovered(now_ns)

    def should_skip(self, backlog: int, age_ns: int, period_ns: int | None) -> bool:
        """Return True if only the newest of `backlog` readings should be judged.

        `age_ns`: time since they arrived. `period_ns`: sensor period; None: not known yet.
        """
        if backlog < 2 or not self._live:
            return False
        cost_ns = min(self._costs_ns, default=0)
        return age_ns + backlog * cost_ns > max(BACKLOG_MAX_NS, period_ns or 0)

    def record_cost(self, cost_ns: int) -> None:
        """Add the time that one reading took to judge and publish."""
        self._costs_ns.append(cost_ns)

    def skip(self, readings: int, now_ns: int) -> None:
        """Add to the number of skipped readings; report an overload if skipping lasts."""
        self.skipped_readings += readings
        if now_ns - self._skipped_ns >= PAUSE_NS:
            self._skipping_since_ns = now_ns
        self._skipped_ns = now_ns
        if not self.overloaded and now_ns - self._skipping_since_ns >= REPORT_AFTER_NS:
            self.overloaded = True
            log.warning("overloaded: readings come faster than they are judged; some are left out")

    def _check_recovered(self, now_ns: int) -> None:
        if self.overloaded and now_ns - self._skipped_ns >= RECOVERED_AFTER_NS:
            self.overloaded = False
            log.info("overload is over: %d readings left out since start", self.skipped_readings)


def mark_repeats(newest: TactileReading, skipped: TactileReading) -> TactileReading:
    """Return `newest` with `HELD` set for each finger that repeats the skipped reading."""
    sound = (newest.faults | skipped.faults) == 0
    differs = newest.counts != skipped.counts
    held = sound.any(axis=1) & ~(differs & sound).any(axis=1)
    if not held.any():
        return newest
    faults = newest.faults | np.uint8(ElectrodeFault.HELD) * (sound & held[:, np.newaxis])
    return msgspec.structs.replace(newest, faults=faults)
