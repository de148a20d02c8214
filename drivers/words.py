"""Response words of a whole sweep -> a reading. SPI and CAN carry the same words."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from drivers.base import ElectrodeFault, TactileReading
from drivers.biotac import decode_words


class WordCounters(Protocol):
    """Counters that a driver of words has."""

    readings: int
    faulty_readings: int
    missed_readings: int
    parity_words: int
    error_words: int
    unplugged_words: int


def make_reading(
    words: NDArray[np.intp], marks: NDArray[np.uint8], t_ns: int, counters: WordCounters
) -> TactileReading:
    """Return the reading of `words`, shape (fingers, 24), and count it. `marks`: faults that are
    known already; words under `MISSING` mean nothing and are not counted."""
    counts, faults = decode_words(words)
    if np.count_nonzero(faults) or np.count_nonzero(marks):
        absent = marks & np.uint8(ElectrodeFault.MISSING) != 0
        faults[absent] = 0
        counters.parity_words += int((faults == ElectrodeFault.PARITY).sum())
        counters.error_words += int((faults == ElectrodeFault.ERROR_WORD).sum())
        counters.unplugged_words += int((faults == ElectrodeFault.MISSING).sum())
        faults |= marks
        counts[absent] = 0
        counters.faulty_readings += bool(faults.any())
    seq = counters.readings + counters.missed_readings
    counters.readings += 1
    return TactileReading(t_ns, seq, counts, faults)
