"""A twin of the joint stream: joints that swing slowly."""

from __future__ import annotations

import math
import threading
from collections.abc import Iterator

import numpy as np

from graspd.drivers.joints.message import JointMessage
from graspd.drivers.twins.datagrams import send_paced
from graspd.drivers.twins.faults import LinkFaultInjector, LinkFaults
from graspd.drivers.udp.receiver import Endpoint

NAMES = ("FFJ3", "MFJ3", "THJ5")
RATE_HZ = 100.0
SWING_S = 4.0
SWING_RAD = 0.2
MIDDLE_RAD = 0.4
"""Middle of the swing, rad; each joint is a little behind the one before."""


class JointTwin:
    """Send one joint message per period."""

    def __init__(self, faults: LinkFaults = LinkFaults()) -> None:  # noqa: B008 (immutable)
        """Raises `ValueError` for a fault that datagrams cannot have."""
        faults.refuse("the joint stream", "burst_frames", "one_byte_at_a_time")
        faults.refuse("the joint stream", "dead_electrodes", "unplugged_fingers")
        self._injector = LinkFaultInjector(faults)
        self.injected = self._injector.injected

    def messages(self) -> Iterator[JointMessage]:
        seq = 0
        while True:
            t_s = seq / RATE_HZ
            phases = 2.0 * math.pi * t_s / SWING_S - 0.1 * np.arange(len(NAMES))
            yield JointMessage(seq, t_s, NAMES, MIDDLE_RAD + SWING_RAD * np.sin(phases))
            seq += 1

    def cycles(self) -> Iterator[list[bytes]]:
        for message in self.messages():
            yield self._injector.spoil(message.to_bytes())

    def serve(self, target: str, stop: threading.Event) -> None:
        """Send to `udp://ADDRESS:PORT` until `stop` is set. Raises `ValueError`."""
        send_paced(self.cycles(), Endpoint.parse(target), stop, round(1e9 / RATE_HZ))
