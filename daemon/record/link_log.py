"""Collect CAN frames, or bytes of a serial line, for a log beside the recording."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable
from typing import Final

from graspd.daemon.scene.drivers import CanTactile, SpiTactile, Tactile
from graspd.drivers.base import Driver

EARLY_MAX: Final = 1000
"""Most entries that are kept until the recorder starts."""

Sink = Callable[[tuple[object, ...], int], None]
"""Function that takes an entry and its monotonic time, ns."""


class Tap:
    """Pass on the traffic of a link to the recorder.

    Until `connect` it keeps the newest `EARLY_MAX` entries; older ones are dropped.
    """

    def __init__(self, ending: str, encode: Callable[..., bytes]) -> None:
        """`ending`: end of the log's file name. `encode`: returns the bytes of an entry.

        Arguments of `encode`: the entry's monotonic time, ns; what to add to get the wall clock's
        time, ns; then the parts of the entry as given to `take`.
        """
        self.ending = ending
        self.encode = encode
        self._early: deque[tuple[tuple[object, ...], int]] = deque(maxlen=EARLY_MAX)
        self._sink: Sink | None = None

    def connect(self, sink: Sink) -> None:
        """Pass the entries that were kept until now to `sink`, and later ones at once."""
        while self._early:
            sink(*self._early.popleft())
        self._sink = sink

    def take(self, *entry: object) -> None:
        """Add an `entry`: CAN frames, or an event and the bytes of a serial line."""
        at_ns = time.monotonic_ns()
        if self._sink is None:
            self._early.append((entry, at_ns))
        else:
            self._sink(entry, at_ns)


def tap_of(driver: Driver, section: Tactile) -> Tap | None:
    """Return a tap on a CAN or serial link; None for other drivers."""
    if isinstance(section, CanTactile):
        from graspd.drivers.can.driver import CanBridgeDriver
        from graspd.drivers.recordings.can_log import bus_name, encode_frames

        name = bus_name(section.channel)
        tap = Tap(".can.log", lambda _, offset_ns, frames: encode_frames(frames, offset_ns, name))
        if isinstance(driver, CanBridgeDriver):
            driver.tap(tap.take)
        return tap
    if isinstance(section, SpiTactile):
        from graspd.drivers.recordings.serial_log import encode_records
        from graspd.drivers.spi.driver import SpiBridgeDriver

        tap = Tap(".serial", lambda at_ns, _, event, data: encode_records(event, at_ns, data))
        if isinstance(driver, SpiBridgeDriver):
            driver.tap(tap.take)
        return tap
    return None
