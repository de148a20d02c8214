"""Sweeps of a bridge -> readings with the time at which they were made. No I/O.

A PING that is answered with a tick proves that this tick was not before the PING was sent. The
latest of these lower bounds, carried on at the bridge's rate, makes a reading never too fresh, and
too old by at most the shortest way there. The rate comes from a decaying linear regression that
leaves out late PINGs, as in Klipper. Arrivals of readings play no part, so that neither batches of
a USB adapter nor a stall of the host disturb it.
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
"""A first sweep with a higher number shows a bridge that was sweeping before START, no loss."""
RATE_TOLERANCE = 500e-6
"""Largest error of a bridge's rate that is believed; crystals keep 100 ppm."""
SLACK_MIN, SLACK_MAX = 10e-6, 200e-6
"""Limits of the assumed error of the rate in use; at the upper one it is the nominal rate."""
SLACK_SIGMAS = 6.0
"""Assumed error of the rate, in standard errors of the regression."""
DECAY = 1.0 / 30.0
"""Weight of a new PING in the regression: at one per second it remembers half a minute."""
NOISE_FIRST_NS = 1e6
"""Standard deviation of the time that a PING takes to the bridge, until it is known, ns."""
OUTLIER_SIGMAS = 5.0
OUTLIER_MIN_NS = 0.5e6
"""A PING that took longer than expected by both of these is left out of the regression."""
OUTLIERS_MAX = 5
"""After this many in a row the regression is wrong, not they: it starts over."""
BOUNDS = 16
"""PINGs that are remembered; the best lower bound is one of them."""
PROOF_FIRST_NS, PROOF_FACTOR, PROOF_MAX_NS = 500_000_000, 4, 8_000_000_000
"""A clock that was wrong is trusted again when PINGs this far apart agree, ns. The first time is
short, as it may have been reset; each further fault needs longer, as a wrong rate shows slowly."""
AHEAD_TOLERANCE_NS = 1_000_000
"""A mapped time this much later than its arrival, ns, shows a clock that does not fit its past."""
UNKNOWN_DELAY_NS = 20_000_000
"""Assumed delay without trusted ticks, ns: 16 ms of a USB serial adapter, 4 ms for the rest."""
AGE_MAX_NS = 10_000_000_000
"""No mapped time is older than this, ns: buffers hold seconds at most."""


@dataclass(slots=True)
class BridgeCounters(FrameCounters):
    """Counters of frames, sweeps and the link, over all reopenings of the port."""

    unknown_frames: int = 0
    """Whole frames of a type that a bridge of version 1 never sends."""
    bad_frames: int = 0
    """Whole frames whose content the protocol forbids or that do not fit the HELLO."""
    duplicates: int = 0
    """Sweeps that came twice, the second dropped."""
    reordered: int = 0
    """Sweeps that came after a later one; dropped, and also counted as missed."""
    stale_sweeps: int = 0
    """Sweeps from before START, dropped."""
    parity_words: int = 0
    error_words: int = 0
    unplugged_words: int = 0
    """Words of electrodes by their fault, without those of absent sensors."""
    absent_sensors: int = 0
    """Sensors without serial number, one per sweep and sensor."""
    link_losses: int = 0
    """Times that a link that was up was lost."""
    link_failures: int = 0
    """Times that opening or greeting failed or the link was lost."""
    refused_bridges: int = 0
    """Greetings of a bridge with another version, layout or number of sensors."""
    restarts: int = 0
    """Times that the bridge told of a reset while it was sweeping."""
    unanswered_pings: int = 0
    host_tx_dropped: int = 0
    """Frames to the bridge for which there was no room."""
    clock_faults: int = 0
    """Times that the bridge's clock stopped being trusted."""
    clock_fallbacks: int = 0
    """Readings whose time is estimated from their arrival alone."""
    bridge_overruns: int = 0
    bridge_tx_dropped: int = 0
    bridge_rx_errors: int = 0
    """Counters of the last STATUS, which begin at the bridge's reset."""


class SweepDecoder:
    """Sweeps in, readings out, from one START to the loss of the link."""

    def __init__(self, hello: Hello, sensors: Sequence[int], counters: BridgeCounters) -> None:
        """`hello` describes the sampling; `sensors`: the bridge's sensor, from 0, of each row."""
        self.hello = hello
        self.clock = DeviceClock(hello.tick_hz, counters)
        self.longest_ticks = 0
        """Duration of the longest sweep, ticks."""
        self._sensors = tuple(sensors)
        self._counters = counters
        self._bridge_seq: int | None = None
        self._source = np.zeros((len(sensors), ELECTRODES), dtype=np.intp)
        """Place of each electrode's word in a sweep."""
        self._marks = np.full(self._source.shape, ElectrodeFault.MISSING, dtype=np.uint8)
        """Faults of a sweep of present sensors: electrodes that are not sampled are missing."""
        for slot, command in enumerate(hello.commands):
            channel = channel_of(command)
            if channel is not None and E1 <= channel <= E24:
                self._source[:, channel - E1] = slot * hello.sensors + np.array(sensors)
                self._marks[:, channel - E1] = ElectrodeFault.NONE

    def reading(self, sweep: Sweep, arrival_ns: int, idle_ns: int) -> TactileReading | None:
        """Return the reading of a sweep, or None for one that is not newer or does not fit."""
        if sweep.words.shape != (self.hello.slots, self.hello.sensors):
            self._counters.bad_frames += 1
            return None
        if not self._is_next(sweep):
            return None
        self.longest_ticks = max(self.longest_ticks, sweep.tick_end - sweep.tick_start)
        t_ns = self.clock.host_ns(sweep.tick_end, arrival_ns, idle_ns)
        words = sweep.words.ravel().astype(np.intp)[self._source]
        return make_reading(words, self._marks_of(sweep), t_ns, self._counters)

    def _is_next(self, sweep: Sweep) -> bool:
        """Return True for a sweep newer than all before; count the missing ones."""
        if self._bridge_seq is None:
            if sweep.tick_start < self.hello.tick:
                self._counters.stale_sweeps += 1  # it was under way when STOP arrived
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
    """An answered PING: `tick` was neither before `sent_ns` nor after `received_ns`."""

    tick: int
    sent_ns: int
    received_ns: int


class DeviceClock:
    """Maps the ticks of one bridge, from one reset to the next, to monotonic host time.

    A mapped time is never later than the arrival and at most `AGE_MAX_NS` before it; it goes back
    only when the clock stops being trusted. Ticks are not trusted before the first answered PING,
    and when the clock stands, falls back, is ahead of its arrivals, or is wrong by more than
    `RATE_TOLERANCE`. Then the time is `UNKNOWN_DELAY_NS` before the last time when nothing was
    waiting to be read: rather too old than too fresh (deploy/MEASURED.md).
    """

    def __init__(self, tick_hz: int, counters: BridgeCounters) -> None:
        """`tick_hz`: nominal rate, above 0."""
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
        """True if the ticks are used at present."""
        return self._best is not None

    @property
    def drift_ppm(self) -> float | None:
        """Drift of the bridge's clock, ppm, positive if fast; None: not known yet."""
        drift = self._drift
        return None if drift.slack == SLACK_MAX else (1.0 / (1.0 + drift.slope) - 1.0) * 1e6

    @property
    def rate_limits_ppm(self) -> tuple[float, float] | None:
        """Limits of the drift by the remembered PINGs, ppm."""
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
        """Shortest round trip among the remembered PINGs, ns."""
        return min((bound.received_ns - bound.sent_ns for bound in self._bounds), default=None)

    def round_trip(self, tick: int, sent_ns: int, received_ns: int) -> None:
        """Take an answered PING: host time before it was sent and after the answer came."""
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
        """Return the host time, ns, of the `tick` of a reading that arrived at `arrival_ns`.
        `idle_ns`: last time before it at which nothing was waiting to be read."""
        if tick <= self._last_tick:
            self._distrust()
        self._last_tick = tick
        mapped_ns = self._mapped_ns(tick, arrival_ns)
        if mapped_ns is None:
            self.counters.clock_fallbacks += 1
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
        """Return a time before which `tick` cannot have been."""
        drift = self._drift
        passed_ns = (tick - bound.tick) * self._ns_per_tick * (1.0 + drift.slope)
        return bound.sent_ns + round(passed_ns - drift.slack * abs(passed_ns) - self._ns_per_tick)

    def _fits(self, earlier: _Bound, later: _Bound) -> bool:
        """Return True if the ticks between two PINGs fit the host's clock."""
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
    """Drift of a bridge's clock: a decaying regression of its error over its time."""

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
        """Take a PING: the bridge's time at the nominal rate, and when it was sent, host ns."""
        if self._origin is None:
            self._origin = device_ns, sent_ns
        # Differences from the first PING keep the numbers small enough for their precision.
        x = device_ns - self._origin[0]
        y = (sent_ns - self._origin[1]) - x
        residual = y - self._y_mean - self.slope * (x - self._x_mean)
        limit = max(OUTLIER_SIGMAS * math.sqrt(self._noise_variance), OUTLIER_MIN_NS)
        if residual > limit or self._outliers >= OUTLIERS_MAX:
            self._restart(x, y)  # no PING arrives too early: the line was made of late ones
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
