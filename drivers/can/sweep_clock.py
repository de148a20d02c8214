"""Measure the time between sweeps, and tell by its time whether a sample fits the current sweep.

A sample is a place among the electrodes of a sequence, 0 to 23, and a time, ns.
"""

from __future__ import annotations

import statistics
from collections import deque
from collections.abc import Sequence
from enum import Enum, auto
from typing import Final

from graspd.biotac import ELECTRODES
from graspd.drivers.link import OUTAGE_NS

NEXT_SWEEP_PERIODS: Final = 0.75
"""Delay, in periods, from which on a sample belongs to another sweep.

A loss of whole sweeps delays a sample by one period or more. The limit is lower to be safe: a
sweep that is cut without need is flagged, but a mixture of two sweeps would not be.
"""
SLOT_MIN_NS: Final = 100_000
"""Shortest time between samples, ns: 103 bits at 1 Mbit/s, as on the fastest board."""
ARRIVAL_JITTER_NS: Final = 5_000_000
"""Delay of a sweep, ns, up to which no sweep counts as missed."""
EVEN_SHARE: Final = 1 / 3
"""Share of the time between the ends of two sweeps. If no gap between samples is as long, no sweep
was lost between them; a lost one makes a gap of at least half."""
PERIODS_KEPT: Final = 15
PERIODS_NEEDED: Final = 5
"""Number of measured periods after which the period is known, as the median of the last 15."""


class Timing(Enum):
    """Relation of a sample's time to the current sweep."""

    EARLY = auto()
    """Too early for the current sweep."""
    FITS = auto()
    LATE = auto()
    """The sample may be too late for the current sweep."""


class SweepClock:
    """Times of the sweeps of one board; `period_ns` is None until it is known."""

    def __init__(self, slots: Sequence[int], samples: int) -> None:
        """`samples`: number of samples of a sweep. `slots`: index in the sweep of the sample of
        each place, rising."""
        self.period_ns: int | None = None
        self.t_ns = 0
        """Time of the last sample of the current sweep."""
        self._position = [slot / samples for slot in slots]
        self._shortest_ns = samples * SLOT_MIN_NS
        self._late_ns = NEXT_SWEEP_PERIODS * self._shortest_ns
        """Delay from which on a sample belongs to another sweep, ns."""
        self._gaps_ns: deque[int] = deque(maxlen=PERIODS_KEPT)
        self._origin_ns = 0.0
        """Start of the current sweep, ns, computed from its most punctual sample."""
        self._start_ns: int | None = None
        """Start of the sweep before, ns; None: not known."""
        self._end_ns: int | None = None
        self._at_ns = 0
        self._widest_ns = 0
        """Longest time between two samples since the last `learn_end`, ns."""
        self._is_torn = False
        """True if a sweep without its last sample was ended since the last `learn_end`."""
        self.interrupt()

    def interrupt(self) -> None:
        """Forget the last sample, and whether the board pauses between sweeps; keep `period_ns`.
        Call after the link broke."""
        self._is_steady = False
        """True if the board sweeps without a pause."""
        self.cut()

    def cut(self) -> None:
        """Forget which sample was last. Call after a known loss."""
        self._seen = -1
        self._run = 0
        """Number of samples in a row without a gap in their order."""

    def follow(self, place: int, t_ns: int) -> bool:
        """Note any sample; return True if its place shows a new sweep since the sample before."""
        begins = place == 0 or place < self._seen
        if place != self._seen:
            follows = place == (self._seen + 1) % ELECTRODES
            self._run = self._run + 1 if follows else 1
            self._seen = place
        if t_ns - self._at_ns > self._widest_ns:
            self._widest_ns = t_ns - self._at_ns
        self._at_ns = t_ns
        return begins

    def is_vague(self, t_ns: int, until_ns: int) -> bool:
        """Return True if a sample that arrived in this range, ns, may belong to either of two
        sweeps."""
        return until_ns - t_ns >= self._late_ns

    def timing(self, place: int, last: int, until_ns: int) -> Timing:
        """Compare the time of a sample at `place`, at latest `until_ns`, with the current sweep.

        `last`: furthest place of the sweep; -1 for none, and then the result does not matter.
        """
        if self.period_ns is None:
            late_ns: float = until_ns - self.t_ns - max(place - last, 0) * SLOT_MIN_NS
            is_early = late_ns < 0
        else:
            late_ns = until_ns - (self._origin_ns + self._position[place] * self.period_ns)
            is_early = -late_ns >= self._late_ns
        if late_ns >= self._late_ns:
            return Timing.LATE
        return Timing.EARLY if is_early else Timing.FITS

    def advance(self, place: int, t_ns: int, *, begins: bool) -> None:
        """Note the time of a sample whose place is the furthest of the current sweep so far.

        `begins`: True if it is the first of the sweep.
        """
        origin_ns = t_ns - self._position[place] * (self.period_ns or 0)
        if begins or origin_ns < self._origin_ns:
            self._origin_ns = origin_ns
        self.t_ns = t_ns

    def next_end_ns(self, last: int, *, is_over: bool) -> int | None:
        """Return when the next reading should be complete; None: not known yet.

        `last`: furthest place of the current sweep, -1 for none. `is_over`: True if its reading was
        handed over.
        """
        if self.period_ns is None or last < 0:
            return None
        left = 1.0 if is_over else self._position[-1] - self._position[last]
        return self.t_ns + round(left * self.period_ns)

    def end(self, last: int) -> int:
        """End a sweep whose furthest place is `last`; return the number of sweeps lost before it.

        The number is 1 after an outage. Two complete sweeps in a row teach the period.
        """
        missed = 0
        period_ns = self.period_ns
        start_ns = self.t_ns - round(self._position[last] * (period_ns or 0))
        if self._start_ns is not None:
            gap_ns = start_ns - self._start_ns
            if gap_ns > OUTAGE_NS:
                missed = 1
            elif period_ns and gap_ns - period_ns >= max(self._late_ns, ARRIVAL_JITTER_NS):
                missed = round(gap_ns / period_ns) - 1
        self._start_ns = start_ns
        if last == ELECTRODES - 1:
            self.learn_end(self.t_ns)
        else:
            self._is_torn = True
        return missed

    def learn_end(self, end_ns: int) -> None:
        """Learn the period from the ends of this sweep and of the one before.

        Samples without a gap in their order count even if the time between them cut the sweep.
        Otherwise a wrong period that cuts every sweep would never be corrected. If the widest gap
        has room for a whole sweep, only a board that always pauses there teaches the period.
        """
        is_usable = not self._is_torn or self._run > ELECTRODES
        if is_usable and self._end_ns is not None:
            gap_ns = end_ns - self._end_ns
            is_even = self._widest_ns < EVEN_SHARE * gap_ns
            if is_even and not self._is_steady:
                self._is_steady = True
                self._learn(None)
            if is_even or not (self._is_torn or self._is_steady):
                self._learn(gap_ns)
        self._is_torn = False
        self._widest_ns = 0
        self._end_ns = end_ns

    def _learn(self, gap_ns: int | None) -> None:
        """Add the time between two sweeps in a row, unless it is an outage; None forgets all."""
        if gap_ns is None:
            self._gaps_ns.clear()
            self.period_ns = None
        elif 0 < gap_ns <= OUTAGE_NS:
            self._gaps_ns.append(gap_ns)
        if len(self._gaps_ns) >= PERIODS_NEEDED:
            self.period_ns = round(statistics.median(self._gaps_ns))
        self._late_ns = NEXT_SWEEP_PERIODS * (self.period_ns or self._shortest_ns)
