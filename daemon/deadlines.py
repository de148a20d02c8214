"""Whether readings come when they should, and are answered in time."""

from __future__ import annotations

from daemon.latency import LatencyHistogram
from drivers.base import TactileReading


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
        self.worst_age_ms = max(self.worst_age_ms, age_ms)
        if period_ns is not None:
            self.late += age_ms * 1e6 > period_ns
            if reading.seq == self._last_seq + 1 and self._last_seq >= 0:
                self.jitter.add(abs(reading.t_ns - self._last_ns - period_ns) / 1e3)
        self._last_seq, self._last_ns = reading.seq, reading.t_ns
