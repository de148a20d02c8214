"""What comes over a link, on its way into a file beside the recording."""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Final

from daemon.record.files import RecordingFile
from daemon.scene.drivers import CanTactile, SpiTactile, Tactile
from drivers.base import Driver
from drivers.can.frames import LOST

if TYPE_CHECKING:
    from drivers.can.frames import CanFrame, Stamped
    from drivers.spi.line import LineEvent

EARLY_MAX: Final = 1000
"""Entries held while the recorder is not there yet: those of the link's opening."""

Taker = Callable[[object, int], None]
"""Takes an entry and its monotonic time, ns."""


class LinkLogFile(RecordingFile, ABC):
    """Keeps what comes over a link."""

    @abstractmethod
    def write(self, entry: object, at_ns: int, offset_ns: int) -> None:
        """Write what came over at monotonic `at_ns`; wall time is that plus `offset_ns`."""


class Tap:
    """Passes on what comes over a link; holds it until somebody takes it."""

    def __init__(
        self, make_file: Callable[[Path], LinkLogFile], clock: Callable[[], int] = time.monotonic_ns
    ) -> None:
        self.make_file = make_file
        """Makes the file of these entries by its name without ending."""
        self._clock = clock
        self._early: deque[tuple[object, int]] = deque(maxlen=EARLY_MAX)
        self._taker: Taker | None = None

    def pass_on(self, taker: Taker) -> None:
        """Hand over what is held, and from now on everything at once."""
        while self._early:
            taker(*self._early.popleft())
        self._taker = taker

    def frames(self, stamped: list[Stamped]) -> None:
        """CAN frames have come."""
        self._take(stamped)

    def bytes(self, event: LineEvent, data: bytes) -> None:
        """Bytes went over a serial line."""
        self._take((event, data))

    def _take(self, entry: object) -> None:
        if self._taker is None:
            self._early.append((entry, self._clock()))
        else:
            self._taker(entry, self._clock())


def tap_of(driver: Driver, section: Tactile) -> Tap | None:
    """A tap on the link of a driver; None for one that has no link of these kinds."""
    if isinstance(section, CanTactile):
        from drivers.can.driver import CanBridgeDriver
        from drivers.recordings.can_log import line_of

        channel = section.channel
        tap = Tap(lambda name: CandumpFile(name, channel, line_of))
        if isinstance(driver, CanBridgeDriver):
            driver.tap(tap.frames)
        return tap
    if isinstance(section, SpiTactile):
        from drivers.recordings.serial_log import encode_records
        from drivers.spi.driver import SpiBridgeDriver

        tap = Tap(lambda name: SerialFile(name, encode_records))
        if isinstance(driver, SpiBridgeDriver):
            driver.tap(tap.bytes)
        return tap
    return None


class CandumpFile(LinkLogFile):
    """CAN frames as `candump -L` writes them. What the kernel lost has no line."""

    def __init__(
        self, name: Path, channel: str, line_of: Callable[[CanFrame, int, str], str]
    ) -> None:
        super().__init__(name.with_name(f"{name.name}.can.log"))
        self._line_of = line_of
        self._channel = channel.replace(" ", "_")

    def write(self, entry: object, at_ns: int, offset_ns: int) -> None:
        """Take the frames of one drain: each has its own time."""
        if not isinstance(entry, list):
            return
        lines = [
            self._line_of(frame, max(until_ns + offset_ns, 0), self._channel)
            for frame, _, until_ns in entry
            if not frame.flags & LOST
        ]
        self._stream.write("".join(lines).encode())


class SerialFile(LinkLogFile):
    """Serial bytes in the frames of `drivers.recordings.serial_log`, with monotonic times."""

    def __init__(self, name: Path, encode: Callable[[LineEvent, int, bytes], bytes]) -> None:
        super().__init__(name.with_name(f"{name.name}.serial"))
        self._encode = encode

    def write(self, entry: object, at_ns: int, offset_ns: int) -> None:
        """Take bytes that came or went at once."""
        if isinstance(entry, tuple):
            event, data = entry
            self._stream.write(self._encode(event, at_ns, data))
