"""Convert sweeps of a bridge to readings with the time at which they were made. No I/O.

The answer to a PING holds a tick of the bridge's clock. The tick was not before the PING was sent,
which gives a lower bound of its time. From there, time goes on at the bridge's measured rate. The
latest bound is used. A reading never looks too new, and looks too old by at most the shortest time
that a PING takes to the bridge.

The rate comes from a decaying linear regression that leaves out late PINGs, as in Klipper. Arrival
times of readings are not used, so batches of a USB adapter and stalls of the host do no harm.
"""

from __future__ import annotations

import itertools
import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from graspd.drivers.base import ELECTRODES, ElectrodeFault, TactileReading
from graspd.drivers.biotac import E1, E24, channel_of, make_reading
from graspd.drivers.spi.messages import FrameCounters, Hello, Sweep

SEQ_HALF, SEQ_END = 1 << 31, 1 << 32
SEQ_FIRST_MAX = 1_000
"""Highest believed number of the first sweep after START.

A higher one means that the bridge was sweeping before START; no sweep was lost then.
"""
RATE_TOLERANCE = 500e-6
"""Largest believed error of a bridge's rate, as a share of it; crystals keep 100 ppm."""
SLACK_MIN, SLACK_MAX = 10e-6, 200e-6
"""Limits of the assumed error of the rate, as a share of it.

At the upper limit the nominal rate is used instead of the measured one.
"""
SLACK_SIGMAS = 6.0
"""Assumed error of the rate as a multiple of the regression's standard error."""
DECAY = 1.0 / 30.0
"""Weight of a new PING in the regression: with one a second, half a minute is remembered."""
NOISE_FIRST_NS = 1e6
"""Assumed standard deviation of the time of a PING to the bridge, ns, until it is measured."""
OUTLIER_SIGMAS = 5.0
OUTLIER_MIN_NS = 0.5e6
"""A PING that took longer than expected by both of these is left out of the regression."""
OUTLIERS_MAX = 5
"""After this many outliers in a row, the regression is taken for wrong and starts again."""
BOUNDS = 16
"""Number of PINGs that are kept; the best lower bound is one of them."""
PROOF_FIRST_NS, PROOF_FACTOR, PROOF_MAX_NS = 500_000_000, 4, 8_000_000_000
"""A clock that was wrong is trusted again when PINGs this far apart, ns, agree with it.

The first time is short, because a reset of the board is over at once. Each further fault
multiplies it, up to the last value, because a wrong rate shows only slowly.
"""
AHEAD_TOLERANCE_NS = 1_000_000
"""Most that a mapped time may lie after the arrival, ns; more means that the clock is wrong."""
UNKNOWN_DELAY_NS = 20_000_000
"""Assumed delay while the clock is not trusted, ns: 16 ms in a USB adapter, 4 ms elsewhere."""
AGE_MAX_NS = 10_000_000_000
"""Greatest age of a mapped time, ns; buffers on the way hold a few seconds at most."""


@dataclass(slots=True)
class BridgeCounters(FrameCounters):
    """Counters of frames, sweeps and the link; they go on when the port is reopened."""

    unknown_frames: int = 0
    """Whole frames of a type that no bridge of version 1 sends."""
    bad_frames: int = 0
    """Whole frames with content that the protocol forbids, or that does not fit the HELLO."""
    duplicates: int = 0
    reordered: int = 0
    """Sweeps that came after a later one; dropped, and also counted as missed."""
    stale_sweeps: int = 0
    """Sweeps from before START, dropped."""
    parity_words: int = 0
    error_words: int = 0
    unplugged_words: int = 0
    """Words of a line that no sensor drives. These three leave out absent sensors."""
    absent_sensors: int = 0
    """Sensors without a serial number; each counts once in each sweep."""
    link_losses: int = 0
    link_failures: int = 0
    """Times that opening or greeting failed, or the link was lost."""
    refused_bridges: int = 0
    """Greetings of a bridge whose version, layout or number of sensors does not fit."""
    restarts: int = 0
    """Resets that the bridge reported while it was sweeping."""
    unanswered_pings: int = 0
    host_tx_dropped: int = 0
    """Frames to the bridge that were dropped because the port's buffer was full."""
    clock_faults: int = 0
    """Times that the bridge's clock stopped being trusted."""
    clock_fallbacks: int = 0
    """Readings whose time is estimated from their arrival, as the clock was not trusted."""
    bridge_overruns: int = 0
    bridge_tx_dropped: int = 0
    bridge_rx_errors: int = 0
    """Damaged frames. These three are the bridge's own, since its reset, by the last STATUS."""


class SweepDecoder:
    """Decoder of sweeps into readings, from one START to the loss of the link."""

    def __init__(self, hello: Hello, sensors: Sequence[int], counters: BridgeCounters) -> None:
        """`hello`: describes the sampling. `sensors`: number of each row's sensor, from 0."""
        self.hello = hello
        self.clock = DeviceClock(hello.tick_hz, counters)
        self.longest_ticks = 0
        self._sensors = tuple(sensors)
        self._counters = counters
        self._bridge_seq: int | None = None
        self._interrupted = counters.readings > 0
        self._source = np.zeros((len(sensors), ELECTRODES), dtype=np.intp)
        """Index of each electrode's word in a sweep, shape (fingers, 24)."""
        self._marks = np.full(self._source.shape, ElectrodeFault.MISSING, dtype=np.uint8)
        """Faults of a sweep if all sensors are present: electrodes not sampled are missing."""
        for slot, command in enumerate(hello.commands):
            channel = channel_of(command)
            if channel is not None and E1 <= channel <= E24:
                self._source[:, channel - E1] = slot * hello.sensors + np.array(sensors)
                self._marks[:, channel - E1] = ElectrodeFault.NONE

    def reading(self, sweep: Sweep, arrival_ns: int, idle_ns: int) -> TactileReading | None:
        """Return the reading of a sweep; None if the sweep is old or does not fit the HELLO."""
        if sweep.words.shape != (self.hello.slots, self.hello.sensors):
            self._counters.bad_frames += 1
            return None
        if not self._is_next(sweep):
            return None
        self.longest_ticks = max(self.longest_ticks, sweep.tick_end - sweep.tick_start)
        t_ns = self.clock.host_ns(sweep.tick_end, arrival_ns, idle_ns)
        words = sweep.words.ravel().astype(np.intp)[self._source]
        interrupted, self._interrupted = self._interrupted, False
        marks = self._marks_of(sweep)
        return make_reading(words, marks, t_ns, self._counters, interrupted=interrupted)

    def _is_next(self, sweep: Sweep) -> bool:
        """Return True if the sweep is newer than all before, and count the missing ones."""
        if self._bridge_seq is None:
            if sweep.tick_start < self.hello.tick:
                self._counters.stale_sweeps += 1  # the sweep was under way when STOP arrived
                return False
            missed = sweep.seq if sweep.seq <= SEQ_FIRST_MAX else 0
        else:
            step = (sweep.seq - self._bridge_seq) % SEQ_END
            if step == 0 or step >= SEQ_HALF:
                self._counters.duplicates += step == 0
                self._counters.reordered += step != 0
                return False
            missed = step - 1
        self._bridge_seq = sweep.seq
        self._counters.missed_readings += missed
        return True

    def _marks_of(self, sweep: Sweep) -> NDArray[np.uint8]:
        absent = [
            row for row, sensor in enumerate(self._sensors) if not sweep.present >> sensor & 1
        ]
        if not absent:
            return self._marks
        self._counters.absent_sensors += len(absent)
        marks = self._marks.copy()
        marks[absent] = ElectrodeFault.MISSING
        return marks


class _Bound(NamedTuple):
    """An answered PING: the clock showed `tick` between `sent_ns` and `received_ns`."""

    tick: int
    sent_ns: int
    received_ns: int


class DeviceClock:
    """Map the ticks of one bridge, from one reset to the next, to monotonic host time.

    A mapped time is never later than the arrival, and at most `AGE_MAX_NS` before it. It goes back
    only when the clock stops being trusted. Ticks are not trusted before the first answered PING,
    nor if the clock stands, falls back, is ahead of its arrivals, or is wrong by more than
    `RATE_TOLERANCE`. The time is then `UNKNOWN_DELAY_NS` before the last time at which no byte
    waited to be read. It may be too old, never too new (deploy/MEASURED.md).
    """

    def __init__(self, tick_hz: int, counters: BridgeCounters) -> None:
        """`tick_hz`: nominal rate, Hz, above 0."""
        self.counters = counters
        self._ns_per_tick = 1e9 / tick_hz
        self._bounds: deque[_Bound] = deque(maxlen=BOUNDS)
        self._best: _Bound | None = None
        self._is_on_probation = False
        self._proof_ns = PROOF_FIRST_NS
        self._drift = _Drift()
        self._last_tick = -1
        self._last_ns = -AGE_MAX_NS

    @property
    def trusted(self) -> bool:
        """True if times come from the ticks now."""
        return self._best is not None

    @property
    def drift_ppm(self) -> float | None:
        """Drift of the bridge's clock, ppm, positive if it is fast; None: not known yet."""
        drift = self._drift
        return None if drift.slack == SLACK_MAX else (1.0 / (1.0 + drift.slope) - 1.0) * 1e6

    @property
    def rate_limits_ppm(self) -> tuple[float, float] | None:
        """Lower and upper limit of the drift, ppm, by the kept PINGs; None: not known yet."""
        least, most = -math.inf, math.inf
        for first, last in itertools.combinations(self._bounds, 2):
            if last.sent_ns > first.received_ns:
                ticks = last.tick - first.tick
                shortest = (ticks - 1) * self._ns_per_tick / (last.received_ns - first.sent_ns)
                longest = (ticks + 1) * self._ns_per_tick / (last.sent_ns - first.received_ns)
                least, most = max(least, shortest), min(most, longest)
        return None if most == math.inf else (1e6 * (least - 1.0), 1e6 * (most - 1.0))

    @property
    def round_trip_ns(self) -> int | None:
        """Shortest round trip of the kept PINGs, ns; None before the first."""
        return min((bound.received_ns - bound.sent_ns for bound in self._bounds), default=None)

    def round_trip(self, tick: int, sent_ns: int, received_ns: int) -> None:
        """Add an answered PING: host time before it was sent, and after its answer came."""
        bound = _Bound(tick, sent_ns, received_ns)
        if not all(self._fits(earlier, bound) for earlier in self._bounds):
            self._distrust()
        self._bounds.append(bound)
        self._drift.add(tick * self._ns_per_tick, sent_ns)
        if self._is_on_probation:
            if sent_ns - self._bounds[0].received_ns < self._proof_ns:
                return
            self._is_on_probation = False
            self._proof_ns = min(self._proof_ns * PROOF_FACTOR, PROOF_MAX_NS)
        self._best = max(self._bounds, key=lambda earlier: self._earliest_ns(earlier, tick))

    def host_ns(self, tick: int, arrival_ns: int, idle_ns: int) -> int:
        """Return the host time, ns, of a reading's `tick`.

        `arrival_ns`: when the reading arrived. `idle_ns`: last earlier time at which no byte
        waited to be read.
        """
        if tick <= self._last_tick:
            self._distrust()
        self._last_tick = tick
        mapped_ns = self._mapped_ns(tick, arrival_ns)
        if mapped_ns is None:
            self.counters.clock_fallbacks += 1
            mapped_ns = min(idle_ns, arrival_ns) - UNKNOWN_DELAY_NS
        # The reading was made after the one before, so it is not older.
        mapped_ns = max(mapped_ns, self._last_ns, arrival_ns - AGE_MAX_NS)
        self._last_ns = min(mapped_ns, arrival_ns)
        return self._last_ns

    def _mapped_ns(self, tick: int, arrival_ns: int) -> int | None:
        if self._best is None:
            return None
        earliest_ns = self._earliest_ns(self._best, tick)
        if earliest_ns > arrival_ns + AHEAD_TOLERANCE_NS:
            self._distrust()
            return None
        return earliest_ns

    def _earliest_ns(self, bound: _Bound, tick: int) -> int:
        """Return the earliest time, ns, that `tick` can have had, by one PING."""
        drift = self._drift
        passed_ns = (tick - bound.tick) * self._ns_per_tick * (1.0 + drift.slope)
        return bound.sent_ns + round(passed_ns - drift.slack * abs(passed_ns) - self._ns_per_tick)

    def _fits(self, earlier: _Bound, later: _Bound) -> bool:
        """Return True if the ticks between two PINGs agree with the host's clock."""
        passed_ns = (later.tick - earlier.tick) * self._ns_per_tick
        slack_ns = abs(passed_ns) * RATE_TOLERANCE + 2.0 * self._ns_per_tick
        shortest_ns = later.sent_ns - earlier.received_ns
        longest_ns = later.received_ns - earlier.sent_ns
        return shortest_ns - slack_ns <= passed_ns <= longest_ns + slack_ns

    def _distrust(self) -> None:
        if not self._is_on_probation:
            self.counters.clock_faults += 1
        self._is_on_probation = True
        self._best = None
        self._last_ns = -AGE_MAX_NS
        self._bounds.clear()
        self._drift = _Drift()


class _Drift:
    """Drift of a bridge's clock, by a decaying regression of its error over its time."""

    def __init__(self) -> None:
        self._origin: tuple[float, int] | None = None
        self._restart(0.0, 0.0)

    def _restart(self, x: float, y: float) -> None:
        self._x_mean, self._y_mean = x, y
        self._x_variance = self._covariance = 0.0
        self._noise_variance = NOISE_FIRST_NS**2
        self._outliers = 0
        self._conclude()

    def _conclude(self) -> None:
        self.slope, self.slack = 0.0, SLACK_MAX
        """Drift (host ns per device ns, less one), and its largest assumed error."""
        if self._x_variance > 0.0:
            error = math.sqrt(self._noise_variance * DECAY / (2.0 * self._x_variance))
            slope, slack = self._covariance / self._x_variance, SLACK_SIGMAS * error
            if slack < SLACK_MAX and abs(slope) <= RATE_TOLERANCE:
                self.slope, self.slack = slope, max(slack, SLACK_MIN)

    def add(self, device_ns: float, sent_ns: int) -> None:
        """Add a PING: its tick in ns of the nominal rate, and when it was sent, host ns."""
        if self._origin is None:
            self._origin = device_ns, sent_ns
        # Differences from the first PING stay small enough for the precision of a float.
        x = device_ns - self._origin[0]
        y = (sent_ns - self._origin[1]) - x
        residual = y - self._y_mean - self.slope * (x - self._x_mean)
        limit = max(OUTLIER_SIGMAS * math.sqrt(self._noise_variance), OUTLIER_MIN_NS)
        if residual > limit or self._outliers >= OUTLIERS_MAX:
            self._restart(x, y)  # no PING arrives too early: the line came from late ones
            return
        if residual < -limit:
            self._outliers += 1
            return
        self._outliers = 0
        dx, dy = x - self._x_mean, y - self._y_mean
        self._x_mean += DECAY * dx
        self._y_mean += DECAY * dy
        self._x_variance = (1.0 - DECAY) * (self._x_variance + DECAY * dx * dx)
        self._covariance = (1.0 - DECAY) * (self._covariance + DECAY * dx * dy)
        self._noise_variance = (1.0 - DECAY) * (self._noise_variance + DECAY * residual**2)
        self._conclude()
