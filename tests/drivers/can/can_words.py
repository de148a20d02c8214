"""Response words made by the manual's figure 15 alone, and sweeps in which no two counts agree."""

from __future__ import annotations

import struct
from collections.abc import Iterable, Sequence

import numpy as np
from numpy.typing import NDArray

from graspd.drivers.base import TactileReading
from graspd.drivers.biotac import E1, SEQUENCES
from graspd.drivers.can.frames import ERROR, EXTENDED, REMOTE, CanCounters, CanFrame
from graspd.drivers.can.samples import SampleAssembler
from tests.drivers.one_sweep import counts_of

# linux/can.h
EFF_FLAG, RTR_FLAG, ERR_FLAG = 0x80000000, 0x40000000, 0x20000000
CAN_FRAME = struct.Struct("=IB3x8s")

FINGERS = 3
SLOT_NS = 227_000
"""The vendor library's time between samples, ns."""
ELECTRODE_CHANNELS = range(E1, E1 + 24)


def word(count: int) -> bytes:
    """Response word of a count: `D11..D5 P  D4..D0 0 0 P`, odd parity."""
    bits = f"{count:012b}"
    high, low = bits[:7], bits[7:] + "00"
    return bytes(int(part + str((part.count("1") + 1) % 2), 2) for part in (high, low))


def words_of(counts: NDArray[np.uint16], channel: int) -> bytes:
    """Words of all fingers for an electrode's channel; for another one words of the count 2050.

    `counts`: shape (fingers, electrodes).
    """
    if channel not in ELECTRODE_CHANNELS:
        return word(2050) * len(counts)
    return b"".join(word(int(count)) for count in counts[:, channel - E1])


Sample = tuple[int, bytes, int]
"""Channel, words, time in ns."""


def samples(sweep: int, sequence: str = "electrodes") -> list[Sample]:
    """The samples of one sweep, evenly spaced; sweeps follow each other without a gap."""
    channels = SEQUENCES[sequence]
    at_ns = sweep * len(channels) * SLOT_NS
    counts = counts_of(sweep)
    return [
        (channel, words_of(counts, channel), at_ns + slot * SLOT_NS)
        for slot, channel in enumerate(channels)
    ]


def assembler(sequence: str = "electrodes") -> tuple[SampleAssembler, CanCounters]:
    counters = CanCounters()
    return SampleAssembler(FINGERS, SEQUENCES[sequence], counters, range(FINGERS)), counters


def concatenated(sweeps: Sequence[Sequence[Sample]]) -> list[Sample]:
    return [sample for sweep in sweeps for sample in sweep]


def feed(sweeps: SampleAssembler, stream: Iterable[Sample]) -> list[TactileReading]:
    return [reading for sample in stream for reading in sweeps.push(*sample)]


def pack_frame(frame: CanFrame) -> bytes:
    """The `can_frame` that Linux would hand over."""
    word = frame.arbitration_id
    word |= EFF_FLAG if frame.flags & EXTENDED else 0
    word |= RTR_FLAG if frame.flags & REMOTE else 0
    word |= ERR_FLAG if frame.flags & ERROR else 0
    return CAN_FRAME.pack(word, len(frame.data), frame.data)
