"""Whether readings come when they should, and are answered in time."""

from __future__ import annotations

from daemon.publish.latency import LatencyHistogram
from drivers.base import TactileReading

OUTAGE_PERIODS = 10
"""So long without a reading is an outage and no jitter; it is told as silence."""


class Deadlines:
    """Counts since start; costs no memory that grows."""

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
