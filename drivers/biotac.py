"""BioTac SP on SPI: command bytes, response words, error words, sampling sequences; no I/O.

Source: BioTac SP Product Manual V2 (October 2015), sections 8 and 9; the C library published by
SynTouch where the manual is silent.
"""

from __future__ import annotations

from typing import Any, Final, Protocol

import numpy as np
from numpy.typing import NDArray

from graspd.biotac import COUNT_MAX, ELECTRODES
from graspd.drivers.base import ElectrodeFault, TactileReading

PAC, PDC, TAC, TDC = 0, 1, 2, 3
"""Channels of pressure (AC, DC) and temperature (AC, DC) (manual table 7)."""
E1: Final = 17
"""Channel of electrode 1; E24 is channel 40 (manual table 7)."""
E24: Final = E1 + ELECTRODES - 1
FORBIDDEN_COMMAND = 0xA1
"""Command of channel 16, never sent: it starts the streaming loop of protocol V1.1.

A sensor leaves that loop only after the clock has been idle for five seconds.
"""
CHANNELS = (PAC, PDC, TAC, TDC, *range(E1, E24 + 1))

ERROR_WORDS: dict[int, str] = {
    0xA52D: "insufficient sampling delay",
    0xA558: "channel not recognised",
    0xA552: "parameter is read-only",
    0xA545: "parity of the command is wrong",
    0xA53F: "unknown command",
    0xA52E: "insufficient delay",
    0xA55F: "nothing to resend",
    0xA557: "write failed",
}
"""Error words that a sensor sends in place of data (manual tables 8 and 11, C library). Without the
parity check they would be read as counts of 2629 to 2635."""
UNPLUGGED_WORDS = (0x0000, 0xFFFF)
"""Words read from a line that no sensor drives: all zeros or all ones, with even parity."""

SEQUENCES: Final[dict[str, tuple[int, ...]]] = {
    "electrodes": CHANNELS[4:],
    "all": CHANNELS,
    "interleaved": tuple(
        channel for other in (*CHANNELS[4:], PDC, TAC, TDC) for channel in (other, PAC)
    ),
}
"""Sampling sequences of manual table 12 by the name that a scene gives them.

`interleaved` is the default: every other of 54 samples is PAC (order of the C library).
"""


def sample_command(channel: int) -> int:
    """Return the command byte of a channel: `1 CCCCCC P`, odd parity. Raises `ValueError`."""
    if channel not in CHANNELS:
        raise ValueError(f"a BioTac SP has no channel {channel}")
    byte = 0x80 | channel << 1
    return byte | (byte.bit_count() + 1) % 2


def channel_of(command: int) -> int | None:
    """Return the channel that a command byte samples; None if it samples no channel."""
    return _CHANNEL_OF_COMMAND.get(command)


def encode_word(count: int) -> int:
    """Return a count, 0..4095, as a response word, `D11..D5 P  D4..D0 0 0 P` of odd parity."""
    high, low = count >> 5 << 1, (count & 0x1F) << 3
    high |= (high.bit_count() + 1) % 2
    low |= (low.bit_count() + 1) % 2
    return high << 8 | low


def decode_words(
    words: NDArray[np.integer[Any]],
) -> tuple[NDArray[np.uint16], NDArray[np.uint8]]:
    """Return the counts of `words`, 0 where faulty, and their `ElectrodeFault` bits.

    An array of `np.intp` is fastest. The results have its shape.
    """
    return _COUNT_OF_WORD[words], _FAULT_OF_WORD[words]


def _tables() -> tuple[NDArray[np.uint16], NDArray[np.uint8]]:
    """Return counts and faults, each indexed by all 65536 words: a sweep takes two look-ups."""
    counts = np.zeros(1 << 16, dtype=np.uint16)
    faults = np.full(1 << 16, int(ElectrodeFault.PARITY), dtype=np.uint8)
    for count in range(COUNT_MAX + 1):
        word = encode_word(count)
        counts[word], faults[word] = count, 0
    for told, fault in (
        (list(ERROR_WORDS), ElectrodeFault.ERROR_WORD),
        (list(UNPLUGGED_WORDS), ElectrodeFault.MISSING),
    ):
        counts[told], faults[told] = 0, int(fault)
    return counts, faults


_CHANNEL_OF_COMMAND: Final = {sample_command(channel): channel for channel in CHANNELS}
_COUNT_OF_WORD, _FAULT_OF_WORD = _tables()


class WordCounters(Protocol):
    """Counters of a driver whose device sends response words."""

    readings: int
    faulty_readings: int
    missed_readings: int
    parity_words: int
    error_words: int
    unplugged_words: int


def make_reading(
    words: NDArray[np.intp],
    marks: NDArray[np.uint8],
    t_ns: int,
    counters: WordCounters,
    *,
    interrupted: bool = False,
) -> TactileReading:
    """Return the reading of `words`, shape (fingers, 24), and count it in `counters`.

    `marks`: `ElectrodeFault` bits known before; words marked `MISSING` are ignored.
    `t_ns`: end of the sweep, as in `TactileReading`.
    """
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
    return TactileReading(t_ns, seq, counts, faults, interrupted=interrupted)
