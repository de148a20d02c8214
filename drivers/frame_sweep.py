"""Per-finger frames -> one `TactileReading` per sweep; what is missing is flagged."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np

from drivers.base import ELECTRODES, ElectrodeFault, TactileReading
from drivers.sweep import OUTAGE_NS, ReadingMaker, SweepCounters

SEQUENCE_JUMP_MAX: Final = 1000
"""Sweep counters that jump by more have started anew; 1000 sweeps last ten seconds."""
LATE_FRAMES_MAX: Final = 8
"""Sweep counters that fall back by up to this are late frames, by more a new start."""


class FrameSweeps:
    """Sweeps from frames that hold all electrodes of one finger and the sweep's number."""

    def __init__(self, fingers: int, counters: SweepCounters) -> None:
        self._fingers = fingers
        self._all = (1 << fingers) - 1
        self._readings = ReadingMaker(counters)
        self._counters = counters
        self._words = np.zeros((fingers, ELECTRODES), dtype=np.uint16)
        self._faults = np.zeros(fingers, dtype=np.uint8)
        self._current: int | None = None
        self._synchronised = False
        self._finished_ns: int | None = None
        self._have = 0
        self._t_ns = 0
        self._finished = False

    @property
    def period_ns(self) -> int | None:
        """Time between sweeps, ns, as measured; None until it is known."""
        return self._readings.period_ns

    def push(
        self, row: int, sequence: int, words: bytes, faults: int, t_ns: int
    ) -> Sequence[TactileReading]:
        """Take the frame of finger `row`; the readings that it completes, oldest first.

        `sequence` is the sweep's number, 16 bits. `words` are 24 response words, two bytes each.
        `faults`: `ElectrodeFault` bits that hold for all electrodes of the finger; with `MISSING`
        its words mean nothing.
        """
        done: Sequence[TactileReading] = ()
        if self._current is None or sequence != self._current:
            if self._is_late(sequence, t_ns):
                self._counters.late_frames += 1
                return ()
            done = self._finish()
            self._advance(sequence)
        elif self._have >> row & 1:
            if t_ns - self._t_ns <= OUTAGE_NS:
                self._counters.duplicate_frames += 1
                return ()
            self._counters.restarts += 1
            done = self._finish()
            self._begin()
        self._words[row] = np.frombuffer(words, dtype=">u2")
        self._faults[row] = faults
        self._have |= 1 << row
        self._t_ns = max(t_ns, self._t_ns)
        return done if self._have != self._all else (*done, *self._finish())

    def interrupt(self) -> None:
        """The link broke: drop the sweep at hand."""
        if self._have and not self._finished:
            self._counters.interrupted_sweeps += 1
            self._readings.miss(1)
            self._finished = True
        self._synchronised = False

    def _begin(self) -> None:
        self._have = 0
        self._t_ns = 0
        self._finished = False

    def _is_late(self, sequence: int, t_ns: int) -> bool:
        if self._current is None or t_ns - self._t_ns > OUTAGE_NS:
            return False
        return 0 < (self._current - sequence) % (1 << 16) <= LATE_FRAMES_MAX

    def _advance(self, sequence: int) -> None:
        """Begin a sweep; count those left out, or a counter that started anew."""
        if self._current is not None:
            jump = (sequence - self._current) % (1 << 16)
            if jump > SEQUENCE_JUMP_MAX:
                self._counters.restarts += 1
                self._readings.miss(1)
            else:
                self._readings.miss(jump - 1)
        self._current = sequence
        self._begin()

    def _finish(self) -> Sequence[TactileReading]:
        """Close the sweep at hand; the first one after opening only if it is complete."""
        if self._finished or not self._have:
            return ()
        self._finished = True
        here = self._have.bit_count()
        if not self._synchronised and here < self._fingers:
            self._synchronised = True
            self._counters.unsynchronised_frames += here
            if self._finished_ns is not None:
                self._readings.miss(1)
            return ()
        self._synchronised = True
        self._counters.lost_frames += self._fingers - here
        if self._finished_ns is not None and 0 < self._t_ns - self._finished_ns <= OUTAGE_NS:
            self._readings.learn(self._t_ns - self._finished_ns)
        self._finished_ns = self._t_ns
        return (self._reading(),)

    def _reading(self) -> TactileReading:
        came = np.array([bool(self._have >> row & 1) for row in range(self._fingers)])
        reported = came & (self._faults & np.uint8(ElectrodeFault.MISSING) != 0)
        self._counters.unplugged_words += ELECTRODES * int(reported.sum())
        fingers = np.where(came, self._faults, np.uint8(ElectrodeFault.MISSING))
        marks = np.repeat(fingers[:, np.newaxis], ELECTRODES, axis=1)
        return self._readings.make(self._words, marks, self._t_ns)
