"""Device ticks on the host's clock: how well, and what happens when the device's clock fails."""

from __future__ import annotations

import math
import random
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import pytest
from numpy.typing import NDArray

from graspd.drivers.spi.sweeps import BridgeCounters, DeviceClock

MS = 1_000_000
S = 1_000_000_000
TICK_HZ = 1_000_000
START_NS = 5_000 * S
"""Host time when the device was reset: any large number."""
UNKNOWN_DELAY_NS = 20 * MS
"""16 ms of a USB adapter's latency timer, and 4 ms for the rest."""
AGE_MAX_NS = 10 * S


@dataclass(frozen=True, slots=True)
class Way:
    """How messages travel: host to device, and device to host."""

    jitter_ms: float = 1.0
    """Mean of an exponential delay, both ways."""
    batch_ms: float = 16.0
    """Arrivals wait for the next multiple of this; 0 for none."""
    drift_ppm: float = 0.0
    """How much the device's clock is fast."""
    seed: int = 0


@dataclass(frozen=True, slots=True)
class Event:
    """A sweep, or an answered PING if `sent_ns` is not None. Times are host ns."""

    made_ns: int
    tick: int
    arrival_ns: int
    sent_ns: int | None = None


def tick_of(host_ns: int, way: Way) -> int:
    return int((host_ns - START_NS) * (1.0 + way.drift_ppm * 1e-6) * TICK_HZ // S)


def events(way: Way, duration_s: float) -> Iterator[Event]:
    """Sweeps at 100 Hz and PINGs (eight at the start, then one per second) in order of arrival."""
    rng = random.Random(way.seed)

    def delay_ns() -> int:
        return round(rng.expovariate(1.0 / way.jitter_ms) * MS) if way.jitter_ms else 0

    def arrival_ns(made_ns: int) -> int:
        ready_ns = made_ns + delay_ns()
        batch_ns = round(way.batch_ms * MS)
        return ready_ns if not batch_ns else -(-ready_ns // batch_ns) * batch_ns

    made = []
    for k in range(round(duration_s * 100)):
        made_ns = START_NS + S + k * S // 100
        made.append(Event(made_ns, tick_of(made_ns, way), arrival_ns(made_ns)))
    sends_s = [0.05 * k for k in range(8)] + [1.0 + k for k in range(math.floor(duration_s))]
    for send_s in sends_s:
        sent_ns = START_NS + S + round(send_s * S)
        made_ns = sent_ns + delay_ns()
        made.append(Event(made_ns, tick_of(made_ns, way), arrival_ns(made_ns), sent_ns))
    made.sort(key=lambda event: event.made_ns)
    last_ns = 0
    for event in made:  # a serial line keeps the order
        last_ns = max(last_ns, event.arrival_ns)
        yield Event(event.made_ns, event.tick, last_ns, event.sent_ns)


def errors_ms(way: Way, duration_s: float, clock: DeviceClock) -> NDArray[np.float64]:
    """Mapped minus true time of every sweep after the first answer, ms: negative is too old."""
    errors = []
    idle_ns = START_NS
    for event in events(way, duration_s):
        if event.sent_ns is not None:
            clock.round_trip(event.tick, event.sent_ns, event.arrival_ns)
        elif clock.trusted:
            mapped_ns = clock.host_ns(event.tick, event.arrival_ns, idle_ns)
            errors.append((mapped_ns - event.made_ns) / MS)
        idle_ns = event.arrival_ns
    return np.array(errors)


def synchronised(way: Way | None = None, pings: int = 5) -> tuple[DeviceClock, int]:
    """A clock after some PINGs of 1 ms, and the host time of the last, ns."""
    clock = DeviceClock(TICK_HZ, BridgeCounters())
    now_ns = START_NS
    for _ in range(pings):
        now_ns += S
        ping(clock, now_ns, way)
    return clock, now_ns


def ping(clock: DeviceClock, now_ns: int, way: Way | None = None, lead_ticks: int = 0) -> None:
    tick = tick_of(now_ns, way or Way()) + lead_ticks
    clock.round_trip(tick, now_ns - MS // 2, now_ns + MS // 2)


@pytest.mark.parametrize("drift_ppm", [-100.0, 100.0])
@pytest.mark.parametrize("seed", [1, 2])
def test_times_are_right_within_two_milliseconds_and_never_too_fresh(
    drift_ppm: float, seed: int
) -> None:
    clock = DeviceClock(TICK_HZ, BridgeCounters())
    errors = errors_ms(Way(drift_ppm=drift_ppm, seed=seed), 120.0, clock)
    assert len(errors) > 11_900
    assert errors.max() <= 0.01
    assert errors.min() > -5.0  # in the first second
    settled = errors[len(errors) // 4 :]
    assert settled.min() > -2.5
    assert -0.5 < np.median(settled) < 0.0
    assert clock.counters.clock_faults == clock.counters.clock_fallbacks == 0


@pytest.mark.parametrize("drift_ppm", [-100.0, 80.0])
@pytest.mark.parametrize("seed", [1, 2])
def test_the_rate_is_within_its_limits_which_close_in(drift_ppm: float, seed: int) -> None:
    widths = []
    for duration_s in (3.0, 30.0):
        clock = DeviceClock(TICK_HZ, BridgeCounters())
        errors_ms(Way(0.1, 0.0, drift_ppm, seed), duration_s, clock)
        assert clock.rate_limits_ppm is not None
        least, most = clock.rate_limits_ppm
        assert least <= drift_ppm <= most
        widths.append(most - least)
    assert widths[1] < widths[0] < 1000.0


def test_one_answered_ping_is_enough() -> None:
    clock, now_ns = synchronised(pings=1)
    assert clock.trusted
    assert clock.drift_ppm is None
    assert clock.rate_limits_ppm is None
    made_ns = now_ns + 10 * MS
    mapped_ns = clock.host_ns(tick_of(made_ns, Way()), made_ns + 3 * MS, now_ns)
    assert made_ns - MS <= mapped_ns <= made_ns


def test_before_any_ping_a_time_is_older_than_the_last_idle_moment() -> None:
    clock = DeviceClock(TICK_HZ, BridgeCounters())
    assert not clock.trusted
    mapped_ns = clock.host_ns(123, START_NS, START_NS - 10 * MS)
    assert mapped_ns == START_NS - 10 * MS - UNKNOWN_DELAY_NS
    assert clock.counters.clock_fallbacks == 1


def test_a_clock_that_stands_is_not_believed() -> None:
    clock, now_ns = synchronised()
    tick = tick_of(now_ns + 10 * MS, Way())
    clock.host_ns(tick, now_ns + 11 * MS, now_ns)
    for k in range(2, 500):
        arrival_ns = now_ns + k * 10 * MS
        mapped_ns = clock.host_ns(tick, arrival_ns, arrival_ns - 10 * MS)
        assert mapped_ns == arrival_ns - 10 * MS - UNKNOWN_DELAY_NS
        if k % 100 == 0:
            clock.round_trip(tick, arrival_ns - MS, arrival_ns)
    assert not clock.trusted
    assert (clock.counters.clock_faults, clock.counters.clock_fallbacks) == (1, 498)


def test_a_clock_that_falls_back_is_believed_again_after_two_pings_that_agree() -> None:
    clock, now_ns = synchronised()
    clock.host_ns(tick_of(now_ns, Way()), now_ns + MS, now_ns)
    clock.host_ns(500, now_ns + 20 * MS, now_ns + 10 * MS)
    assert not clock.trusted
    reset = -tick_of(now_ns, Way())
    for seconds, trusted in ((1, False), (2, True)):
        ping(clock, now_ns + seconds * S, lead_ticks=reset)
        assert clock.trusted is trusted
    made_ns = now_ns + 2 * S + 10 * MS
    mapped_ns = clock.host_ns(tick_of(made_ns, Way()) + reset, made_ns + MS, made_ns)
    assert made_ns - 2 * MS <= mapped_ns <= made_ns
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


def test_a_slow_clock_of_a_kilohertz_is_no_fault() -> None:
    clock = DeviceClock(1000, BridgeCounters())
    for k in range(1, 100):
        now_ns = START_NS + k * 10 * MS
        if k % 5 == 1:
            clock.round_trip(k * 10, now_ns - MS // 10, now_ns + MS // 10)
        mapped_ns = clock.host_ns(k * 10, now_ns + MS, now_ns)
        assert now_ns - 3 * MS <= mapped_ns <= now_ns
    assert clock.counters.clock_faults == 0


DECAY = 1.0 / 30.0
"""As in Klipper's clock synchronisation (klippy/clocksync.py)."""


def by_the_definition(
    pings: list[tuple[int, int]], ns_per_tick: float, tick: int
) -> tuple[float, int]:
    """Slope of host over device time, less one, and the time of `tick`, host ns, after PINGs.

    `pings` are (tick, sent_ns). Weights of the regression written out: a PING counts a thirtieth
    of all, the first whatever is left; with 1 ms of noise before any is known.
    """
    x = np.array([ping[0] * ns_per_tick for ping in pings])
    y = np.array([ping[1] for ping in pings]) - x
    x, y = x - x[0], y - y[0]
    noise, slope, slack = 1e6**2, 0.0, 200e-6
    for number in range(1, len(pings) + 1):
        if number > 1:  # the first PING is the line
            weights = DECAY * (1.0 - DECAY) ** np.arange(number - 2, -1, -1.0)
            weights = np.append((1.0 - DECAY) ** (number - 1), weights)
            before = np.append((1.0 - DECAY) ** (number - 2), weights[1:-1] / (1.0 - DECAY))
            middle = before @ np.column_stack((x, y))[: number - 1]
            residual = y[number - 1] - middle[1] - slope * (x[number - 1] - middle[0])
            noise = (1.0 - DECAY) * (noise + DECAY * residual**2)
        else:
            weights = np.ones(1)
            noise = (1.0 - DECAY) * noise
        dx, dy = (v[:number] - weights @ v[:number] for v in (x, y))
        variance = weights @ dx**2
        slope, slack = 0.0, 200e-6
        if variance > 0.0:
            found = weights @ (dx * dy) / variance
            error = 6.0 * np.sqrt(noise * DECAY / (2.0 * variance))
            if error < 200e-6 and abs(found) <= 500e-6:
                slope, slack = float(found), max(float(error), 10e-6)

    def earliest_ns(ping: tuple[int, int], at: int) -> int:
        passed = (at - ping[0]) * ns_per_tick * (1.0 + slope)
        return ping[1] + round(passed * (1.0 - slack) - ns_per_tick)

    best = max(pings[-16:], key=lambda ping: earliest_ns(ping, pings[-1][0]))
    return slope, earliest_ns(best, tick)


@pytest.mark.parametrize("pings", [1, 2, 3, 5, 8, 16, 17, 40, 400])
@pytest.mark.parametrize("drift_ppm", [-90.0, 0.0, 60.0])
def test_a_time_is_that_of_the_weighted_regression(pings: int, drift_ppm: float) -> None:
    rng = np.random.default_rng(pings)
    clock, way, sent = DeviceClock(TICK_HZ, BridgeCounters()), Way(drift_ppm=drift_ppm), []
    for number in range(pings):
        made_ns = START_NS + number * S
        sent.append((tick_of(made_ns, way), made_ns - int(rng.integers(0, MS // 3))))
        clock.round_trip(*sent[-1], made_ns + MS)
    later_ns = START_NS + pings * S
    slope, mapped_ns = by_the_definition(sent, 1e9 / TICK_HZ, tick_of(later_ns, way))
    assert clock.host_ns(tick_of(later_ns, way), later_ns, later_ns) == pytest.approx(
        mapped_ns, abs=2
    )
    if clock.drift_ppm is not None:
        assert clock.drift_ppm == pytest.approx((1.0 / (1.0 + slope) - 1.0) * 1e6, abs=1e-3)
    assert (clock.drift_ppm is not None) == (slope != 0.0)


def exact(pings: int) -> tuple[DeviceClock, int]:
    """A clock after so many PINGs that took no time, one a second; host time of the last, ns."""
    clock = DeviceClock(TICK_HZ, BridgeCounters())
    for number in range(pings):
        now_ns = START_NS + number * S
        clock.round_trip(tick_of(now_ns, Way()), now_ns, now_ns)
    return clock, now_ns


@pytest.mark.parametrize(
    ("pings", "late_us", "taken"),
    [
        # The noise of 1 ms that is assumed fades by a thirtieth each PING; five sigmas of it ...
        (100, 900, True),  # 5 * 1000 * (29 / 30)**50 = 918
        (100, 936, False),
        # ... or half a millisecond, where five sigmas are less: 169.
        (200, 490, True),
        (200, 510, False),
    ],
)
def test_a_late_ping_is_left_out(pings: int, late_us: int, taken: bool) -> None:
    clock, now_ns = exact(pings)
    assert clock.drift_ppm == pytest.approx(0.0, abs=1e-6)
    made_ns = now_ns + S
    clock.round_trip(tick_of(made_ns, Way()), made_ns - late_us * 1000, made_ns)
    assert clock.drift_ppm is not None
    assert (abs(clock.drift_ppm) > 0.01) == taken


def test_after_five_late_pings_in_a_row_the_next_begins_a_new_line() -> None:
    clock, now_ns = exact(200)
    known = []
    for _ in range(6):
        now_ns += S
        clock.round_trip(tick_of(now_ns, Way()), now_ns - 5 * MS, now_ns)
        known.append(clock.drift_ppm is not None)
    assert known == [True] * 5 + [False]


def test_a_ping_that_comes_too_early_begins_a_new_line_at_once() -> None:
    clock, now_ns = exact(200)
    made_ns = now_ns + S
    for early_us, known in ((490, True), (510, False)):
        tick = tick_of(made_ns, Way()) - early_us
        clock, _ = exact(200)
        clock.round_trip(tick, made_ns, made_ns + MS)
        assert (clock.drift_ppm is not None) == known


@pytest.mark.parametrize(("ahead_us", "trusted"), [(990, True), (1010, False)])
def test_a_time_a_millisecond_after_its_arrival_is_no_fault(ahead_us: int, trusted: bool) -> None:
    clock, now_ns = exact(200)  # wrong by 10 parts in a million at most, and by a tick
    arrival_ns = now_ns + 10 * MS
    tick = tick_of(arrival_ns, Way()) + ahead_us + 1
    mapped_ns = clock.host_ns(tick, arrival_ns, now_ns)
    assert clock.trusted == trusted
    assert mapped_ns == (arrival_ns if trusted else now_ns - UNKNOWN_DELAY_NS)


def test_no_reading_is_older_than_ten_seconds() -> None:
    clock, now_ns = exact(200)
    tick = tick_of(now_ns, Way())
    assert clock.host_ns(tick, now_ns + 9 * S, now_ns) < now_ns
    clock, now_ns = exact(200)
    assert clock.host_ns(tick, now_ns + 11 * S, now_ns) == now_ns + S


def test_a_clock_that_was_wrong_must_prove_itself_longer_each_time() -> None:
    clock, now_ns = exact(3)
    for proof_ns in (S // 2, 2 * S, 8 * S, 8 * S):
        for _ in range(2):  # a tick that does not rise is a fault
            clock.host_ns(5, now_ns, now_ns)
        begin_ns = now_ns + S
        for after_ns, trusted in ((0, False), (proof_ns - MS, False), (proof_ns, True)):
            now_ns = begin_ns + after_ns
            clock.round_trip(tick_of(now_ns, Way()), now_ns, now_ns)
            assert clock.trusted == trusted
    assert clock.counters.clock_faults == 4


@pytest.mark.parametrize(("wrong_ppm", "faults"), [(480, 0), (520, 1), (-480, 0), (-520, 1)])
def test_a_rate_wrong_by_500_parts_in_a_million_is_a_fault(wrong_ppm: int, faults: int) -> None:
    clock = DeviceClock(TICK_HZ, BridgeCounters())
    for second in (0, 10):
        now_ns = START_NS + second * S
        clock.round_trip(1000 + second * (TICK_HZ + wrong_ppm), now_ns, now_ns)
    assert clock.counters.clock_faults == faults


@pytest.mark.parametrize(("late_pings", "remembered"), [(15, True), (16, False)])
def test_the_best_of_the_last_sixteen_pings_is_believed(late_pings: int, remembered: bool) -> None:
    """The last good one is up to 16 s old, so 160 us too old at ten parts in a million."""
    clock, now_ns = exact(200)
    for _ in range(late_pings):
        now_ns += S
        clock.round_trip(tick_of(now_ns, Way()), now_ns - MS * 4 // 10, now_ns)
    error_ns = clock.host_ns(tick_of(now_ns, Way()), now_ns + MS, now_ns) - now_ns
    assert (error_ns > -350_000) == remembered


def test_a_first_tick_of_zero_is_no_fault() -> None:
    clock = DeviceClock(TICK_HZ, BridgeCounters())
    clock.host_ns(0, START_NS, START_NS)
    assert (clock.counters.clock_faults, clock.counters.clock_fallbacks) == (0, 1)
