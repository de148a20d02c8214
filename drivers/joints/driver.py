"""Joint angles of a hand from any source that can send JSON: see deploy/wire/JOINTS.md."""

from __future__ import annotations

import ipaddress
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from drivers.base import JointReading, Opened, Reading
from drivers.joints.message import DATAGRAM_BYTES_MAX, JointCounters, JointParser, MessageOrder
from drivers.link import LinkState
from drivers.udp.link import DatagramLink
from drivers.udp.receiver import Endpoint

SILENCE_S = 0.5
"""Without a message for so long the link is lost: 50 at 100 Hz, and a sender of 10 Hz passes."""
SILENCE_MIN_S, SILENCE_MAX_S = 0.01, 60.0


@dataclass(slots=True)
class JointStreamCounters(JointCounters):
    """What the joint stream counts. `missed_readings` needs a sender that counts."""

    foreign_datagrams: int = 0
    """Datagrams from another sender than the one that is listened to; dropped."""
    kernel_drops: int = 0
    """Datagrams that the kernel dropped because nobody took them in time."""
    link_losses: int = 0
    """Times that messages came and then none for `silence_s`."""


class JointStreamDriver(Opened):
    """Gives a `JointReading` per message.

    `source` is `udp://ADDRESS:PORT` to listen on; `only_from` the sender's IP address, if no other
    may be heard. The constructor raises `ValueError` for an argument out of range, `open` raises
    `LinkError` if it cannot listen. `read_ready` raises nothing.
    """

    name = "joints"
    period_ns: int | None = None
    exhausted = False
    live = True

    def __init__(
        self,
        source: str,
        *,
        silence_s: float = SILENCE_S,
        only_from: str | None = None,
        clock: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        if not SILENCE_MIN_S <= silence_s <= SILENCE_MAX_S:
            raise ValueError(f"silence_s is {silence_s}, must be {SILENCE_MIN_S}..{SILENCE_MAX_S}")
        self._endpoint = Endpoint.parse(source)
        self._silence_ns = round(silence_s * 1e9)
        self._only_from = None if only_from is None else str(ipaddress.ip_address(only_from))
        self._clock = clock
        self._link: DatagramLink | None = None
        self._described = {"source": str(self._endpoint)}
        self._reset()

    def _reset(self) -> None:
        self.counters = JointStreamCounters()
        self._parser = JointParser(self.counters)
        self._order = MessageOrder(self.counters)

    @property
    def link_state(self) -> LinkState:
        """What the link is doing."""
        return LinkState.CLOSED if self._link is None else self._link.state

    @property
    def port(self) -> int | None:
        """The port that is listened on, or None."""
        return None if self._link is None else self._link.port

    @property
    def serials(self) -> dict[str, str]:
        """There are no tactile sensors."""
        return {}

    def describe(self) -> dict[str, str]:
        """Source, link, who is heard; after `close` as it was then."""
        return self._described if self._link is None else self._link.describe()

    def open(self) -> None:
        """Listen."""
        self.close()
        self._reset()
        link = DatagramLink(
            self.name,
            self._endpoint,
            self.counters,
            self._clock,
            bytes_max=DATAGRAM_BYTES_MAX,
            silence_ns=self._silence_ns,
            only_from=self._only_from,
        )
        link.open()
        self._link = link

    def close(self) -> None:
        """Release the socket."""
        if self._link is not None:
            self._described = self._link.describe()
            self._link.close()
            self._link = None

    def fileno(self) -> int | None:
        """The socket."""
        return None if self._link is None else self._link.fileno()

    def due_ns(self) -> int | None:
        """When silence is to be noticed."""
        return None if self._link is None else self._link.due_ns()

    def read_ready(self) -> Sequence[Reading]:
        """One reading per message that has arrived, oldest first."""
        if self._link is None:
            raise RuntimeError("the joint stream is not open")
        readings: list[Reading] = []
        for data, t_ns in self._link.receive():
            message = self._parser.parse(data)
            if message is None or not self._order.admits(message):
                continue
            self._link.confirm("joint stream")
            if message.names:
                seq = self.counters.readings + self.counters.missed_readings
                readings.append(JointReading(t_ns, seq, message.names, message.position_rad))
                self.counters.readings += 1
        if self._link.fell_silent():
            self._order.forget()
        return readings
