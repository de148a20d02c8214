"""The palm stream of a Shadow hand as a driver: joints and BioTacs from one packet per millisecond.

The packets come as UDP datagrams from a relay that reads the palm's EtherCAT status memory, one
packet per datagram, from one sender at a time; silence is noticed. See `drivers.palm.stream`.
"""

from __future__ import annotations

import functools
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Final

from drivers.base import Reading
from drivers.link import LinkState
from drivers.palm.packet import CYCLE_NS, PACKET_BYTES_MAX, PalmCounters
from drivers.palm.rounds import ROUND_NS
from drivers.palm.stream import PalmStream
from drivers.udp.driver import DatagramDriver

SPARE_CYCLES: Final = 2
"""The driver asks to be woken by packets again so many cycles before a round can end."""


class PalmDriver(DatagramDriver):
    """Gives what a `PalmStream` makes of the packets that come to a UDP port.

    `source` is `udp://ADDRESS:PORT` to listen on; `only_from` is the relay's IP address, if no
    other may be heard. `fingers`, `calibration` and `heed_finger_bits`: as those of a `PalmStream`.

    The constructor raises `ValueError` for an argument out of range. `open` raises `LinkError` if
    it cannot listen, and `CalibrationError` for a calibration with mistakes. `read_ready` raises
    nothing.
    """

    name = "palm"
    bytes_max = PACKET_BYTES_MAX
    silence_ns = 10 * ROUND_NS
    period_ns: int | None = ROUND_NS

    def __init__(
        self,
        source: str,
        fingers: Sequence[str] = ("ff", "mf", "th"),
        *,
        calibration: Path | None = None,
        only_from: str | None = None,
        heed_finger_bits: bool = True,
        clock: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        super().__init__(source, only_from=only_from, clock=clock)
        self._make_stream = functools.partial(
            PalmStream, fingers, heed_finger_bits=heed_finger_bits
        )
        self._stream = self._make_stream()
        self._fingers = tuple(fingers)
        self._calibration = calibration
        self._attention_ns = 0
        self._rests = False

    @property
    def counters(self) -> PalmCounters:
        """Counters since `open`."""
        return self._stream.counters

    @property
    def serials(self) -> dict[str, str]:
        """Who sends, for each finger: no packet carries a serial number, and another sender is
        another hand."""
        return {} if self.sender is None else dict.fromkeys(self._fingers, self.sender)

    def open(self) -> None:
        """Read the calibration, then listen."""
        self.close()
        self._stream = self._make_stream(calibration=self._calibration)
        self._attention_ns = self._clock()
        self._rests = False
        self.listen(self._stream.counters)

    def fileno(self) -> int | None:
        """The socket, but None while no round can end.

        The kernel collects packets and notes their times. A loop that woke for each of them would
        wake a thousand times a second for 71 readings.
        """
        return None if self._clock() < self._attention_ns else super().fileno()

    def due_ns(self) -> int | None:
        """When a round is about to end, or silence is to be noticed."""
        due_ns = super().due_ns()
        if self.link_state is LinkState.CLOSED or self._clock() >= self._attention_ns:
            return due_ns
        return self._attention_ns if due_ns is None else min(due_ns, self._attention_ns)

    def read_ready(self) -> Sequence[Reading]:
        """Readings that are complete, from `drivers.udp.driver.DRAIN_MAX` packets at most."""
        if self._rests:
            self._rests = False
            return ()
        readings: list[Reading] = []
        for data, t_ns in self.datagrams():
            made = self._stream.receive(data, t_ns)
            if made is not None:
                self.confirm(f"palm {self._stream.palm}")
                readings.extend(made)
        if self.fell_silent():
            self._stream.interrupt()
            self._rests = bool(readings)  # what comes next may be of others: see `Driver.serials`
        self._attention_ns = self._clock() + self._nothing_for_ns()
        return readings

    def _nothing_for_ns(self) -> int:
        """How long the round at hand cannot be complete, ns, with some time to spare."""
        return max(0, self._stream.cycles_to_go - SPARE_CYCLES) * CYCLE_NS
