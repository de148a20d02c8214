"""Shared parts of both CAN formats: counters, and the measured period."""

from __future__ import annotations

import statistics
from collections import deque
from dataclasses import dataclass
from typing import Final

from graspd.drivers.base import DriverCounters
from graspd.drivers.link import OUTAGE_NS

PERIODS_KEPT: Final = 15
PERIODS_NEEDED: Final = 5
"""Measured periods after which the period is known; it is the median of the last 15."""


@dataclass(slots=True)
class CanCounters(DriverCounters):
    """Counters of frames, sweeps and the bus."""

    lost_frames: int = 0
    """Frames that never came, although others of their sweep did."""
    duplicate_frames: int = 0
    reordered_frames: int = 0
    """Frames that came in time for their sweep, but after a later one."""
    late_frames: int = 0
    """Frames that came when their sweep was over; dropped."""
    unsynchronised_frames: int = 0
    """Frames dropped after opening or a known loss, until a sweep began."""
    untimed_frames: int = 0
    """Samples dropped because the loop stalled and the bus has no stamps."""
    unexpected_channels: int = 0
    """Samples of a channel that the configured sequence does not have."""
    interrupted_sweeps: int = 0
    """Sweeps dropped because the link broke in the middle."""
    cut_sweeps: int = 0
    """Sweeps ended in the middle because frames were known to be lost there."""
    restarts: int = 0
    """Restarts of the device's sweep counter or clock."""
    contradicting_frames: int = 0
    """Frames with the current sweep's number and another tick; dropped."""
    parity_words: int = 0
    error_words: int = 0
    unplugged_words: int = 0
    """Response words of a line that no sensor drives, or of a sensor reported as absent."""
    frames: int = 0
    accepted_frames: int = 0
    """Samples or sweep frames of the configured sensors, duplicates included."""
    foreign_frames: int = 0
    """Frames with another arbitration id; while the id is unknown, frames without counts."""
    remote_frames: int = 0
    error_frames: int = 0
    """Frames in which the controller reports trouble on the bus."""
    wrong_length_frames: int = 0
    unknown_commands: int = 0
    """Frames with the right id whose first byte samples no channel."""
    unknown_versions: int = 0
    malformed_frames: int = 0
    """Frames with the right id whose contents the format forbids."""
    stuck_ticks: int = 0
    """Frames of a new sweep with the tick of the sweep before; their words are `HELD`."""
    overruns: int = 0
    """Sweep frames that say that their sweep began late."""
    controller_overflows: int = 0
    """Error frames that say that the controller's receive buffer overflowed."""
    kernel_drops: int = 0
    """Frames that the kernel dropped because the socket's buffer was full (socketcan only)."""
    bus_off: int = 0
    bus_faults: int = 0
    """Failures of the bus or of python-can, also when opening it."""
    link_losses: int = 0


class SweepPeriod:
    """Measured time between sweeps."""

    def __init__(self) -> None:
        self._gaps_ns: deque[int] = deque(maxlen=PERIODS_KEPT)
        self.period_ns: int | None = None

    def learn(self, gap_ns: int) -> None:
        """Add the time between two sweeps in a row; an outage is ignored."""
        if 0 < gap_ns <= OUTAGE_NS:
            self._gaps_ns.append(gap_ns)
        if len(self._gaps_ns) >= PERIODS_NEEDED:
            self.period_ns = round(statistics.median(self._gaps_ns))

    def forget(self) -> None:
        """Forget the period, which may be that of lost sweeps."""
        self._gaps_ns.clear()
        self.period_ns = None
