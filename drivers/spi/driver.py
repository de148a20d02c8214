"""BioTac SPs behind a microcontroller that samples them over SPI and streams over a serial port."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Sequence

from drivers.base import Fact, LinkError, Opened, Reading
from drivers.link import CLOSED, GREETING, UP, WAITING, LinkState
from drivers.spi.conversation import NAME, NONCES, Conversation
from drivers.spi.line import LineEvent, SerialLine
from drivers.spi.messages import Stop, encode
from drivers.spi.sweeps import BridgeCounters

BAUD = 921_600
"""Carries 92 kB/s, three times the longest sequence; 115200 is too slow for any."""
POLL_NS = 2_000_000
"""How often a port without a descriptor is read."""


class SpiBridgeDriver(Opened):
    """Readings of the sensors behind one bridge; finds the bridge again whenever it was lost.

    `fingers` are the rows of a reading. `sensors` are the fingers in the order of the chip selects,
    the same unless given; a board may have more sensors than fingers are wanted. `t_ns` of a
    reading is when the bridge finished the sweep, by `drivers.spi.clock`; `seq` goes on across
    losses of the link. An electrode that the bridge's sequence leaves out, and every one of an
    absent sensor, is `MISSING`.

    `baud` means nothing to a USB device. Ports without a descriptor (`rfc2217://`, `loop://`) are
    polled. The constructor raises `ValueError`. `open` raises `DriverError` for a port name that
    can never work; a device that is not there, now or later, raises nothing: `describe` says so.
    """

    name = NAME
    exhausted = False
    """False: a link may always come back."""
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
        """What is said with the bridge since `open`, and how its link stands."""

    def _begin(self) -> Conversation:
        nonce = self._clock() % NONCES
        return Conversation(self._line.port, self._fingers, self._sensors, nonce=nonce)

    @property
    def link_state(self) -> LinkState:
        """What the link is doing; readings come while it is `UP`."""
        return self.conversation.link.state

    @property
    def counters(self) -> BridgeCounters:
        """Counters since `open`."""
        return self.conversation.counters

    @property
    def period_ns(self) -> int | None:
        """Nominal time between sweeps by the last HELLO, ns; None before the first."""
        return self.conversation.period_ns

    @property
    def serials(self) -> dict[str, str]:
        """By finger, from the last HELLO; without the sensors that did not answer."""
        return self.conversation.serials

    def describe(self) -> dict[str, Fact]:
        """Port, link, and what the bridge last said of itself."""
        return self.conversation.describe()

    def open(self) -> None:
        """Forget all and try the port at once. Raises `DriverError` if no try can ever succeed."""
        self.close()
        self.conversation = self._begin()
        self.conversation.link.start(self._clock())
        self._connect()

    def tap(self, taker: Callable[[LineEvent, bytes], None]) -> None:
        """Hand all bytes that come and go from now on to `taker` too."""
        self._line.tap = taker

    def close(self) -> None:
        """Stop the bridge and give the port back."""
        if self.link_state in (GREETING, UP):
            with contextlib.suppress(LinkError):  # one that is gone has stopped in its own way
                self._line.write(encode(Stop()))
        self._line.close()
        self.conversation.link.close()

    def fileno(self) -> int | None:
        """Descriptor of the port, or None: no port, or one that must be polled."""
        return self._line.descriptor

    def due_ns(self) -> int | None:
        """When the next try, PING or deadline is due, or None while closed."""
        link = self.conversation.link
        if link.state in (CLOSED, WAITING):
            return link.retry_ns
        due_ns = self.conversation.due_ns
        return due_ns if self._line.descriptor is not None else min(due_ns, self._poll_due_ns)

    def read_ready(self) -> Sequence[Reading]:
        """Readings of the sweeps that have arrived. Never raises for anything a bridge does."""
        link = self.conversation.link
        if link.state is CLOSED:
            raise RuntimeError("the bridge is not open")
        began_ns = self._clock()
        if link.state is WAITING:
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
        self._say()
        return readings

    def _connect(self) -> None:
        try:
            self._line.open()
        except LinkError as error:
            self._lose(error)
            return
        self._idle_ns = self._poll_due_ns = now_ns = self._clock()
        self.conversation.opened(now_ns)
        self._say()

    def _say(self) -> None:
        """Write what is due to be said; give the port back if the link is lost."""
        try:
            for frame in self.conversation.say(self._clock()):
                self.conversation.sent(frame, self._clock())
                if not self._line.write(frame):
                    self.conversation.not_sent()
        except LinkError as error:
            self._lose(error)
        if self.conversation.link.state is WAITING:
            self._line.close()

    def _lose(self, error: LinkError) -> None:
        self._line.close()
        self.conversation.lost(error.cause, str(error), self._clock())
