"""CAN frames as targets of `tests.bench.fuzz`: the kernel's record, and what its data says.

Single frames only; `tests.drivers.can.can_fuzz` breaks whole streams of them.
"""

from __future__ import annotations

import random
from collections.abc import Callable, Sequence

from drivers.biotac import CHANNELS
from drivers.can.formats import (
    Reject,
    SweepFrame,
    SynTouchSample,
    encode_sample,
    parse_sample,
    parse_sweep,
)
from drivers.can.frames import FD, CanFrame, unpack_frame
from tests.bench.fuzz import Target
from tests.drivers.can.can_words import pack_frame

SAMPLE_ID, SWEEP_ID = 0x100, 0x5B0
SENSORS = 3


class _Records:
    """Parses one record of the kernel at a time; holds nothing back."""

    held_bytes = 0

    def __init__(self, parse: Callable[[bytes], object]) -> None:
        self._parse = parse

    def feed(self, chunk: bytes) -> Sequence[object]:
        frame = unpack_frame(chunk)
        if frame is None:
            return ()
        value = self._parse(frame.data)
        return () if isinstance(value, Reject) else (value,)


def _sample_frame(rng: random.Random) -> tuple[bytes, SynTouchSample]:
    sample = SynTouchSample(rng.choice(CHANNELS), rng.randbytes(2 * SENSORS))
    return pack_frame(CanFrame(SAMPLE_ID, encode_sample(sample.channel, sample.words))), sample


def _sweep_frame(rng: random.Random) -> tuple[bytes, SweepFrame]:
    sweep = SweepFrame(
        rng.randrange(5),
        rng.randrange(1 << 16),
        rng.randrange(1 << 32),
        rng.randbytes(48),
        rng.randrange(8),
    )
    return pack_frame(CanFrame(SWEEP_ID + sweep.finger, sweep.to_bytes(), FD)), sweep


def _is_sample(value: SynTouchSample) -> bool:
    return value.channel in CHANNELS and len(value.words) == 2 * SENSORS


def _is_sweep(value: SweepFrame) -> bool:
    return value.finger < 5 and value.status < 8 and len(value.to_bytes()) == 64


SAMPLES = Target(
    "can-samples",
    _sample_frame,
    lambda: _Records(lambda data: parse_sample(data, SENSORS, 1 + 2 * SENSORS)),
    held_max=0,
    detects_damage=False,
    is_sound=_is_sample,
)
SWEEPS = Target(
    "can-sweeps",
    _sweep_frame,
    lambda: _Records(parse_sweep),
    held_max=0,
    detects_damage=False,
    is_sound=_is_sweep,
)
