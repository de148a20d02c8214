"""Combine samples into one `TactileReading` per sweep; missing electrodes are flagged.

Frames have no counter. A sample's command byte names its channel; its place in the order of the
sequence and its time tell its sweep. `classify` decides, by the table in `deploy/can/PROTOCOL.md`.
Counts are never moved to another electrode or repeated from memory.
"""

from __future__ import annotations

from collections.abc import Sequence
from enum import Enum, auto
from typing import Final

import numpy as np

from graspd.biotac import ELECTRODES
from graspd.drivers.base import ElectrodeFault, TactileReading
from graspd.drivers.biotac import E1, E24, make_reading
from graspd.drivers.can.frames import CanCounters
from graspd.drivers.can.sweep_clock import SweepClock, Timing

REORDER_MAX: Final = 3
"""Most places by which a sample may come late, because some adapters swap neighbours."""
_ALL: Final = (1 << ELECTRODES) - 1


class Held(Enum):
    """Words that a sample's place already has, compared with the sample's.

    Up to the furthest place of the current sweep they are of this sweep, beyond it of the one
    before.
    """

    NOTHING = auto()
    SAME = auto()
    """The same words."""
    OTHER = auto()


class Fate(Enum):
    """Treatment of a sample that arrived."""

    BEGINS = auto()
    """The sample ends the current sweep and begins another."""
    PLACED = auto()
    REORDERED = auto()
    """The sample takes its place, although a later one arrived before it."""
    COPY = auto()
    """Dropped: its place has the same words."""
    LATE = auto()
    """Dropped: its own sweep is over."""


def classify(place: int, last: int, timing: Timing, held: Held, *, is_over: bool) -> Fate:
    """Return the fate of a sample, by the table in `deploy/can/PROTOCOL.md`.

    `place`: the sample's, 0 to 23. `last`: furthest place of the current sweep, -1 for none.
    `held`: words that the place already has. `is_over`: True if the reading of the current sweep
    was handed over.
    """
    if timing is Timing.LATE or last - place > REORDER_MAX:
        return Fate.BEGINS
    is_ahead = place > last
    is_tail = place >= ELECTRODES - REORDER_MAX and 0 <= last < REORDER_MAX
    if is_ahead and not is_tail:
        return Fate.PLACED
    if held is Held.SAME:
        return Fate.COPY
    if is_ahead:
        return Fate.LATE if held is Held.NOTHING or timing is Timing.EARLY else Fate.PLACED
    if held is Held.OTHER:
        return Fate.BEGINS
    return Fate.LATE if is_over else Fate.REORDERED


class _Sweep:
    """Words of the current sweep by place; beyond its furthest place those of the sweep before."""

    def __init__(self, width: int) -> None:
        """`width`: bytes of a sample's words, two for each sensor."""
        self.words = bytearray(ELECTRODES * width)
        self._width = width
        self.have = 0
        """Bit i is set if place i arrived."""
        self.before = _ALL
        """Bit i is set if place i of the sweep before arrived."""
        self.last = -1
        """Furthest place so far; -1: none."""
        self.is_over = False
        """True if the reading of this sweep was handed over."""

    def begin(self) -> None:
        self.have = 0
        self.last = -1
        self.is_over = False

    def held(self, place: int, words: bytes) -> Held:
        arrived = self.have if place <= self.last else self.before
        if not arrived >> place & 1:
            return Held.NOTHING
        start = place * self._width
        is_same = self.words[start : start + self._width] == words
        return Held.SAME if is_same else Held.OTHER

    def put(self, place: int, words: bytes) -> None:
        start = place * self._width
        self.words[start : start + self._width] = words
        self.have |= 1 << place


class SampleAssembler:
    """Combine single samples, sent in the order of a sequence, into sweeps."""

    def __init__(
        self,
        sensors: int,
        sequence: Sequence[int],
        counters: CanCounters,
        rows: Sequence[int],
    ) -> None:
        """`sequence`: one of `SEQUENCES`. `sensors`: number of words in a sample. `rows`: for each
        row of a reading, the number of its sensor, from 0."""
        electrodes = [channel for channel in sequence if E1 <= channel <= E24]
        self._place = {channel: place for place, channel in enumerate(electrodes)}
        self._others = frozenset(sequence) - set(electrodes)
        self._electrodes = np.array(electrodes, dtype=np.intp) - E1
        self._sensors = sensors
        self._rows = np.array(rows, dtype=np.intp)
        self._counters = counters
        self._clock = SweepClock([sequence.index(each) for each in electrodes], len(sequence))
        self._sweep = _Sweep(2 * sensors)
        self._synchronised = False
        self._interrupted = False

    @property
    def period_ns(self) -> int | None:
        return self._clock.period_ns

    @property
    def expected_ns(self) -> int | None:
        """Time when the next reading should be complete, ns; None: not known yet."""
        return self._clock.next_end_ns(self._sweep.last, is_over=self._sweep.is_over)

    def push(
        self, channel: int, words: bytes, t_ns: int, until_ns: int | None = None
    ) -> Sequence[TactileReading]:
        """Add a sample; return the readings that it completes, oldest first.

        `words`: response word of each sensor, two bytes each. The sample arrived at `t_ns`, or
        between `t_ns` and `until_ns` if that is given. If that range is too wide to tell its sweep,
        the sample is dropped and the current sweep ended.
        """
        place = self._place.get(channel)
        if place is None:
            self._counters.unexpected_channels += channel not in self._others
            return ()
        clock, sweep = self._clock, self._sweep
        begins = clock.follow(place, t_ns)
        if until_ns is None:
            until_ns = t_ns
        elif clock.is_vague(t_ns, until_ns):
            self._counters.untimed_frames += 1
            finished = self._finish(begins=True)
            if place == ELECTRODES - 1:
                clock.learn_end(t_ns)
            return finished
        self._synchronised |= begins
        if not self._synchronised:
            self._counters.unsynchronised_frames += 1
            return ()
        timing = clock.timing(place, sweep.last, until_ns)
        if place == sweep.last + 1 and timing is not Timing.LATE:
            return self._store(place, words, t_ns)  # the usual case of `classify`, without its cost
        held = sweep.held(place, words)
        fate = classify(place, sweep.last, timing, held, is_over=sweep.is_over)
        if fate is Fate.PLACED:
            return self._store(place, words, t_ns)
        if fate is Fate.BEGINS:
            return (*self._finish(begins=True), *self._store(place, words, t_ns))
        if fate is Fate.REORDERED:
            self._counters.reordered_frames += 1
            sweep.put(place, words)
            clock.t_ns = max(t_ns, clock.t_ns)
        elif fate is Fate.COPY:
            self._counters.duplicate_frames += 1
        else:
            self._counters.late_frames += 1
        return ()

    def cut(self) -> Sequence[TactileReading]:
        """End the current sweep and return its reading, if it has one that was not returned yet.
        Call when an unknown number of samples was lost."""
        self._counters.cut_sweeps += not self._sweep.is_over and self._sweep.have != 0
        self._clock.cut()
        self._synchronised = False
        return self._finish(begins=True)

    def interrupt(self) -> None:
        """Drop the current sweep. Call after the link broke."""
        self._counters.interrupted_sweeps += not self._sweep.is_over and self._sweep.have != 0
        self._interrupted = self._counters.readings > 0
        self._synchronised = False
        self._clock.interrupt()
        self._sweep.before = _ALL
        self._sweep.begin()

    def _store(self, place: int, words: bytes, t_ns: int) -> Sequence[TactileReading]:
        self._clock.advance(place, t_ns, begins=self._sweep.last < 0)
        self._sweep.put(place, words)
        self._sweep.last = place
        return self._finish() if place == ELECTRODES - 1 else ()

    def _finish(self, *, begins: bool = False) -> Sequence[TactileReading]:
        """Return the reading of the current sweep; () if it has none, or was returned before.

        `begins`: True to begin another sweep.
        """
        sweep = self._sweep
        finished: Sequence[TactileReading] = ()
        if sweep.have and not sweep.is_over:
            sweep.is_over = True
            sweep.before = sweep.have
            self._counters.missed_readings += self._clock.end(sweep.last)
            finished = (self._reading(),)
        if begins:
            sweep.begin()
        return finished

    def _reading(self) -> TactileReading:
        words = np.zeros((len(self._rows), ELECTRODES), dtype=np.intp)
        came = np.frombuffer(self._sweep.words, dtype=">u2").reshape(ELECTRODES, self._sensors)
        words[:, self._electrodes] = came.T[self._rows]
        marks = np.zeros(words.shape, dtype=np.uint8)
        if self._sweep.have != _ALL:
            lost = [place for place in range(ELECTRODES) if not self._sweep.have >> place & 1]
            marks[:, self._electrodes[lost]] = ElectrodeFault.MISSING
            self._counters.lost_frames += len(lost)
        interrupted, self._interrupted = self._interrupted, False
        t_ns = self._clock.t_ns
        return make_reading(words, marks, t_ns, self._counters, interrupted=interrupted)
