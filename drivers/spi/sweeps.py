"""Convert sweeps of a bridge to readings with the time at which they were made. No I/O.

The answer to a PING holds a tick of the bridge's clock. The tick was not before the PING was sent,
which gives a lower bound of its time; see `DeviceClock`. Arrival times of readings only limit this,
so batches of a USB adapter and stalls of the host do no harm.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from graspd.biotac import ELECTRODES
from graspd.drivers.base import ElectrodeFault, TactileReading
from graspd.drivers.biotac import E1, E24, channel_of, make_reading
from graspd.drivers.spi.messages import FrameCounters, Hello, Sweep

SEQ_HALF, SEQ_END = 1 << 31, 1 << 32
SEQ_FIRST_MAX = 1_000
"""Highest believed number of the first sweep after START.

A higher one means that the bridge was sweeping before START; then no sweep counts as missed.
"""
DRIFT_MAX = 500e-6
"""Largest drift of a bridge's clock against the host's, as a share; more is a fault.

Crystals keep 100 ppm, and the host's own clock may be adjusted by 500 ppm.
"""
DOUBT_NS = 20_000_000
"""Assumed error of a time while PINGs contradict each other, ns: 8 % of the 247 ms between two. A
computer whose time is being set may be off by that much for some seconds."""
AGE_MAX_NS = 10_000_000_000
"""Greatest age of a mapped time, ns; buffers on the way hold a few seconds at most."""
PINGS = 8
"""Number of the last PINGs that bound a time from below: those of about two seconds.

Older ones would hide the age of readings on a slow line once the rate is wrong by more than
`DRIFT_MAX`.
"""


@dataclass(slots=True)
class BridgeCounters(FrameCounters):
    """Counters of frames, sweeps and the link; they continue when the port is reopened."""

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
    """Words read from a line that no sensor drives.

    Like `parity_words` and `error_words`, it leaves out absent sensors.
    """
    absent_sensors: int = 0
    """Sensors without a serial number; each counts once in each sweep."""
    link_losses: int = 0
    link_failures: int = 0
    """Times that opening or greeting failed, or the link was lost."""
    refused_bridges: int = 0
    """Greetings of a bridge whose version, layout, sweep period or number of sensors is refused."""
    restarts: int = 0
    """Resets that the bridge reported while it was sweeping."""
    unanswered_pings: int = 0
    host_tx_dropped: int = 0
    """Frames to the bridge that were dropped because the port's buffer was full."""
    clock_faults: int = 0
    """Number of losses of the link due to the bridge's clock, and of PINGs that contradict its
    rate."""
    bridge_overruns: int = 0
    bridge_tx_dropped: int = 0
    bridge_rx_errors: int = 0
    """Damaged, overlong or unknown frames that the bridge received.

    Counters named `bridge_` are those of the last STATUS, since the bridge's reset.
    """


class SweepDecoder:
    """Decoder of sweeps into readings, from one START to the loss of the link."""

    def __init__(
        self, hello: Hello, sensors: Sequence[int], counters: BridgeCounters, clock: DeviceClock
    ) -> None:
        """`hello`: describes the sampling. `sensors`: for each row of a reading, the number of its
        sensor, from 0."""
        self.hello = hello
        self.clock = clock
        self.longest_ticks = 0
        self._shape = hello.slots, hello.sensors
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

    def reading(self, sweep: Sweep, arrival_ns: int) -> TactileReading | None:
        """Return the reading of a sweep; None if the sweep is old or does not fit the HELLO.

        Raises `ClockError`.
        """
        if sweep.words.shape != self._shape:
            self._counters.bad_frames += 1
            return None
        if not self._is_next(sweep):
            return None
        self.longest_ticks = max(self.longest_ticks, sweep.tick_end - sweep.tick_start)
        t_ns = self.clock.host_ns(sweep.tick_end, arrival_ns)
        words = sweep.words.ravel().astype(np.intp)[self._source]
        interrupted, self._interrupted = self._interrupted, False
        marks = self._marks_of(sweep)
        return make_reading(words, marks, t_ns, self._counters, interrupted=interrupted)

    def _is_next(self, sweep: Sweep) -> bool:
        """Return True if the sweep is newer than all before; count the sweeps missing before it."""
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


class ClockError(ValueError):
    """The clock of a bridge stands still, goes back or jumps."""


class _Bound(NamedTuple):
    """Bound by one PING, lower or upper, of the host time at which the clock showed `tick`."""

    tick: int
    t_ns: int


class DeviceClock:
    """Map the ticks of one bridge, from one reset to the next, to monotonic host time.

    The clock showed the tick of an answered PING not before the PING was sent, and not after its
    answer came. Both bounds advance with the ticks and widen by `DRIFT_MAX`. A reading gets the
    earliest time that the last `PINGS` allow for its tick. It may look too old, but never too new
    while the rate is right to `DRIFT_MAX` (deploy/MEASURED.md). Times never fall from one reading
    to the next, and are at most `AGE_MAX_NS` before the arrival.

    A PING that contradicts the bounds replaces them. Until a PING agrees with them, times are
    `DOUBT_NS` earlier, and the first of these may be before the last reading's.
    """

    def __init__(self, tick_hz: int, tick: int, sent_ns: int, received_ns: int) -> None:
        """`tick_hz`: nominal rate, Hz, above 0. Others: of the first PING, as in `round_trip`."""
        self.round_trip_ns = received_ns - sent_ns
        """Shortest round trip of a PING, ns."""
        self._ns_per_tick = 1e9 / tick_hz
        self._earliest, self._latest = _Bound(tick, sent_ns), _Bound(tick, received_ns)
        self._sent = deque([self._earliest], PINGS)
        self._last_tick, self._last_ns = tick, sent_ns
        self.is_doubted = False
        """True if a PING or a reading contradicted the bounds, and no PING has agreed since."""

    def round_trip(self, tick: int, sent_ns: int, received_ns: int) -> None:
        """Add an answered PING: its tick, and host times, ns, before sending it and after the
        answer."""
        self.round_trip_ns = min(self.round_trip_ns, received_ns - sent_ns)
        earliest_ns = self._earliest_ns(self._earliest, tick)
        latest_ns = self._latest_ns(tick)
        self.is_doubted = earliest_ns > received_ns or latest_ns < sent_ns
        if self.is_doubted:
            self._sent.clear()
            self._last_ns = 0  # it came from a wrong bound
        self._sent.append(_Bound(tick, sent_ns))
        self._earliest = max(self._sent, key=lambda bound: self._earliest_ns(bound, tick))
        if self.is_doubted or latest_ns - self._ns_per_tick >= received_ns:
            self._latest = _Bound(tick, received_ns)

    def host_ns(self, tick: int, arrival_ns: int) -> int:
        """Return the host time, ns, of a reading's `tick`. Raises `ClockError`."""
        if tick <= self._last_tick:
            raise ClockError("stands or falls back")
        earliest_ns = self._earliest_ns(self._earliest, tick) - DOUBT_NS * self.is_doubted
        if earliest_ns > arrival_ns:
            if earliest_ns > arrival_ns + DOUBT_NS:
                raise ClockError("jumps ahead")
            self.is_doubted = True
            self._last_ns = 0
            earliest_ns = arrival_ns - DOUBT_NS
        self._last_tick = tick
        self._last_ns = max(earliest_ns, self._last_ns, arrival_ns - AGE_MAX_NS)
        return self._last_ns

    def _earliest_ns(self, bound: _Bound, tick: int) -> int:
        passed_ns = (tick - bound.tick) * self._ns_per_tick
        slack_ns = abs(passed_ns) * DRIFT_MAX + self._ns_per_tick  # a tick is rounded
        return bound.t_ns + math.floor(passed_ns - slack_ns)

    def _latest_ns(self, tick: int) -> int:
        passed_ns = (tick - self._latest.tick) * self._ns_per_tick
        slack_ns = abs(passed_ns) * DRIFT_MAX + self._ns_per_tick
        return self._latest.t_ns + math.ceil(passed_ns + slack_ns)
