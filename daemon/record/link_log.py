"""Bytes and frames of a link, on their way into a file."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable
from typing import Final

from graspd.daemon.scene.drivers import CanTactile, SpiTactile, Tactile
from graspd.drivers.base import Driver

EARLY_MAX: Final = 1000
"""Entries held until the recorder starts."""

Sink = Callable[[tuple[object, ...], int], None]
"""Takes an entry and its monotonic time, ns."""


class Tap:
    """Passes on the traffic of a link; holds it until it is connected."""

    def __init__(
        self,
        ending: str,
        encode: Callable[..., bytes],
        clock: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        """`encode` takes an entry's monotonic time and the wall clock's offset, ns; its parts."""
        self.ending = ending
        self.encode = encode
        self._clock = clock
        self._early: deque[tuple[tuple[object, ...], int]] = deque(maxlen=EARLY_MAX)
        self._sink: Sink | None = None

    def connect(self, sink: Sink) -> None:
        """Hand over what is held, and everything later at once."""
        while self._early:
            sink(*self._early.popleft())
        self._sink = sink

    def take(self, *entry: object) -> None:
        """Take CAN frames, or bytes of a serial line."""
        if self._sink is None:
            self._early.append((entry, self._clock()))
        else:
            self._sink(entry, self._clock())


def tap_of(driver: Driver, section: Tactile) -> Tap | None:
    """Return a tap on a CAN or serial link; None for others."""
    if isinstance(section, CanTactile):
        from graspd.drivers.can.driver import CanBridgeDriver
        from graspd.drivers.recordings.can_log import encode_frames

        name = section.channel.replace(" ", "_")
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
