"""Response words made by the manual's figure 15 alone, and sweeps in which no two counts agree."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from drivers.base import TactileReading
from drivers.biotac import E1, SEQUENCES
from drivers.can.decoders import CanCounters
from drivers.can.samples import SampleSweeps

FINGERS = 3
SLOT_NS = 227_000
"""The vendor library's time between samples, ns."""
ELECTRODE_CHANNELS = range(E1, E1 + 24)


class Clock:
    """A clock that only moves when told to."""

    def __init__(self, now_ns: int = 10_000_000_000) -> None:
        self.now_ns = now_ns

    def __call__(self) -> int:
        return self.now_ns


def word(count: int) -> bytes:
    """`D11..D5 P  D4..D0 0 0 P`, odd parity."""
    bits = f"{count:012b}"
    high, low = bits[:7], bits[7:] + "00"
    return bytes(int(part + str((part.count("1") + 1) % 2), 2) for part in (high, low))


def truth(sweep: int, fingers: int = FINGERS) -> NDArray[np.uint16]:
    """Counts, shape (fingers, 24), that no other sweep, finger or electrode has nearby."""
    flat = 100 + 7 * sweep + np.arange(fingers * 24) * 37
    return (flat % 4096).astype(np.uint16).reshape(fingers, 24)


def words_of(counts: NDArray[np.uint16], channel: int) -> bytes:
    """Words of all fingers for one electrode, or of a channel that is none."""
    if channel not in ELECTRODE_CHANNELS:
        return word(2050) * len(counts)
    return b"".join(word(int(count)) for count in counts[:, channel - E1])


Sample = tuple[int, bytes, int]
"""Channel, words, time in ns."""


def samples(sweep: int, sequence: str = "electrodes", start_ns: int = 0) -> list[Sample]:
    """The samples of one sweep, evenly spaced; sweeps follow each other without a gap."""
    channels = SEQUENCES[sequence]
    at_ns = start_ns + sweep * len(channels) * SLOT_NS
    counts = truth(sweep)
    return [
        (channel, words_of(counts, channel), at_ns + slot * SLOT_NS)
        for slot, channel in enumerate(channels)
    ]


def assembler(sequence: str = "electrodes") -> tuple[SampleSweeps, CanCounters]:
    counters = CanCounters()
    return SampleSweeps(FINGERS, SEQUENCES[sequence], counters), counters


def concatenated(sweeps: Sequence[Sequence[Sample]]) -> list[Sample]:
    return [sample for sweep in sweeps for sample in sweep]


def assert_true(reading: TactileReading, sweep: int) -> None:
    """Every count that is not flagged is the one that was sampled; flagged ones are 0."""
    sound = reading.faults == 0
    assert (reading.counts[sound] == truth(sweep)[sound]).all()
    assert not reading.counts[~sound].any()
