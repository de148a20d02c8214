"""Sweeps of the serial bridge: what becomes of words, sensors, numbers and ticks."""

from __future__ import annotations

import random
from collections.abc import Iterator
from dataclasses import dataclass
from operator import itemgetter

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from graspd.drivers.base import ElectrodeFault
from graspd.drivers.biotac import E1, PAC, SEQUENCES, TDC
from graspd.drivers.spi.sweeps import BridgeCounters, ClockError, DeviceClock, SweepDecoder
from tests.drivers.spi.bridge_bench import T0, greeted, hear, hello, opened, sweep, words


@pytest.mark.parametrize(
    "channels", [SEQUENCES["electrodes"], SEQUENCES["all"], SEQUENCES["interleaved"]]
)
def test_a_sweep_becomes_a_reading_by_slot_and_sensor(channels: tuple[int, ...]) -> None:
    conversation = greeted(hello(0, channels=channels))
    read = words(1000, len(channels))
    (reading,) = hear(conversation, sweep(0, 100, read=read), T0)
    assert reading.seq == 0
    assert not reading.faults.any()
    for electrode in range(24):
        slot = channels.index(E1 + electrode)
        assert reading.counts[:, electrode].tolist() == [1000 + 10 * slot + i for i in range(3)]


@pytest.mark.parametrize(
    ("sensors", "columns"),
    [(("th", "mf", "ff"), [2, 1, 0]), (("mf", "th", "ff"), [2, 0, 1])],
)
def test_sensors_are_read_in_finger_order_whatever_the_wiring(
    sensors: tuple[str, ...], columns: list[int]
) -> None:
    conversation = greeted(sensors=sensors)
    present = 7 & ~(1 << columns[2])
    (reading,) = hear(conversation, sweep(0, 100, present), T0)
    assert reading.counts[:2, 0].tolist() == [1000 + column for column in columns[:2]]
    assert (reading.faults[2] == ElectrodeFault.MISSING).all()
    assert not reading.faults[:2].any()
    assert not reading.counts[2].any(), "whatever its words say"
    counters = conversation.counters
    assert (counters.absent_sensors, counters.unplugged_words) == (1, 0)


def test_electrodes_that_are_not_in_the_sequence_are_missing() -> None:
    conversation = greeted(hello(0, channels=(PAC, E1 + 5, TDC, E1)))
    (reading,) = hear(conversation, sweep(0, 100, read=words(1000, 4)), T0)
    there = [0, 5]
    assert reading.counts[1, there].tolist() == [1031, 1011]
    assert not reading.faults[:, there].any()
    missing = np.delete(reading.faults, there, axis=1)
    assert (missing == ElectrodeFault.MISSING).all()
    counters = conversation.counters
    assert (counters.faulty_readings, counters.unplugged_words) == (1, 0)


def test_a_board_may_have_more_sensors_than_fingers_are_named() -> None:
    conversation = greeted(hello(0, sensors=5))
    (reading,) = hear(conversation, sweep(0, 100, 31, words(1000, 24, 5)), T0)
    assert reading.counts[:, 0].tolist() == [1000, 1001, 1002]
    assert not reading.faults.any()


def test_a_sweep_from_before_stop_is_stale() -> None:
    conversation = greeted(hello(0, tick=50_000))
    sent = (sweep(4711, 49_000), sweep(0, 51_000), sweep(1, 61_000))
    made = [reading.seq for each in sent for reading in hear(conversation, each, T0)]
    assert made == [0, 1]
    counters = conversation.counters
    assert (counters.stale_sweeps, counters.missed_readings) == (1, 0)
    never_started = opened()
    assert hear(never_started, sweep(0, 51_000), T0) == []
    assert never_started.counters.stale_sweeps == 1


def test_a_sweep_unlike_the_hello_is_counted_bad() -> None:
    conversation = greeted()
    assert hear(conversation, sweep(0, 10_000, read=words(slots=23)), T0) == []
    assert conversation.counters.bad_frames == 1


def test_the_first_reading_after_a_restart_is_marked_interrupted() -> None:
    counters, interrupted = BridgeCounters(), []
    for sweeps in (1, 3):
        decoder = SweepDecoder(hello(0), (0, 1, 2), counters, DeviceClock(1_000_000, 0, 0, 0))
        for number in range(sweeps):
            reading = decoder.reading(sweep(number, number * 10_000), (number + 1) * 10_000_000)
            assert reading is not None
            interrupted.append(reading.interrupted)
    assert interrupted == [False, True, False, False]


MS = 1_000_000
S = 1_000_000_000
TICK_HZ = 1_000_000
START_NS = 5_000 * S
"""Host time when the device was reset: any large number."""
AGE_MAX_NS = 10 * S
DOUBT_NS = 20 * MS


@dataclass(frozen=True, slots=True)
class Way:
    """How messages travel, both ways, and how the device's clock runs."""

    jitter_ms: float = 1.0
    """Mean of an exponential delay, both ways."""
    batch_ms: float = 16.0
    """Arrivals wait for the next multiple of this; 0 for none."""
    lag_ms: float = 0.0
    """Delay of every message, both ways, as of a line that is full."""
    drifts_ppm: tuple[float, ...] = (0.0,)
    """Drift of the device's clock in each second, above 0 if fast; repeated from the start."""
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


def events(way: Way, duration_s: int) -> Iterator[tuple[int, int, int | None]]:
    """Sweeps at 100 Hz and PINGs, four a second, in order of arrival.

    Yields host times, ns: of the device's tick, of arrival, and of the PING; None: it is a sweep.
    """
    rng = random.Random(way.seed)
    batch_ns = round(way.batch_ms * MS)

    def delay_ns() -> int:
        delay_ms = rng.expovariate(1.0 / way.jitter_ms) if way.jitter_ms else 0.0
        stall_ms = rng.uniform(0.0, 1000.0) if rng.random() < way.stall_probability else 0.0
        return round((delay_ms + stall_ms + way.lag_ms) * MS)

    def arrival_ns(made_ns: int) -> int:
        ready_ns = made_ns + delay_ns()
        return -(-ready_ns // batch_ns) * batch_ns if batch_ns else ready_ns

    made: list[tuple[int, int, int | None]] = []
    for k in range(duration_s * 100):
        made_ns = START_NS + S + k * S // 100
        made.append((made_ns, arrival_ns(made_ns), None))
    for send_ms in range(0, 1000 * duration_s, 247):
        sent_ns = START_NS + S + send_ms * MS
        made_ns = sent_ns + delay_ns()
        made.append((made_ns, arrival_ns(made_ns), sent_ns))
    last_ns = 0
    for made_ns, at_ns, ping_ns in sorted(made, key=itemgetter(0)):  # a line keeps the order
        last_ns = max(last_ns, at_ns)
        yield made_ns, last_ns, ping_ns


def too_old_ns(way: Way, duration_s: int) -> Iterator[tuple[int, int]]:
    """Yield by how much each sweep after the first answer looks too old, and the most allowed.

    The most is the time that a PING took to the device, a thousandth of the time since (half for
    the real drift, half for the assumed one), and two ticks; the best of the last eight PINGs.
    """
    pings: list[tuple[int, int]] = []
    clock = None
    for made_ns, arrival_ns, sent_ns in events(way, duration_s):
        tick = way.tick(made_ns)
        if sent_ns is not None:
            pings = [*pings[-7:], (sent_ns, made_ns)]
            if clock is None:
                clock = DeviceClock(way.tick_hz, tick, sent_ns, arrival_ns)
            clock.round_trip(tick, sent_ns, arrival_ns)
        elif clock is not None and made_ns > pings[0][1] + MS:
            most_ns = min(
                heard_ns - ping_ns + round(abs(made_ns - heard_ns) * 1.001e-3)
                for ping_ns, heard_ns in pings
            )
            yield made_ns - clock.host_ns(tick, arrival_ns), most_ns + 2 * S // way.tick_hz + 2


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
    for too_old, most in too_old_ns(way, 12):
        assert 0 <= too_old <= most


@pytest.mark.parametrize("drift_ppm", [-100.0, 100.0])
def test_times_of_sweeps_in_batches_are_right_to_two_milliseconds(drift_ppm: float) -> None:
    """Delays are drawn at random, so the limits are measured ones (`deploy/MEASURED.md`)."""
    way = Way(drifts_ppm=(drift_ppm,), seed=1)
    errors_ms = np.array([too_old / MS for too_old, _ in too_old_ns(way, 120)])
    assert len(errors_ms) > 11_900
    assert errors_ms[1000:].max() < 2.0
    assert np.median(errors_ms) < 0.6


def exact(pings: int, wrong_ppm: int = 0) -> tuple[DeviceClock, int]:
    """A clock after PINGs that took no time, one a second, and the host time of the last, ns.

    `wrong_ppm`: by how much its rate differs from the nominal one.
    """
    clock = DeviceClock(TICK_HZ, TICK_HZ, START_NS, START_NS)
    for second in range(1, pings):
        now_ns = START_NS + second * S
        clock.round_trip(TICK_HZ + second * (TICK_HZ + wrong_ppm), now_ns, now_ns)
    return clock, START_NS + (pings - 1) * S


@pytest.mark.parametrize("tick", [0, TICK_HZ, 3 * TICK_HZ + 5000])
def test_a_clock_that_stands_or_falls_back_raises(tick: int) -> None:
    """`tick`: that of a reset clock, of the first PING, or of the last reading."""
    clock, now_ns = exact(3)
    clock.host_ns(3 * TICK_HZ + 5000, now_ns + 5 * MS)
    with pytest.raises(ClockError, match="stands or falls back"):
        clock.host_ns(tick, now_ns + 20 * MS)


@pytest.mark.parametrize(("ahead_us", "is_wrong"), [(6, False), (7, True)])
def test_a_clock_ahead_of_its_readings_arrivals_is_doubted(ahead_us: int, is_wrong: bool) -> None:
    clock, now_ns = exact(3)
    arrival_ns = now_ns + 10 * MS  # wrong by 5 us at most, and by a tick
    tick = 3 * TICK_HZ + 10_000 + ahead_us
    if not is_wrong:
        assert clock.host_ns(tick, arrival_ns) == arrival_ns - 3  # 6000 less 5003 and 1000
        return
    assert clock.host_ns(tick, arrival_ns) == arrival_ns - DOUBT_NS
    assert clock.is_doubted


@pytest.mark.parametrize("wrong_ppm", [-501, -499, 499, 501])
def test_a_rate_wrong_by_over_500_ppm_is_doubted(wrong_ppm: int) -> None:
    clock, now_ns = exact(11, wrong_ppm)
    assert clock.is_doubted == (abs(wrong_ppm) > 500)
    tick = 11 * TICK_HZ + 10 * wrong_ppm
    clock.round_trip(tick + TICK_HZ, now_ns + S, now_ns + S)
    assert not clock.is_doubted


def test_a_device_clock_standing_20_ms_between_pings_is_doubted() -> None:
    """The first PING took 100 ms; the second one is short, so that 20 ms show."""
    clock = DeviceClock(TICK_HZ, TICK_HZ, START_NS, START_NS + 100 * MS)
    clock.round_trip(2 * TICK_HZ, START_NS + S, START_NS + S)
    assert not clock.is_doubted
    assert clock.round_trip_ns == 0, "the shortest"
    late_ns = START_NS + 2 * S + 20 * MS
    clock.round_trip(3 * TICK_HZ, late_ns, late_ns)
    assert clock.is_doubted


@given(st.floats(-80_000.0, 80_000.0), st.integers(0, 99))
def test_a_wrong_rate_makes_no_reading_20_ms_too_new(wrong_ppm: float, seed: int) -> None:
    """Rates are wrong while a computer's time is set; PINGs show it to within a round trip."""
    too_old = [ns for ns, _ in too_old_ns(Way(drifts_ppm=(wrong_ppm,), seed=seed), 5)]
    assert min(too_old) >= -DOUBT_NS


@pytest.mark.parametrize(("wrong_ppm", "lag_ms"), [(600, 120), (3_000, 150), (10_000, 400)])
def test_wrong_rates_make_no_reading_too_new_on_slow_lines(wrong_ppm: float, lag_ms: float) -> None:
    way = Way(batch_ms=0.0, drifts_ppm=(wrong_ppm,), lag_ms=lag_ms)
    too_old = [ns for ns, _ in too_old_ns(way, 300)]
    assert len(too_old) > 29_000
    assert min(too_old) >= 0


def test_times_fall_back_after_a_ping_corrects_a_wrong_bound() -> None:
    """The clock gained 90 ms where readings come 150 ms late; a PING shows it."""
    clock, now_ns = exact(3)
    tick = 3 * TICK_HZ + 90_000
    assert clock.host_ns(tick, now_ns + 150 * MS) > now_ns + 80 * MS
    clock.round_trip(tick + 10_000, now_ns + 10 * MS, now_ns + 10 * MS)
    assert clock.host_ns(tick + 20_000, now_ns + 170 * MS) <= now_ns + 20 * MS


def test_no_reading_is_older_than_ten_seconds() -> None:
    for seconds, age_ns in ((9, 9 * S - 1000 * 1000 + 1500), (11, AGE_MAX_NS)):
        clock, now_ns = exact(3)
        arrival_ns = now_ns + seconds * S
        assert clock.host_ns(3 * TICK_HZ + 1000, arrival_ns) == arrival_ns - age_ns


@given(ways, st.integers(3 * S, 3600 * S), st.booleans())
def test_a_clock_that_jumps_raises_at_once(way: Way, jump_ns: int, back: bool) -> None:
    """Ahead: a computer slept, its clock stood meanwhile. `back`: a counter wraps or is reset."""
    clock = DeviceClock(way.tick_hz, way.tick(START_NS), START_NS, START_NS + S)
    sweeps = [(made_ns, at_ns) for made_ns, at_ns, sent_ns in events(way, 5) if sent_ns is None]
    for made_ns, arrival_ns in sweeps[:200]:
        clock.host_ns(way.tick(made_ns), arrival_ns)
    made_ns, arrival_ns = sweeps[200]
    tick = way.tick(made_ns)
    with pytest.raises(ClockError):
        clock.host_ns(tick % 1000 if back else tick + jump_ns * way.tick_hz // S, arrival_ns)
