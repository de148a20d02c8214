"""Latency statistics in constant memory."""

from __future__ import annotations

import math

STEP = 1.02
"""Ratio of neighbouring bucket bounds: a percentile is right to 2 %."""
FLOOR_US = 0.1
BUCKETS = math.ceil(math.log(1e8 / FLOOR_US) / math.log(STEP)) + 1
"""Enough to reach 100 s."""


class LatencyHistogram:
    """Counts durations in buckets of equal ratio, so that a year of readings needs no more room."""

    def __init__(self) -> None:
        self.buckets = [0] * BUCKETS
        """Durations in each bucket, the shortest first."""
        self.count = 0
        self.max_us = 0.0

    def add(self, duration_us: float) -> None:
        """Count one duration, us."""
        index = 0
        if duration_us > FLOOR_US:
            index = int(math.log(duration_us / FLOOR_US) / _LOG_STEP)
        self.buckets[index if index < BUCKETS else -1] += 1
        self.count += 1
        if duration_us > self.max_us:
            self.max_us = duration_us

    def quantile_us(self, fraction: float) -> float:
        """Duration, us, that `fraction` of all stay at or below, to 2 %; 0 if there is none."""
        wanted = math.ceil(fraction * self.count)
        seen = 0
        for index, number in enumerate(self.buckets):
            seen += number
            if seen >= wanted and number:
                return min(FLOOR_US * STEP ** (index + 1), self.max_us)
        return 0.0


_LOG_STEP = math.log(STEP)
