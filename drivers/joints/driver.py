"""Joint angles of a hand from any source that can send JSON: see deploy/wire/JOINTS.md."""

from __future__ import annotations

from graspd.drivers.joints.message import DATAGRAM_BYTES_MAX, JointStream
from graspd.drivers.udp.driver import DatagramDriver


class JointStreamDriver(DatagramDriver[JointStream]):
    """Driver of the joint stream: one `JointReading` per message."""

    name = "joints"
    bytes_max = DATAGRAM_BYTES_MAX
    silence_ns = 500_000_000
    """Timeout, ns: 50 messages at 100 Hz. A sender of 10 Hz passes."""
    period_ns: int | None = None

    def _new_stream(self) -> JointStream:
        return JointStream()
