"""What both CAN formats share: counters, and the measured period."""

from __future__ import annotations

import statistics
from collections import deque
from dataclasses import dataclass
from typing import Final

from graspd.drivers.base import DriverCounters

PERIODS_KEPT: Final = 15
PERIODS_NEEDED: Final = 5
"""The period is the median of the last 15 and known after 5."""
OUTAGE_NS: Final = 2_000_000_000
"""A gap of more, ns, counts as one missed reading: the number of sweeps in it is unknown."""


@dataclass(slots=True)
class CanCounters(DriverCounters):
    """Counters of frames, sweeps and the bus."""

    lost_frames: int = 0
    """Frames with electrodes that did not come although others of their sweep did."""
    duplicate_frames: int = 0
    """Frames that came again; the copy is dropped."""
    reordered_frames: int = 0
    """Frames that came in time for their sweep, but after a later one."""
    late_frames: int = 0
    """Frames that came when their sweep was over; dropped."""
    unsynchronised_frames: int = 0
    """Frames dropped after opening, or after a known loss, until a sweep began."""
    untimed_frames: int = 0
    """Samples dropped as the loop stalled and the bus does not stamp them."""
    unexpected_channels: int = 0
    """Samples of a channel that the configured sequence does not have."""
    interrupted_sweeps: int = 0
    """Sweeps dropped because the link broke in the middle."""
    cut_sweeps: int = 0
    """Sweeps ended in the middle because frames were known to be lost there."""
    restarts: int = 0
    """Restarts of the device's sweep counter or clock."""
    contradicting_frames: int = 0
    """Frames with the number of the sweep at hand and another tick; dropped."""
    parity_words: int = 0
    """Response words with a byte of even parity."""
    error_words: int = 0
    unplugged_words: int = 0
    """Response words of a line that nothing drives, or of a sensor that is reported absent."""
    frames: int = 0
    """Frames of every kind that the bus brought."""
    accepted_frames: int = 0
    """Of these, samples or sweep frames of our sensors, before duplicates and losses."""
    foreign_frames: int = 0
    """Frames with another arbitration id; without one, frames that are no sound sample."""
    remote_frames: int = 0
    error_frames: int = 0
    """Frames in which the controller reports trouble on the bus."""
    wrong_length_frames: int = 0
    """Our arbitration id, another length than configured."""
    unknown_commands: int = 0
    """Our arbitration id, but the first byte samples no channel."""
    unknown_versions: int = 0
    """Sweep frames of another layout version."""
    malformed_frames: int = 0
    """Our arbitration id, contents that the format forbids."""
    stuck_ticks: int = 0
    """Sweep frames of a new sweep with the tick of the sweep before; their words are `HELD`."""
    overruns: int = 0
    """Sweep frames that report a sweep that began late."""
    controller_overflows: int = 0
    """Error frames that report a receive overflow of the controller."""
    kernel_drops: int = 0
    """Frames that the kernel dropped because the socket's buffer was full (socketcan only)."""
    bus_off: int = 0
    """Times that the controller left the bus after too many errors."""
    bus_faults: int = 0
    """Failures of the bus or of python-can, opening it included."""
    link_losses: int = 0
    """Times that the link was up and was lost."""


class SweepPeriod:
    """The time between sweeps, as measured."""

    def __init__(self) -> None:
        self._gaps_ns: deque[int] = deque(maxlen=PERIODS_KEPT)
        self.period_ns: int | None = None
        """None until it is known."""

    def learn(self, gap_ns: int) -> None:
        """Take the time between two sweeps in a row, unless it is an outage."""
        if 0 < gap_ns <= OUTAGE_NS:
            self._gaps_ns.append(gap_ns)
        if len(self._gaps_ns) >= PERIODS_NEEDED:
            self.period_ns = round(statistics.median(self._gaps_ns))

    def forget(self) -> None:
        """Drop a period that may be one of lost sweeps."""
        self._gaps_ns.clear()
        self.period_ns = None
