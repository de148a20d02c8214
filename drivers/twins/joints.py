"""Stands in for a sender of the joint stream: joints that swing slowly."""

from __future__ import annotations

import math
import threading
from collections.abc import Iterator, Sequence

import numpy as np

from drivers.joints.message import JointMessage
from drivers.twins.datagrams import send_paced
from drivers.twins.faults import LinkFaultInjector, LinkFaults
from drivers.udp.receiver import Endpoint

RATE_HZ = 100.0
SWING_S = 4.0
SWING_RAD = 0.2
MIDDLE_RAD = 0.4
"""Joints swing by `SWING_RAD` around here, each a little behind the one before."""


class JointTwin:
    """Sends one message per period."""

    def __init__(
        self,
        names: Sequence[str] = ("FFJ3", "MFJ3", "THJ5"),
        *,
        rate_hz: float = RATE_HZ,
        faults: LinkFaults = LinkFaults(),  # noqa: B008 (immutable)
    ) -> None:
        """Raises `ValueError` for a rate that is not positive and for a fault that it lacks."""
        if not rate_hz > 0.0:
            raise ValueError(f"rate_hz is {rate_hz}, must be positive")
        faults.refuse("the joint stream", "burst_frames", "one_byte_at_a_time")
        faults.refuse("the joint stream", "dead_electrodes", "unplugged_fingers")
        self._names = tuple(names)
        self._rate_hz = rate_hz
        self._injector = LinkFaultInjector(faults)
        self.injected = self._injector.injected

    def messages(self) -> Iterator[JointMessage]:
        """What is sent, before any fault, without end."""
        seq = 0
        while True:
            t_s = seq / self._rate_hz
            phases = 2.0 * math.pi * t_s / SWING_S - 0.1 * np.arange(len(self._names))
            yield JointMessage(seq, t_s, self._names, MIDDLE_RAD + SWING_RAD * np.sin(phases))
            seq += 1

    def cycles(self) -> Iterator[list[bytes]]:
        for message in self.messages():
            yield self._injector.spoil(message.to_bytes())

    def serve(self, target: str, stop: threading.Event) -> None:
        """Send to `udp://ADDRESS:PORT` until told to stop. Raises `ValueError` for a bad target."""
        send_paced(self.cycles(), Endpoint.parse(target), stop, round(1e9 / self._rate_hz))
