"""Combine the frames of single fingers into one `TactileReading` per sweep.

Missing fingers are flagged. Frames belong to one sweep if number and tick agree, and if they arrive
within two periods. A board after a reset repeats both, but is silent for longer before.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np

from graspd.drivers.base import ELECTRODES, ElectrodeFault, TactileReading
from graspd.drivers.biotac import make_reading
from graspd.drivers.can.readings import CanCounters, SweepPeriod

SEQUENCE_JUMP_MAX: Final = 1000
"""Largest jump of the sweep number that counts as a loss (ten seconds); more is a restart."""
LATE_FRAMES_MAX: Final = 8
"""Largest step back of the sweep number that counts as late frames; more is a restart."""
PATIENCE_PERIODS: Final = 2
"""Periods after which a frame is neither late nor of the current sweep."""
PATIENCE_NS: Final = 100_000_000
"""Used instead of `PATIENCE_PERIODS` while the period is not known, ns."""
_TICKS: Final = 1 << 32
_HALF: Final = 1 << 31


class FrameAssembler:
    """Combine frames with all electrodes of one finger and the sweep's number into sweeps."""

    expected_ns: int | None = None
    """Always None: a sweep has few frames, so resting between them gains nothing."""

    def __init__(self, order: Sequence[int], counters: CanCounters) -> None:
        """`order`: place of each row's frame in a sweep."""
        self._order = order
        self._fingers = fingers = len(order)
        self._all = (1 << fingers) - 1
        self._period = SweepPeriod()
        self._counters = counters
        self._words = np.zeros((fingers, ELECTRODES), dtype=np.intp)
        self._faults = np.zeros(fingers, dtype=np.uint8)
        self._current: int | None = None
        self._synchronised = False
        self._finished_ns: int | None = None
        self._follows: int | None = None
        """Number expected after the last finished sweep; None if the next one does not follow."""
        self._begin(0, 0)

    def _begin(self, tick_us: int, t_ns: int) -> None:
        self._tick_us = tick_us
        self._have = 0
        self._furthest = 0
        self._begun_ns = self._t_ns = t_ns
        self._finished = False

    @property
    def period_ns(self) -> int | None:
        return self._period.period_ns

    def push(
        self, row: int, sequence: int, tick_us: int, words: bytes, faults: int, t_ns: int
    ) -> Sequence[TactileReading]:
        """Add the frame of finger `row`; return the readings that it completes, oldest first.

        `sequence`: number of the sweep, 16 bits. `tick_us`: its end by the device's clock, 32 bits.
        `words`: 24 response words. `faults`: `ElectrodeFault` bits of all electrodes; with
        `MISSING` the words are ignored.
        """
        done: Sequence[TactileReading] = ()
        if self._current is None or sequence != self._current:
            if self._is_late(sequence, tick_us, t_ns):
                self._counters.late_frames += 1
                return ()
            done = self._finish()
            self._advance(sequence, tick_us, t_ns)
        elif tick_us == self._tick_us and self._have >> row & 1:
            if (self._words[row] == np.frombuffer(words, dtype=">u2")).all():
                self._counters.duplicate_frames += 1
                return ()
            # The board was reset and has the same numbers again, so frames may be of either start.
            self.interrupt()
            self._counters.restarts += 1
            self._begin(tick_us, t_ns)
        elif t_ns - self._begun_ns > self._patience_ns():
            self._counters.restarts += 1
            done = self._finish()
            self._counters.missed_readings += 1
            self._follows = None
            self._begin(tick_us, t_ns)
        elif tick_us != self._tick_us:
            self._counters.contradicting_frames += 1
            return ()
        self._counters.reordered_frames += self._order[row] < self._furthest
        self._furthest = max(self._order[row], self._furthest)
        self._words[row] = np.frombuffer(words, dtype=">u2")
        self._faults[row] = faults
        self._have |= 1 << row
        self._t_ns = max(t_ns, self._t_ns)
        return done if self._have != self._all else (*done, *self._finish())

    def cut(self) -> Sequence[TactileReading]:
        """Do nothing after a loss: the frames' numbers show it."""
        return ()

    def interrupt(self) -> None:
        """Drop the current sweep. Call after the link broke."""
        if self._have and not self._finished:
            self._counters.interrupted_sweeps += 1
            self._counters.missed_readings += 1
            self._finished = True
        self._synchronised = False
        self._follows = None

    def _patience_ns(self) -> int:
        period_ns = self._period.period_ns
        return PATIENCE_NS if period_ns is None else PATIENCE_PERIODS * period_ns

    def _is_late(self, sequence: int, tick_us: int, t_ns: int) -> bool:
        """Return True if a frame is of an earlier sweep, by number, time and tick."""
        if self._current is None or t_ns - self._t_ns > self._patience_ns():
            return False
        back = (self._current - sequence) % (1 << 16)
        return back <= LATE_FRAMES_MAX and (self._tick_us - tick_us) % _TICKS < _HALF

    def _advance(self, sequence: int, tick_us: int, t_ns: int) -> None:
        """Begin a sweep; count the missing ones, or a restart of the device."""
        if self._current is not None:
            jump = (sequence - self._current) % (1 << 16)
            backwards = (tick_us - self._tick_us) % _TICKS >= _HALF
            if jump > SEQUENCE_JUMP_MAX or backwards:
                self._counters.restarts += 1
                self._counters.missed_readings += 1
                self._follows = None
            else:
                self._counters.missed_readings += jump - 1
        self._current = sequence
        self._begin(tick_us, t_ns)

    def _finish(self) -> Sequence[TactileReading]:
        """End the current sweep; the first one must be complete."""
        if self._finished or not self._have:
            return ()
        self._finished = True
        here = self._have.bit_count()
        if not self._synchronised and here < self._fingers:
            self._synchronised = True
            self._counters.unsynchronised_frames += here
            if self._finished_ns is not None:
                self._counters.missed_readings += 1
            return ()
        self._synchronised = True
        self._counters.lost_frames += self._fingers - here
        interrupted = self._finished_ns is not None and self._follows is None
        if self._finished_ns is not None and self._current == self._follows:
            self._period.learn(self._t_ns - self._finished_ns)
        self._finished_ns = self._t_ns
        self._follows = None if self._current is None else (self._current + 1) % (1 << 16)
        return (self._reading(interrupted=interrupted),)

    def _reading(self, *, interrupted: bool) -> TactileReading:
        came = np.array([bool(self._have >> row & 1) for row in range(self._fingers)])
        reported = came & (self._faults & np.uint8(ElectrodeFault.MISSING) != 0)
        self._counters.unplugged_words += ELECTRODES * int(reported.sum())
        fingers = np.where(came, self._faults, np.uint8(ElectrodeFault.MISSING))
        marks = np.repeat(fingers[:, np.newaxis], ELECTRODES, axis=1)
        return make_reading(self._words, marks, self._t_ns, self._counters, interrupted=interrupted)
