"""Combine samples into one `TactileReading` per sweep; missing electrodes are flagged.

Frames have no counter. A sample's command byte names its channel; its place in the order of the
sequence and the time between samples tell its sweep. `deploy/can/PROTOCOL.md` says what becomes of
each loss, copy and delay. No electrode is shifted or filled from memory.
"""

from __future__ import annotations

import statistics
from collections import deque
from collections.abc import Sequence
from typing import Final

import numpy as np

from graspd.drivers.base import ELECTRODES, ElectrodeFault, TactileReading
from graspd.drivers.biotac import E1, E24, make_reading
from graspd.drivers.can.frames import CanCounters
from graspd.drivers.link import OUTAGE_NS

REORDER_MAX: Final = 3
"""Most places by which a sample may be late; adapters with few buffers swap neighbours."""
NEXT_SWEEP_PERIODS: Final = 0.75
"""Delay, in periods, from which a sample belongs to another sweep.

A loss of whole sweeps delays a sample by one period or more. A lower limit is the safe side: a
sweep cut without need is flagged, two sweeps mixed in one reading would not be.
"""
SLOT_MIN_NS: Final = 100_000
"""Shortest time between samples, ns: 103 bits at 1 Mbit/s, as on the fastest board."""
ARRIVAL_JITTER_NS: Final = 5_000_000
"""Delay of a sweep, ns, up to which no sweep counts as missed."""
EVEN_SHARE: Final = 1 / 3
"""Largest gap between two samples without a lost sweep, in periods; a lost one takes half."""
PERIODS_KEPT: Final = 15
PERIODS_NEEDED: Final = 5
"""Measured periods after which the period is known; it is the median of the last 15."""

_ALL: Final = (1 << ELECTRODES) - 1


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


class SampleAssembler:
    """Combine single samples, sent in the order of a sequence, into sweeps."""

    def __init__(
        self,
        sensors: int,
        sequence: Sequence[int],
        counters: CanCounters,
        rows: Sequence[int],
    ) -> None:
        """`sequence`: one of `SEQUENCES`. `sensors`: number of words in a sample.

        `rows`: number of each row's sensor, from 0.
        """
        electrodes = [channel for channel in sequence if E1 <= channel <= E24]
        self._place = {channel: place for place, channel in enumerate(electrodes)}
        self._others = frozenset(sequence) - set(electrodes)
        self._electrodes = np.array(electrodes, dtype=np.intp) - E1
        self._position = [sequence.index(channel) / len(sequence) for channel in electrodes]
        self._samples = len(sequence)
        self._sensors = sensors
        self._rows = np.array(rows, dtype=np.intp)
        self._width = 2 * sensors
        self._period = SweepPeriod()
        self._counters = counters
        self._buffer = bytearray(ELECTRODES * self._width)
        self._previous_start_ns: int | None = None
        self._previous_end_ns: int | None = None
        self._seen = -1
        self._at_ns = 0
        self._widest_ns = 0
        self._broken = False
        self._origin_ns = 0.0
        self._interrupted = False
        self._forget()

    def _forget(self) -> None:
        self._synchronised = False
        self._is_steady = False
        """True if the board sweeps without a pause."""
        self._previous_had = _ALL
        self._run = 0
        self._begin()

    @property
    def period_ns(self) -> int | None:
        return self._period.period_ns

    @property
    def expected_ns(self) -> int | None:
        """Time when the next reading should be complete, ns; None: not known yet."""
        period_ns = self._period.period_ns
        if period_ns is None or self._last < 0:
            return None
        left = 1.0 if self._finished else self._position[-1] - self._position[self._last]
        return self._t_ns + round(left * period_ns)

    def push(
        self, channel: int, words: bytes, t_ns: int, until_ns: int | None = None
    ) -> Sequence[TactileReading]:
        """Add a sample; return the readings that it completes, oldest first.

        `words`: response word of each sensor, two bytes each. The sample arrived at `t_ns`, or
        between `t_ns` and `until_ns` if that is given; too wide a range makes it useless.
        """
        place = self._place.get(channel)
        if place is None:
            self._counters.unexpected_channels += channel not in self._others
            return ()
        self._count_run(place, t_ns)
        if until_ns is None:
            until_ns = t_ns
        elif until_ns - t_ns >= self._lateness_ns():
            return self._untimed(place, t_ns)
        if not self._synchronised and not self._starts(place):
            self._counters.unsynchronised_frames += 1
            return ()
        if place > self._last and not self._is_next_sweep(place, until_ns):
            if self._is_tail_of_previous(place):
                if not self._previous_had >> place & 1:
                    self._counters.late_frames += 1
                    return ()
                if self._holds(place, words):
                    self._counters.duplicate_frames += 1
                    return ()
                if self._is_early(place, until_ns):
                    self._counters.late_frames += 1
                    return ()
            return self._store(place, words, t_ns)
        if self._repeats(place, words, t_ns, until_ns):
            return ()
        finished = self._finish()
        self._begin()
        return (*finished, *self._store(place, words, t_ns))

    def cut(self) -> Sequence[TactileReading]:
        """End the current sweep. Call when an unknown number of samples was lost."""
        self._counters.cut_sweeps += not self._finished and self._have != 0
        self._run = 0
        finished = self._finish()
        self._synchronised = False
        self._begin()
        return finished

    def interrupt(self) -> None:
        """Drop the current sweep. Call after the link broke."""
        self._counters.interrupted_sweeps += not self._finished and self._have != 0
        self._interrupted = self._previous_start_ns is not None
        self._forget()

    def _count_run(self, place: int, t_ns: int) -> None:
        """Count samples in a row without a gap, and keep the widest time between two."""
        if place != self._seen:
            follows = place == (self._seen + 1) % ELECTRODES
            self._run = self._run + 1 if follows else 1
            self._seen = place
        self._widest_ns = max(self._widest_ns, t_ns - self._at_ns)
        self._at_ns = t_ns

    def _begin(self) -> None:
        self._have = 0
        self._last = -1
        self._finished = False

    def _starts(self, place: int) -> bool:
        self._synchronised = place == 0 or place < self._last
        self._last = -1 if self._synchronised else place
        return self._synchronised

    def _untimed(self, place: int, t_ns: int) -> Sequence[TactileReading]:
        """End the current sweep at a sample whose time is unknown, and learn the period."""
        self._counters.untimed_frames += 1
        finished = self._finish()
        self._begin()
        if place == ELECTRODES - 1:
            self._learn(t_ns)
        return finished

    def _is_next_sweep(self, place: int, until_ns: int) -> bool:
        """Return True if a sample may be too late for the current sweep."""
        return self._last >= 0 and self._late_ns(place, until_ns) >= self._lateness_ns()

    def _is_early(self, place: int, until_ns: int) -> bool:
        """Return True if a sample is too early for the current sweep, so of the last one."""
        late_ns = self._late_ns(place, until_ns)
        if self._period.period_ns is None:
            return late_ns < 0
        return -late_ns >= self._lateness_ns()

    def _late_ns(self, place: int, until_ns: int) -> float:
        """Return how much later than its place explains a sample is, ns; negative: earlier."""
        period_ns = self._period.period_ns
        if period_ns is None:
            return until_ns - self._t_ns - max(place - self._last, 0) * SLOT_MIN_NS
        return until_ns - (self._origin_ns + self._position[place] * period_ns)

    def _lateness_ns(self) -> float:
        """Return the delay, ns, from which a sample belongs to another sweep."""
        period_ns = self._period.period_ns or self._samples * SLOT_MIN_NS
        return NEXT_SWEEP_PERIODS * period_ns

    def _is_tail_of_previous(self, place: int) -> bool:
        """Return True if the electrode is one of the last, and a sweep has just begun."""
        return place >= ELECTRODES - REORDER_MAX and 0 <= self._last < REORDER_MAX

    def _holds(self, place: int, words: bytes) -> bool:
        start = place * self._width
        return self._buffer[start : start + self._width] == words

    def _repeats(self, place: int, words: bytes, t_ns: int, until_ns: int) -> bool:
        """Handle a copy or a late sample, or return False if a new sweep begins."""
        if self._last - place > REORDER_MAX or self._is_next_sweep(place, until_ns):
            return False
        if not self._have >> place & 1:
            if self._finished:
                self._counters.late_frames += 1
            else:
                self._counters.reordered_frames += 1
                self._put(place, words, max(t_ns, self._t_ns))
            return True
        if not self._holds(place, words):
            return False
        self._counters.duplicate_frames += 1
        return True

    def _store(self, place: int, words: bytes, t_ns: int) -> Sequence[TactileReading]:
        begun_ns = t_ns - self._position[place] * (self._period.period_ns or 0)
        self._origin_ns = begun_ns if self._last < 0 else min(self._origin_ns, begun_ns)
        self._last = place
        self._put(place, words, t_ns)
        if place < ELECTRODES - 1:
            return ()
        return self._finish()

    def _put(self, place: int, words: bytes, t_ns: int) -> None:
        start = place * self._width
        self._buffer[start : start + self._width] = words
        self._have |= 1 << place
        self._t_ns = t_ns

    def _finish(self) -> Sequence[TactileReading]:
        """End the current sweep; return its reading, unless it was returned before."""
        if self._finished or not self._have:
            return ()
        self._finished = True
        self._check_time()
        self._previous_had = self._have
        words = np.zeros((len(self._rows), ELECTRODES), dtype=np.intp)
        came = np.frombuffer(self._buffer, dtype=">u2").reshape(ELECTRODES, self._sensors)
        words[:, self._electrodes] = came.T[self._rows]
        marks = np.zeros(words.shape, dtype=np.uint8)
        lost = ELECTRODES - self._have.bit_count()
        if lost:
            places = [place for place in range(ELECTRODES) if not self._have >> place & 1]
            marks[:, self._electrodes[places]] = ElectrodeFault.MISSING
            self._counters.lost_frames += lost
        interrupted, self._interrupted = self._interrupted, False
        return (make_reading(words, marks, self._t_ns, self._counters, interrupted=interrupted),)

    def _check_time(self) -> None:
        """Count lost whole sweeps; learn the period from two complete sweeps in a row."""
        period_ns = self._period.period_ns
        start_ns = self._t_ns - round(self._position[self._last] * (period_ns or 0))
        if self._previous_start_ns is not None:
            gap_ns = start_ns - self._previous_start_ns
            if gap_ns > OUTAGE_NS:
                self._counters.missed_readings += 1
            elif period_ns and gap_ns - period_ns >= max(self._lateness_ns(), ARRIVAL_JITTER_NS):
                self._counters.missed_readings += round(gap_ns / period_ns) - 1
        self._previous_start_ns = start_ns
        if self._last == ELECTRODES - 1:
            self._learn(self._t_ns)
        else:
            self._broken = True

    def _learn(self, end_ns: int) -> None:
        """Learn the period from the ends of this sweep and of the one before.

        Samples without a gap in their order count even if the time between them cut the sweep.
        Otherwise a wrong period that cuts every sweep would never be corrected. If the widest gap
        has room for a whole sweep, only a board that always pauses there teaches the period.
        """
        is_usable = not self._broken or self._run > ELECTRODES
        if is_usable and self._previous_end_ns is not None:
            gap_ns = end_ns - self._previous_end_ns
            is_even = self._widest_ns < EVEN_SHARE * gap_ns
            if is_even and not self._is_steady:
                self._is_steady = True
                self._period.forget()
            if is_even or not (self._broken or self._is_steady):
                self._period.learn(gap_ns)
        self._broken = False
        self._widest_ns = 0
        self._previous_end_ns = end_ns
