"""A CAN twin: simulated sensors on any bus of python-can, with faults on request."""

from __future__ import annotations

import contextlib
import logging
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from typing import Final

import can

from graspd.drivers.base import Opened
from graspd.drivers.biotac import E1, PAC, PDC, SEQUENCES, TAC, TDC, encode_word
from graspd.drivers.can.frames import STANDARD_ID_MAX, encode_sample
from graspd.drivers.can.interfaces import open_bus, refuse_unusable
from graspd.drivers.twins import NAP_MAX_NS
from graspd.drivers.twins.faults import LinkFaultInjector, LinkFaults
from graspd.drivers.twins.grasps.grasps import Counts

SAMPLE_ID: Final = 0x100
"""Default arbitration id of samples; the real board's id is not public."""
OTHER_COUNTS: Final = {PAC: 2050, PDC: 2800, TAC: 2010, TDC: 2260}
"""Counts of the channels that are not electrodes, as on an untouched hand."""
SEND_TIMEOUT_S: Final = 0.1
"""Longest wait for room in the transmit queue, s."""
DOWN_S: Final = 0.2
"""Time that a broken link stays down, s."""
ID_BYTES: Final = 4
"""Bytes of the arbitration id in front of the data; bit flips spare them."""
_UNDRIVEN: Final = b"\xff\xff"
_WORDS: Final = [encode_word(count).to_bytes(2, "big") for count in range(4096)]

Outgoing = tuple[int, bytes]

_log = logging.getLogger(__name__)


class CanTwin(Opened):
    """Send the sweeps of `counts`, sample by sample. The constructor raises `ValueError`."""

    def __init__(
        self,
        interface: str,
        channel: str,
        counts: Iterator[Counts],
        fingers: Sequence[str] = ("ff", "mf", "th"),
        *,
        arbitration_id: int = SAMPLE_ID,
        sequence: str = "interleaved",
        rate_hz: float = 100.0,
        faults: LinkFaults = LinkFaults(),  # noqa: B008 (immutable)
        clock: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        """`counts`: of each sweep, shape (fingers, 24). `fingers`: finger of each of these rows.
        `sequence`: a key of `SEQUENCES`. `rate_hz`: sweeps per second of `serve`. Raises
        `ValueError` for a fault that CAN cannot have, or an interface that cannot be used here."""
        refuse_unusable(interface, channel, None, {})
        faults.refuse("CAN", "one_byte_at_a_time", "wrong_version", "stuck_clock")
        self._fingers = len(fingers)
        self._channels = SEQUENCES[sequence]
        self._id = arbitration_id
        self._counts = counts
        self._period_ns = round(1e9 / rate_hz)
        self._faults = faults
        self._injector = LinkFaultInjector(faults, spared_bytes=ID_BYTES)
        self.injected = self._injector.injected
        self._clock = clock
        self._interface, self._channel = interface, channel
        self._send_timeout_s = 0.0 if interface == "virtual" else SEND_TIMEOUT_S
        self._bus: can.BusABC | None = None
        self._has_refused = False

    def open(self) -> None:
        """Open the bus. Raises `DriverError`, also if a package is missing."""
        self.close()
        self._bus = open_bus(self._interface, self._channel)

    def close(self) -> None:
        bus, self._bus = self._bus, None
        if bus is not None:
            bus.shutdown()

    def send_sweep(self) -> bool:
        """Send the frames of the next sweep at once; return False if there is none."""
        frames = self.next_frames()
        for frame in frames:
            self._send(frame)
        self._discard_received()
        return bool(frames)

    def flush(self) -> None:
        self._put_all(self._injector.flush())

    def serve(self, stop: threading.Event) -> None:
        """Send sweeps at `rate_hz` until `stop` is set or the counts end."""
        due_ns = self._clock()
        while not stop.is_set():
            frames = self.next_frames()
            if not frames:
                return
            for at, frame in enumerate(frames):
                frame_ns = due_ns + self._period_ns * at // len(frames)
                while (wait_ns := frame_ns - self._clock()) > 0 and not stop.is_set():
                    time.sleep(min(wait_ns, NAP_MAX_NS) / 1e9)
                if stop.is_set():
                    return
                if not self._send(frame):
                    time.sleep(DOWN_S)
            self._discard_received()
            due_ns = max(due_ns + self._period_ns, self._clock() - self._period_ns)

    def next_frames(self) -> list[Outgoing]:
        """Return (id, data) of the frames of the next sweep, without link faults; [] after the
        last."""
        counts = next(self._counts, None)
        if counts is None:
            return []
        frames = []
        for channel in self._channels:
            words = [self._word(row, channel, counts) for row in range(self._fingers)]
            frames.append((self._id, encode_sample(channel, b"".join(words))))
        return frames

    def _word(self, row: int, channel: int, counts: Counts) -> bytes:
        """Return the response word for `channel`, two bytes, of the sensor in `row` of `counts`,
        with its faults."""
        if row in self._faults.unplugged_fingers:
            return _UNDRIVEN
        if channel in OTHER_COUNTS:
            return _WORDS[OTHER_COUNTS[channel]]
        is_dead = (row, channel - E1) in self._faults.dead_electrodes
        return _WORDS[0 if is_dead else counts[row, channel - E1]]

    def _send(self, frame: Outgoing) -> bool:
        if self._injector.breaks_here():
            self.open()
            return False
        identifier, data = frame
        self._put_all(self._injector.spoil(identifier.to_bytes(ID_BYTES) + data))
        return True

    def _put_all(self, frames: Sequence[bytes]) -> None:
        """Put frames, `ID_BYTES` of id and then data, on the bus; log the first that it refuses."""
        if self._bus is None:
            raise RuntimeError("the twin is not open")
        for frame in frames:
            identifier = int.from_bytes(frame[:ID_BYTES])
            message = can.Message(
                timestamp=self._clock() / 1e9,  # only a bus with preserve_timestamps keeps it
                arbitration_id=identifier,
                is_extended_id=identifier > STANDARD_ID_MAX,
                data=frame[ID_BYTES:],
            )
            try:
                self._bus.send(message, timeout=self._send_timeout_s)
            except can.CanError as error:
                if not self._has_refused:
                    _log.warning("%s refuses frames: %s", self._channel, error)
                self._has_refused = True

    def _discard_received(self) -> None:
        if self._interface == "virtual" and self._bus is not None:
            with contextlib.suppress(can.CanError):
                while self._bus.recv(timeout=0) is not None:
                    pass
