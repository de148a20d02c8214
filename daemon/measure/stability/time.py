"""Clocks that step and counters that wrap."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from daemon.measure.stability.steps import StepRow
from drivers.base import ELECTRODES
from drivers.biotac import SEQUENCE_ELECTRODES, encode_word, sample_command
from drivers.can.readings import CanCounters
from drivers.can.sweep_frames import FrameAssembler
from drivers.spi.clock import UNKNOWN_DELAY_NS, DeviceClock
from drivers.spi.messages import Hello, Sweep
from drivers.spi.sweeps import BridgeCounters, SweepDecoder

TICK_HZ = 1_000_000
S, MS = 1_000_000_000, 1_000_000
PERIOD_NS = 10 * MS
WAY_NS, IDLE_NS = MS, MS
"""From the end of a sweep to its arrival, and from the last idle moment to that."""
TOO_OLD_MAX_NS = UNKNOWN_DELAY_NS + 2 * (WAY_NS + IDLE_NS)
"""Where ticks are not believed a time is a delay before the last idle moment."""
STEPS_S = {
    "no step": 0.0,
    "a step of +1 ms": 1e-3,
    "a step of -5 ms": -5e-3,
    "a step of +1 s": 1.0,
    "a step of -1 s": -1.0,
    "a step of +1 h": 3600.0,
    "a step back to 0": -1e9,
}
TEN_YEARS_TICKS = 10 * 365 * 86_400 * TICK_HZ
FRAMES = 40
"""Sweeps around a wrap, half of them before it."""


def clock_rows() -> Iterator[StepRow]:
    """A device's clock that steps after 20 of 60 s."""
    for name, step_s in STEPS_S.items():
        yield _clock_row(name, step_s, TICK_HZ)
    yield _clock_row("ticks after ten years", 0.0, TEN_YEARS_TICKS)


def wrap_rows() -> Iterator[StepRow]:
    """Whether sweep numbers and ticks that begin again at 0 lose a reading, a row each."""
    readings, missed, restarts = _frames_around_wrap()
    yield StepRow(
        "CAN sweep number (16 bits) and tick (32 bits) at their wrap",
        f"{FRAMES} readings, 0 missed, 0 restarts",
        f"{readings} readings, {missed} missed, {restarts} restarts",
        (readings, missed, restarts) == (FRAMES, 0, 0),
    )
    readings, missed, steps = _bridge_around_wrap()
    yield StepRow(
        "SPI bridge's sweep number (32 bits) at its wrap",
        f"{FRAMES} readings, 0 missed, numbered on by 1",
        f"{readings} readings, {missed} missed, numbered on by {', '.join(map(str, steps))}",
        (readings, missed, steps) == (FRAMES, 0, [1]),
    )


def _clock_row(name: str, step_s: float, first_tick: int) -> StepRow:
    too_fresh_ns, too_old_ns, never_back = _follow_clock(step_s, first_tick)
    return StepRow(
        f"device clock, {name}",
        f"never after its arrival, too old by {TOO_OLD_MAX_NS / MS:.0f} ms at most",
        f"before its arrival by {-too_fresh_ns / MS:.2f} ms at least, "
        f"too old by {too_old_ns / MS:.2f} ms at most",
        too_fresh_ns <= 0 and too_old_ns <= TOO_OLD_MAX_NS and never_back,
    )


def _follow_clock(step_s: float, first_tick: int) -> tuple[int, int, bool]:
    """By how much mapped times are after the arrival and before the truth, at worst, ns.

    And whether they go back only where the clock has just stopped being trusted.
    """
    clock = DeviceClock(TICK_HZ)
    too_fresh_ns, too_old_ns, never_back = -(10**18), -(10**18), True
    last_ns, last_faults = 0, 0
    for number in range(6_000):
        made_ns = S + number * PERIOD_NS
        step_ns = 0 if number < 2_000 else round(step_s * S)
        tick = first_tick + (made_ns + step_ns) // 1_000
        tick = max(tick, number)  # a clock that was reset counts on from zero
        if number % 100 == 0:
            clock.round_trip(tick, made_ns - 200_000, made_ns + 300_000)
        arrival_ns = made_ns + WAY_NS
        mapped_ns = clock.host_ns(tick + 1, arrival_ns, arrival_ns - IDLE_NS)
        too_fresh_ns = max(too_fresh_ns, mapped_ns - arrival_ns)
        too_old_ns = max(too_old_ns, made_ns - mapped_ns)
        never_back &= mapped_ns >= last_ns or clock.faults > last_faults
        last_ns, last_faults = mapped_ns, clock.faults
    return too_fresh_ns, too_old_ns, never_back


def _frames_around_wrap() -> tuple[int, int, int]:
    """Readings, missed ones and restarts of a board whose counters wrap in the middle."""
    counters = CanCounters()
    sweeps = FrameAssembler(3, counters)
    words = encode_word(2000).to_bytes(2, "big") * ELECTRODES
    readings = 0
    for number in range(-FRAMES // 2, FRAMES // 2):
        for row in range(3):
            made_ns = S + (number + FRAMES) * PERIOD_NS + row * MS
            tick_us = number * PERIOD_NS // 1_000 % (1 << 32)
            readings += len(sweeps.push(row, number % (1 << 16), tick_us, words, 0, made_ns))
    return readings, counters.missed_readings, counters.restarts


def _bridge_around_wrap() -> tuple[int, int, list[int]]:
    """Readings, missed ones, and the steps of the readings' own numbers."""
    commands = tuple(sample_command(channel) for channel in SEQUENCE_ELECTRODES)
    hello = Hello(1, 0, TICK_HZ, PERIOD_NS // 1_000, ("a", "b", "c"), commands)
    counters = BridgeCounters()
    sweeps = SweepDecoder(hello, (0, 1, 2), counters, 0)
    words = np.full((len(commands), 3), encode_word(2000), dtype=np.uint16)
    numbers = []
    for number in range(FRAMES):
        made_ns = S + number * PERIOD_NS
        seq = (number - FRAMES // 2) % (1 << 32)
        tick = made_ns // 1_000
        reading = sweeps.reading(
            Sweep(seq, tick - 1, tick, 0b111, words), made_ns + WAY_NS, made_ns
        )
        if reading is not None:
            numbers.append(reading.seq)
    steps = sorted({int(step) for step in np.diff(numbers)})
    return len(numbers), counters.missed_readings, steps
