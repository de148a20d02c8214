"""A device whose clock is known exactly: what `graspd.drivers.spi.sweeps` makes of it."""

from __future__ import annotations

import math
import random
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from graspd.drivers.spi.sweeps import DeviceClock

MS = 1_000_000
S = 1_000_000_000
TICK_HZ = 1_000_000
START_NS = 5_000 * S
"""Host time when the device was reset: any large number."""


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
