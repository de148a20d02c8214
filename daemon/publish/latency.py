"""Delays of readings and verdicts, counted in constant memory."""

from __future__ import annotations

import math

from drivers.base import TactileReading

STEP = 1.02
"""Ratio of neighbouring bucket bounds: a percentile is right to 2 %."""
FLOOR_US = 0.1
BUCKETS = math.ceil(math.log(1e8 / FLOOR_US) / math.log(STEP)) + 1
"""Enough to reach 100 s."""
OUTAGE_PERIODS = 10
"""A gap of this many periods is an outage, which is reported as silence and is no jitter."""


class LatencyHistogram:
    """Counts durations in buckets of equal ratio: a year of readings needs no more memory."""

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
        """Return the duration, us, that `fraction` of all do not exceed, to 2 %; 0 if empty."""
        rank = math.ceil(fraction * self.count)
        below = 0
        for index, durations in enumerate(self.buckets):
            below += durations
            if below >= rank and durations:
                return min(FLOOR_US * STEP ** (index + 1), self.max_us)
        return 0.0


class Deadlines:
    """Counts late readings and jitter since the start."""

    def __init__(self) -> None:
        self.jitter = LatencyHistogram()
        """How far, us, the time between two readings in a row is from the driver's period."""
        self.late = 0
        """Readings that were answered more than a period after their last byte."""
        self.worst_age_ms = 0.0
        """Longest time from a reading's last byte to its verdict, ms."""
        self._last_seq = -1
        self._last_ns = 0

    def add(self, reading: TactileReading, age_ms: float, period_ns: int | None) -> None:
        """Count a reading, answered `age_ms` after its last byte, of a driver with this period."""
        if age_ms > self.worst_age_ms:
            self.worst_age_ms = age_ms
        if period_ns is not None:
            self.late += age_ms * 1e6 > period_ns
            elapsed_ns = reading.t_ns - self._last_ns
            in_a_row = reading.seq == self._last_seq + 1 and self._last_seq >= 0
            if in_a_row and elapsed_ns < OUTAGE_PERIODS * period_ns:
                self.jitter.add(abs(elapsed_ns - period_ns) / 1e3)
        self._last_seq, self._last_ns = reading.seq, reading.t_ns


_LOG_STEP = math.log(STEP)
