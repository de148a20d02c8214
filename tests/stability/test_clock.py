"""A device's clock that steps after 20 of 60 s never makes a reading fresher than it is."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from drivers.spi.sweeps import BridgeCounters, DeviceClock

TICK_HZ = 1_000_000
S, MS = 1_000_000_000, 1_000_000
WAY_NS, IDLE_NS = MS, MS
"""From the end of a sweep to its arrival, and from the last idle moment to the arrival."""
TOO_OLD_MAX_NS = 20 * MS + 2 * (WAY_NS + IDLE_NS)
"""A time is 20 ms before the last idle moment where ticks are not believed."""
TEN_YEARS_TICKS = 10 * 365 * 86_400 * TICK_HZ


@pytest.mark.parametrize(
    ("name", "step_s", "first_tick"),
    [
        ("no step", 0.0, TICK_HZ),
        ("a step of +1 ms", 1e-3, TICK_HZ),
        ("a step of -5 ms", -5e-3, TICK_HZ),
        ("a step of +1 s", 1.0, TICK_HZ),
        ("a step of -1 s", -1.0, TICK_HZ),
        ("a step of +1 h", 3600.0, TICK_HZ),
        ("a step back to 0", -1e9, TICK_HZ),
        ("ticks after ten years", 0.0, TEN_YEARS_TICKS),
    ],
)
def test_a_time_is_never_after_its_arrival(
    note: Callable[..., None], name: str, step_s: float, first_tick: int
) -> None:
    clock, last_ns, last_faults = DeviceClock(TICK_HZ, BridgeCounters()), 0, 0
    too_fresh_ns, too_old_ns, never_back = [], [], True
    for number in range(6_000):
        made_ns = S + number * 10 * MS
        step_ns = 0 if number < 2_000 else round(step_s * S)
        tick = max(first_tick + (made_ns + step_ns) // 1_000, number)  # a reset counts from zero
        if number % 100 == 0:
            clock.round_trip(tick, made_ns - 200_000, made_ns + 300_000)
        arrival_ns = made_ns + WAY_NS
        mapped_ns = clock.host_ns(tick + 1, arrival_ns, arrival_ns - IDLE_NS)
        too_fresh_ns.append(mapped_ns - arrival_ns)
        too_old_ns.append(made_ns - mapped_ns)
        # Times go back only where the clock has just stopped being trusted.
        never_back &= mapped_ns >= last_ns or clock.counters.clock_faults > last_faults
        last_ns, last_faults = mapped_ns, clock.counters.clock_faults
    note(
        step=f"device clock, {name}",
        expected=f"never after its arrival, too old by {TOO_OLD_MAX_NS / MS:.0f} ms at most",
        found=f"before its arrival by {-max(too_fresh_ns) / MS:.2f} ms at least, "
        f"too old by {max(too_old_ns) / MS:.2f} ms at most",
    )
    assert max(too_fresh_ns) <= 0
    assert max(too_old_ns) <= TOO_OLD_MAX_NS
    assert never_back
