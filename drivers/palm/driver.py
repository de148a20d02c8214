"""Driver of a Shadow hand's palm: joints and BioTacs, by UDP from a relay."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Final

from graspd.drivers.base import Reading
from graspd.drivers.link import LinkState, longest_silence_ns
from graspd.drivers.palm.packet import CYCLE_NS, PACKET_BYTES_MAX
from graspd.drivers.palm.stream import ROUND_NS, PalmStream
from graspd.drivers.udp import DatagramDriver

SPARE_CYCLES: Final = 2
"""Cycles before the end of a round from which the driver waits for packets again."""


class PalmDriver(DatagramDriver[PalmStream]):
    """Driver of the readings of a `PalmStream`. `open` also raises `CalibrationError`."""

    name = "palm"
    bytes_max = PACKET_BYTES_MAX
    silence_ns = longest_silence_ns(ROUND_NS)
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
        self._fingers = tuple(fingers)
        self._heed_finger_bits = heed_finger_bits
        self._calibration: Path | None = None  # `open` reads it
        super().__init__(source, only_from=only_from, clock=clock)
        self._calibration = calibration
        self._attention_ns = 0

    def _new_stream(self) -> PalmStream:
        return PalmStream(
            self._fingers, calibration=self._calibration, heed_finger_bits=self._heed_finger_bits
        )

    @property
    def serials(self) -> dict[str, str]:
        """The sender for each finger, because packets have no serial number."""
        return {} if self.sender is None else dict.fromkeys(self._fingers, self.sender)

    def fileno(self) -> int | None:
        """Return the socket; None while no round can end, for 71 wakes a second, not 1000."""
        return None if self._clock() < self._attention_ns else super().fileno()

    def due_ns(self) -> int | None:
        due_ns = super().due_ns()
        if self.link.state is LinkState.CLOSED or self._clock() >= self._attention_ns:
            return due_ns
        return self._attention_ns if due_ns is None else min(due_ns, self._attention_ns)

    def read_ready(self) -> Sequence[Reading]:
        readings = super().read_ready()
        cycles = max(0, self.stream.cycles_to_go - SPARE_CYCLES)
        self._attention_ns = self._clock() + cycles * CYCLE_NS
        return readings
