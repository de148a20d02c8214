"""A device's ticks on the host's clock: when a reading was made, however late it arrived.

A PING that is answered with the device's tick says that this tick was not before the PING was
sent. The latest of these lower bounds, carried on at the device's rate, is a time at which a
reading can not yet have been made, or only just: never too fresh, and too old by no more than the
shortest way there. The rate comes from a decaying linear regression over the PINGs that leaves out
late ones, as in Klipper's clock synchronisation. Arrivals of readings play no part in it, so
neither batches of a USB adapter nor a host that stalls disturb it.
"""

from __future__ import annotations

import itertools
import math
from collections import deque
from dataclasses import dataclass

RATE_TOLERANCE = 500e-6
"""Largest error of a device's rate that is believed; crystals keep 100 ppm."""
SLACK_MIN, SLACK_MAX = 10e-6, 200e-6
"""Limits of how wrong the rate in use is taken to be; at the upper one that is the nominal rate."""
SLACK_SIGMAS = 6.0
"""The rate is taken to be wrong by so many standard errors of the regression."""
DECAY = 1.0 / 30.0
"""Weight of a new PING in the regression: at one per second it remembers half a minute."""
NOISE_FIRST_NS = 1e6
"""Standard deviation of a PING's way there before it is known, ns."""
OUTLIER_SIGMAS = 5.0
OUTLIER_MIN_NS = 0.5e6
"""A PING that took longer than expected by both of these is left out of the regression."""
OUTLIERS_MAX = 5
"""After so many in a row it is not they that are wrong: the regression starts over."""
BOUNDS = 16
"""PINGs that are remembered, and among which the best lower bound is chosen."""
PROOF_FIRST_NS, PROOF_FACTOR, PROOF_MAX_NS = 500_000_000, 4, 8_000_000_000
"""A clock that was wrong is believed again when PINGs so far apart agree, ns: at first soon, for
it may have been reset; after each further fault later, for a wrong rate shows only with time."""
AHEAD_TOLERANCE_NS = 1_000_000
"""A time so much later than its arrival shows that the device's clock does not fit its past, ns."""
UNKNOWN_DELAY_NS = 20_000_000
"""Assumed delay of an arrival whose ticks say nothing: one latency timer of a USB serial adapter,
16 ms, and 4 ms for the rest."""
AGE_MAX_NS = 10_000_000_000
"""No reading is said to be older than this: what waits in buffers is seconds at most."""


@dataclass(frozen=True, slots=True)
class _Bound:
    """An answered PING: `tick` was neither before `sent_ns` nor after `received_ns`."""

    tick: int
    sent_ns: int
    received_ns: int


class DeviceClock:
    """Maps ticks of one device, from one reset to the next, to monotonic host time.

    No I/O, never raises. A mapped time is never later than the arrival and never more than
    `AGE_MAX_NS` before it; it goes back only when the clock stops being trusted. Where the ticks
    cannot be trusted (no PING answered yet, or the clock stands, falls back, is ahead of its
    arrivals, or is wrong by more than `RATE_TOLERANCE`) it is `UNKNOWN_DELAY_NS` before the last
    time when nothing was waiting to be read: rather too old than too fresh.

    Measured over 600 s of sweeps at 100 Hz, with a device's clock wrong by 100 ppm, a PING per
    second, an exponential delay of 1 ms on both ways and arrivals in batches of 16 ms: mapped
    times are 0.00 to 1.86 ms too old, median 0.18 ms. With 0.1 ms and no batches: 0.00 to 0.60 ms,
    median 0.04 ms (`python -m tests.drivers.spi.clock_error`).
    """

    def __init__(self, tick_hz: int) -> None:
        """`tick_hz` is the nominal rate, above 0."""
        self.faults = 0
        """Times that the device's clock stopped being trusted."""
        self.fallbacks = 0
        """Times mapped without the ticks."""
        self._ns_per_tick = 1e9 / tick_hz
        self._bounds: deque[_Bound] = deque(maxlen=BOUNDS)
        self._best: _Bound | None = None
        self._on_probation = False
        self._proof_ns = PROOF_FIRST_NS
        self._drift = _Drift()
        self._last_tick = -1
        self._last_ns = -AGE_MAX_NS
        """Last mapped time; at first one that is before all others."""

    @property
    def trusted(self) -> bool:
        """Whether the ticks are believed at present."""
        return self._best is not None

    @property
    def drift_ppm(self) -> float | None:
        """How much the device's clock is fast, parts per million; None while it is not known."""
        drift = self._drift
        return None if drift.slack == SLACK_MAX else (1.0 / (1.0 + drift.slope) - 1.0) * 1e6

    @property
    def rate_limits_ppm(self) -> tuple[float, float] | None:
        """Least and most that the clock is fast, as the PINGs remembered prove, ppm."""
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
        """Shortest round trip among the PINGs that are remembered, ns."""
        return min((bound.received_ns - bound.sent_ns for bound in self._bounds), default=None)

    def round_trip(self, tick: int, sent_ns: int, received_ns: int) -> None:
        """Take in an answered PING: host time taken before it was sent and after the answer."""
        bound = _Bound(tick, sent_ns, received_ns)
        if not all(self._fits(earlier, bound) for earlier in self._bounds):
            self._distrust()
        self._bounds.append(bound)
        self._drift.add(tick * self._ns_per_tick, sent_ns)
        if self._on_probation:
            if sent_ns - self._bounds[0].received_ns < self._proof_ns:
                return
            self._on_probation = False
        self._best = max(self._bounds, key=lambda earlier: self._earliest_ns(earlier, tick))

    def host_ns(self, tick: int, arrival_ns: int, idle_ns: int) -> int:
        """When `tick` was, host ns, of the next reading, which arrived at `arrival_ns`.

        `idle_ns` is the last time before that at which nothing was waiting to be read: the
        reading reached the host after it.
        """
        if tick <= self._last_tick:
            self._distrust()
        self._last_tick = tick
        mapped_ns = self._mapped_ns(tick, arrival_ns)
        if mapped_ns is None:
            self.fallbacks += 1
            mapped_ns = min(idle_ns, arrival_ns) - UNKNOWN_DELAY_NS
        # Made later than the reading before, so not older.
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
        """A time before which `tick` cannot have been, by this bound."""
        drift = self._drift
        passed_ns = (tick - bound.tick) * self._ns_per_tick * (1.0 + drift.slope)
        return bound.sent_ns + round(passed_ns - drift.slack * abs(passed_ns) - self._ns_per_tick)

    def _fits(self, earlier: _Bound, later: _Bound) -> bool:
        """Whether the ticks between two PINGs took as long as the host's clock allows."""
        passed_ns = (later.tick - earlier.tick) * self._ns_per_tick
        slack_ns = abs(passed_ns) * RATE_TOLERANCE + 2.0 * self._ns_per_tick
        shortest_ns = later.sent_ns - earlier.received_ns
        longest_ns = later.received_ns - earlier.sent_ns
        return shortest_ns - slack_ns <= passed_ns <= longest_ns + slack_ns

    def _distrust(self) -> None:
        if not self._on_probation:
            if self.faults:
                self._proof_ns = min(self._proof_ns * PROOF_FACTOR, PROOF_MAX_NS)
            self.faults += 1
        self._on_probation = True
        self._best = None
        self._last_ns = -AGE_MAX_NS
        self._bounds.clear()
        self._drift = _Drift()


class _Drift:
    """How a device's clock drifts: a decaying regression of its error over its time."""

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
        """Host ns per device ns, less one, and how wrong that may be."""
        if self._x_variance > 0.0:
            error = math.sqrt(self._noise_variance * DECAY / (2.0 * self._x_variance))
            slope, slack = self._covariance / self._x_variance, SLACK_SIGMAS * error
            if slack < SLACK_MAX and abs(slope) <= RATE_TOLERANCE:
                self.slope, self.slack = slope, max(slack, SLACK_MIN)

    def add(self, device_ns: float, sent_ns: int) -> None:
        """Take in a PING: the device's time at the nominal rate, and when it was sent, host ns."""
        if self._origin is None:
            self._origin = device_ns, sent_ns
        # Differences from the first PING keep the numbers small enough for their precision.
        x = device_ns - self._origin[0]
        y = (sent_ns - self._origin[1]) - x
        residual = y - self._y_mean - self.slope * (x - self._x_mean)
        limit = max(OUTLIER_SIGMAS * math.sqrt(self._noise_variance), OUTLIER_MIN_NS)
        if residual > limit or self._outliers >= OUTLIERS_MAX:
            self._restart(x, y)  # nothing arrives too early: the line was made of late ones
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
