"""Driver of the SPI bridge: a microcontroller that samples BioTac SPs and streams their words."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Sequence

from graspd.drivers.base import Fact, LinkError, Opened, Reading
from graspd.drivers.link import LinkState
from graspd.drivers.spi.conversation import NAME, NONCES, Conversation
from graspd.drivers.spi.line import LineEvent, SerialLine
from graspd.drivers.spi.messages import Stop, encode
from graspd.drivers.spi.sweeps import BridgeCounters

BAUD = 921_600
"""Bits per second: 92 kB/s, three times the longest sequence; 115200 is too slow for any."""
POLL_NS = 2_000_000
"""Time between reads of a port without a descriptor, ns."""


class SpiBridgeDriver(Opened):
    """Readings of the sensors behind one bridge; reconnects after every loss.

    `t_ns` of a reading: when the bridge finished the sweep. `seq` goes on after a loss of the link.
    Electrodes that are not sampled, and those of an absent sensor, are `MISSING`. Ports without a
    descriptor (`rfc2217://`, `loop://`) are polled. The constructor raises `ValueError` for wrong
    fingers or baud. A missing device raises nothing; `describe` reports it.
    """

    name = NAME
    exhausted = False
    live = True

    def __init__(
        self,
        port: str,
        fingers: Sequence[str],
        *,
        sensors: Sequence[str] | None = None,
        baud: int = BAUD,
        clock: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        if baud < 1:
            raise ValueError(f"baud is {baud}, must be positive")
        self._fingers, self._sensors = fingers, sensors
        self._clock = clock
        self._line = SerialLine(port, baud)
        self._idle_ns = self._poll_due_ns = 0
        self.conversation = self._begin()

    def _begin(self) -> Conversation:
        nonce = self._clock() % NONCES
        return Conversation(self._line.port, self._fingers, self._sensors, nonce=nonce)

    @property
    def counters(self) -> BridgeCounters:
        return self.conversation.counters

    @property
    def period_ns(self) -> int | None:
        return self.conversation.period_ns

    @property
    def serials(self) -> dict[str, str]:
        return self.conversation.serials

    def describe(self) -> dict[str, Fact]:
        return self.conversation.describe()

    def open(self) -> None:
        """Start afresh and try the port once. Raises `DriverError` if no try can succeed."""
        self.close()
        self.conversation = self._begin()
        self.conversation.link.start(self._clock())
        self._connect()

    def tap(self, sink: Callable[[LineEvent, bytes], None]) -> None:
        """Pass all bytes that are read or written from now on to `sink` too."""
        self._line.tap = sink

    def close(self) -> None:
        if self.conversation.link.state in (LinkState.GREETING, LinkState.UP):
            with contextlib.suppress(LinkError):  # a bridge that is unplugged needs no STOP
                self._line.write(encode(Stop()))
        self._line.close()
        self.conversation.link.close()

    def fileno(self) -> int | None:
        """Return the port's descriptor; None if it is closed or must be polled."""
        return self._line.descriptor

    def due_ns(self) -> int | None:
        """Return the time of the next try, PING, timeout or poll, ns; None while closed."""
        link = self.conversation.link
        if link.state in (LinkState.CLOSED, LinkState.WAITING):
            return link.retry_ns
        due_ns = self.conversation.due_ns
        return due_ns if self._line.descriptor is not None else min(due_ns, self._poll_due_ns)

    def read_ready(self) -> Sequence[Reading]:
        """Return the readings that have arrived, oldest first. No fault of a bridge raises."""
        link = self.conversation.link
        if link.state is LinkState.CLOSED:
            raise RuntimeError("the bridge is not open")
        began_ns = self._clock()
        if link.state is LinkState.WAITING:
            if link.is_due(began_ns):
                self._connect()
            return ()
        self._poll_due_ns = began_ns + POLL_NS
        try:
            chunk = self._line.read()
        except LinkError as error:
            self._lose(error)
            return ()
        readings = self.conversation.receive(chunk, self._clock(), self._idle_ns)
        if self._line.drained:
            self._idle_ns = began_ns
        self._send()
        return readings

    def _connect(self) -> None:
        try:
            self._line.open()
        except LinkError as error:
            self._lose(error)
            return
        self._idle_ns = self._poll_due_ns = now_ns = self._clock()
        self.conversation.opened(now_ns)
        self._send()

    def _send(self) -> None:
        """Write the frames that are due; close the port if the link is lost."""
        try:
            for frame in self.conversation.say(self._clock()):
                self.conversation.sent(frame, self._clock())
                if not self._line.write(frame):
                    self.counters.host_tx_dropped += 1
        except LinkError as error:
            self._lose(error)
        if self.conversation.link.state is LinkState.WAITING:
            self._line.close()

    def _lose(self, error: LinkError) -> None:
        self._line.close()
        self.conversation.lost(error.cause, str(error), self._clock())
