"""Device ticks on the host's clock: how well, and what happens when the device's clock fails."""

from __future__ import annotations

import random
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from graspd.drivers.spi.sweeps import BridgeCounters, DeviceClock

MS = 1_000_000
S = 1_000_000_000
TICK_HZ = 1_000_000
START_NS = 5_000 * S
"""Host time when the device was reset: any large number."""
UNKNOWN_DELAY_NS = 20 * MS
"""16 ms of a USB adapter's latency timer, and 4 ms for the rest."""
AGE_MAX_NS = 10 * S
PROOF_NS = 8 * S


@dataclass(frozen=True, slots=True)
class Way:
    """How messages travel, both ways, and how the device's clock runs."""

    jitter_ms: float = 1.0
    """Mean of an exponential delay, both ways."""
    batch_ms: float = 16.0
    """Arrivals wait for the next multiple of this; 0 for none."""
    drifts_ppm: tuple[float, ...] = (0.0,)
    """How much the device's clock is fast, second by second, again and again."""
    stall_probability: float = 0.0
    """Chance that a message waits for up to a second more, on either way."""
    tick_hz: int = TICK_HZ
    seed: int = 0

    def tick(self, host_ns: int) -> int:
        seconds, rest_ns = divmod(host_ns - START_NS, S)
        turns, rest = divmod(seconds, len(self.drifts_ppm))
        past_ppm = turns * sum(self.drifts_ppm) + sum(self.drifts_ppm[:rest])
        ahead_ns = past_ppm * 1e3 + self.drifts_ppm[rest] * rest_ns / 1e6
        return (host_ns - START_NS + round(ahead_ns)) * self.tick_hz // S


@dataclass(frozen=True, slots=True)
class Event:
    """A sweep, or an answered PING if `sent_ns` is not None. Times are host ns."""

    made_ns: int
    arrival_ns: int
    sent_ns: int | None = None


def events(way: Way, duration_s: int) -> Iterator[Event]:
    """Sweeps at 100 Hz and PINGs, four a second, in order of arrival."""
    rng = random.Random(way.seed)
    batch_ns = round(way.batch_ms * MS)

    def delay_ns() -> int:
        delay_ms = rng.expovariate(1.0 / way.jitter_ms) if way.jitter_ms else 0.0
        stall_ms = rng.uniform(0.0, 1000.0) if rng.random() < way.stall_probability else 0.0
        return round((delay_ms + stall_ms) * MS)

    def arrival_ns(made_ns: int) -> int:
        ready_ns = made_ns + delay_ns()
        return -(-ready_ns // batch_ns) * batch_ns if batch_ns else ready_ns

    made = []
    for k in range(duration_s * 100):
        made_ns = START_NS + S + k * S // 100
        made.append(Event(made_ns, arrival_ns(made_ns)))
    for send_ms in range(0, 1000 * duration_s, 247):
        sent_ns = START_NS + S + send_ms * MS
        made_ns = sent_ns + delay_ns()
        made.append(Event(made_ns, arrival_ns(made_ns), sent_ns))
    last_ns = 0
    for event in sorted(made, key=lambda event: event.made_ns):  # a serial line keeps the order
        last_ns = max(last_ns, event.arrival_ns)
        yield Event(event.made_ns, last_ns, event.sent_ns)


def too_old_ns(way: Way, duration_s: int, clock: DeviceClock) -> Iterator[tuple[int, int]]:
    """Yield by how much each sweep after the first answer looks too old, and the most allowed.

    The most is the way of a PING to the device, half a thousandth of the time since, by what the
    rate may be wrong on top of how it is wrong, and two ticks.
    """
    pings: list[tuple[int, int]] = []
    idle_ns = START_NS
    for event in events(way, duration_s):
        tick = way.tick(event.made_ns)
        if event.sent_ns is not None:
            clock.round_trip(tick, event.sent_ns, event.arrival_ns)
            pings = [*pings[-7:], (event.sent_ns, event.made_ns)]
        elif clock.trusted:
            mapped_ns = clock.host_ns(tick, event.arrival_ns, idle_ns)
            most_ns = min(
                made_ns - sent_ns + round(abs(event.made_ns - made_ns) * 1.001e-3)
                for sent_ns, made_ns in pings
            )
            yield event.made_ns - mapped_ns, most_ns + 2 * S // way.tick_hz + 2
        idle_ns = event.arrival_ns


ways = st.builds(
    Way,
    jitter_ms=st.floats(0.0, 20.0),
    batch_ms=st.sampled_from([0.0, 1.0, 16.0]),
    drifts_ppm=st.lists(st.floats(-499.0, 499.0), min_size=1, max_size=5).map(tuple),
    stall_probability=st.sampled_from([0.0, 0.01, 0.2]),
    tick_hz=st.sampled_from([1_000, TICK_HZ, 133_000_000]),
    seed=st.integers(0, 2**32),
)


@given(ways)
def test_no_reading_looks_newer_than_it_is(way: Way) -> None:
    clock = DeviceClock(way.tick_hz, BridgeCounters())
    for too_old, most in too_old_ns(way, 12, clock):
        assert 0 <= too_old <= most
    assert clock.counters.clock_faults == clock.counters.clock_fallbacks == 0


@pytest.mark.parametrize("drift_ppm", [-100.0, 100.0])
def test_with_batches_a_time_is_right_to_two_milliseconds(drift_ppm: float) -> None:
    """Drawn delays, so measured: `deploy/MEASURED.md`."""
    clock = DeviceClock(TICK_HZ, BridgeCounters())
    way = Way(drifts_ppm=(drift_ppm,), seed=1)
    errors_ms = np.array([too_old / MS for too_old, _ in too_old_ns(way, 120, clock)])
    assert len(errors_ms) > 11_900
    assert errors_ms[1000:].max() < 2.0
    assert np.median(errors_ms) < 0.6


@given(ways, st.integers(3 * S, 3600 * S), st.booleans())
def test_after_a_jump_of_the_clock_no_time_is_after_its_arrival(
    way: Way, jump_ns: int, back: bool
) -> None:
    """A computer that slept, whose clock stood meanwhile; a counter that wraps or is reset."""
    clock, idle_ns = DeviceClock(way.tick_hz, BridgeCounters()), START_NS
    for number, event in enumerate(events(way, 5)):
        tick = way.tick(event.made_ns)
        if number > 200:
            tick = tick % 1000 if back else tick + jump_ns * way.tick_hz // S
        if event.sent_ns is not None:
            clock.round_trip(tick, event.sent_ns, event.arrival_ns)
            continue
        mapped_ns = clock.host_ns(tick, event.arrival_ns, idle_ns)
        assert event.arrival_ns - AGE_MAX_NS <= mapped_ns <= event.arrival_ns
        idle_ns = event.arrival_ns
    assert not clock.trusted
    assert clock.counters.clock_faults == 1


def ping(clock: DeviceClock, now_ns: int, lead_ticks: int = 0) -> None:
    """A round trip of a millisecond."""
    clock.round_trip(Way().tick(now_ns) + lead_ticks, now_ns - MS // 2, now_ns + MS // 2)


def synchronised(pings: int = 5) -> tuple[DeviceClock, int]:
    """A clock after some PINGs, and the host time of the last, ns."""
    clock = DeviceClock(TICK_HZ, BridgeCounters())
    for number in range(1, pings + 1):
        ping(clock, START_NS + number * S)
    return clock, START_NS + pings * S


def test_one_answered_ping_is_enough() -> None:
    clock, now_ns = synchronised(pings=1)
    assert clock.trusted
    assert clock.round_trip_ns == MS
    made_ns = now_ns + 10 * MS
    mapped_ns = clock.host_ns(Way().tick(made_ns), made_ns + 3 * MS, now_ns)
    assert made_ns - MS <= mapped_ns <= made_ns


def test_before_any_ping_a_time_is_older_than_the_last_idle_moment() -> None:
    clock = DeviceClock(TICK_HZ, BridgeCounters())
    assert not clock.trusted
    mapped_ns = clock.host_ns(0, START_NS, START_NS - 10 * MS)
    assert mapped_ns == START_NS - 10 * MS - UNKNOWN_DELAY_NS
    assert (clock.counters.clock_faults, clock.counters.clock_fallbacks) == (0, 1)


def test_a_clock_that_stands_is_not_believed() -> None:
    clock, now_ns = synchronised()
    tick = Way().tick(now_ns + 10 * MS)
    clock.host_ns(tick, now_ns + 11 * MS, now_ns)
    for k in range(2, 500):
        arrival_ns = now_ns + k * 10 * MS
        mapped_ns = clock.host_ns(tick, arrival_ns, arrival_ns - 10 * MS)
        assert mapped_ns == arrival_ns - 10 * MS - UNKNOWN_DELAY_NS
        if k % 100 == 0:
            clock.round_trip(tick, arrival_ns - MS, arrival_ns)
    assert not clock.trusted
    assert (clock.counters.clock_faults, clock.counters.clock_fallbacks) == (1, 498)


def test_a_clock_that_falls_back_must_prove_itself() -> None:
    clock, now_ns = synchronised()
    clock.host_ns(Way().tick(now_ns), now_ns + MS, now_ns)
    clock.host_ns(500, now_ns + 20 * MS, now_ns + 10 * MS)
    reset = -Way().tick(now_ns)
    for seconds in range(1, 11):
        ping(clock, now_ns + seconds * S, reset)
        assert clock.trusted == (seconds > 9)  # the answer to the first came after it was sent
    made_ns = now_ns + 10 * S + 10 * MS
    mapped_ns = clock.host_ns(Way().tick(made_ns) + reset, made_ns + MS, made_ns)
    assert made_ns - 2 * MS <= mapped_ns <= made_ns
    assert clock.counters.clock_faults == 1


def test_a_disagreement_starts_the_proof_again() -> None:
    clock, now_ns = synchronised()
    clock.host_ns(1, now_ns, now_ns)
    clock.host_ns(1, now_ns, now_ns)
    for seconds in range(1, 20):
        ping(clock, now_ns + seconds * S, lead_ticks=10_000 if seconds >= 8 else 0)
        assert clock.trusted == (seconds > 16)
    assert clock.counters.clock_faults == 1


def test_a_time_is_never_later_than_its_arrival_nor_older_than_the_limit() -> None:
    rng = np.random.default_rng(5)
    clock, now_ns = synchronised()
    for _ in range(20_000):
        now_ns += int(rng.integers(0, 50 * MS))
        tick = int(rng.integers(0, 1 << int(rng.integers(1, 63)))) << int(rng.integers(0, 2))
        if rng.random() < 0.1:
            clock.round_trip(tick, now_ns - int(rng.integers(0, S)), now_ns)
        mapped_ns = clock.host_ns(tick, now_ns, now_ns - int(rng.integers(0, 60 * S)))
        assert now_ns - AGE_MAX_NS <= mapped_ns <= now_ns


def exact(pings: int) -> tuple[DeviceClock, int]:
    """A clock after PINGs that took no time, one a second; host time of the last, ns."""
    clock = DeviceClock(TICK_HZ, BridgeCounters())
    for number in range(pings):
        now_ns = START_NS + number * S
        clock.round_trip(Way().tick(now_ns), now_ns, now_ns)
    return clock, now_ns


@pytest.mark.parametrize(("ahead_us", "trusted"), [(0, True), (7, False)])
def test_a_time_after_its_arrival_is_a_fault(ahead_us: int, trusted: bool) -> None:
    clock, now_ns = exact(3)
    arrival_ns = now_ns + 10 * MS  # wrong by 5 us at most, and by a tick
    tick = Way().tick(arrival_ns) + ahead_us
    mapped_ns = clock.host_ns(tick, arrival_ns, now_ns)
    assert clock.trusted == trusted
    assert mapped_ns == (arrival_ns - 6000 if trusted else now_ns - UNKNOWN_DELAY_NS)


def test_no_reading_is_older_than_ten_seconds() -> None:
    for seconds, age_ns in ((9, 9 * S + 1000), (11, 10 * S)):
        clock, now_ns = exact(200)
        tick = Way().tick(now_ns)
        assert clock.host_ns(tick, now_ns + seconds * S, now_ns) == now_ns + seconds * S - age_ns


@pytest.mark.parametrize(("wrong_ppm", "faults"), [(499, 0), (501, 1), (-499, 0), (-501, 1)])
def test_a_rate_wrong_by_500_parts_in_a_million_is_a_fault(wrong_ppm: int, faults: int) -> None:
    clock = DeviceClock(TICK_HZ, BridgeCounters())
    for second in (0, 10):
        now_ns = START_NS + second * S
        clock.round_trip(1000 + second * (TICK_HZ + wrong_ppm), now_ns, now_ns)
    assert clock.counters.clock_faults == faults
