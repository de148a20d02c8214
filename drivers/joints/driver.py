"""Joint angles of a hand from any source that can send JSON: see deploy/wire/JOINTS.md."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence

from drivers.base import JointReading, Reading
from drivers.joints.message import DATAGRAM_BYTES_MAX, JointCounters, JointParser, MessageOrder
from drivers.udp.driver import DatagramDriver


class JointStreamDriver(DatagramDriver):
    """Gives a `JointReading` per message.

    `source` is `udp://ADDRESS:PORT` to listen on; `only_from` the sender's IP address, if no other
    may be heard. The constructor raises `ValueError` for an argument out of range, `open` raises
    `LinkError` if it cannot listen. `read_ready` raises nothing.
    """

    name = "joints"
    bytes_max = DATAGRAM_BYTES_MAX
    silence_ns = 500_000_000
    """50 messages at 100 Hz; a sender of 10 Hz passes."""
    period_ns: int | None = None

    def __init__(
        self,
        source: str,
        *,
        only_from: str | None = None,
        clock: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        super().__init__(source, only_from=only_from, clock=clock)
        self._reset()

    def _reset(self) -> None:
        self.counters = JointCounters()
        self._parser = JointParser(self.counters)
        self._order = MessageOrder(self.counters)

    def open(self) -> None:
        """Listen."""
        self.close()
        self._reset()
        self.listen(self.counters)

    def read_ready(self) -> Sequence[Reading]:
        """One reading per message that has arrived, oldest first."""
        readings: list[Reading] = []
        for data, t_ns in self.datagrams():
            message = self._parser.parse(data)
            if message is None or not self._order.admits(message):
                continue
            self.confirm("joint stream")
            if message.names:
                seq = self.counters.readings + self.counters.missed_readings
                readings.append(JointReading(t_ns, seq, message.names, message.position_rad))
                self.counters.readings += 1
        if self.fell_silent():
            self._order.forget()
        return readings
