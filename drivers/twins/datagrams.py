"""Send datagrams at a steady pace, for the twins of datagram senders."""

from __future__ import annotations

import socket
import threading
import time
from collections.abc import Iterable

from graspd.drivers.udp.receiver import Endpoint

BEHIND_MAX_NS = 100_000_000
"""Longest delay, ns, that a sender catches up with; after more, its schedule starts again."""


def send_paced(
    cycles: Iterable[list[bytes]], target: Endpoint, stop: threading.Event, period_ns: int | None
) -> None:
    """Send the datagrams of each cycle until `stop` is set; `period_ns` None: without a pause."""
    with socket.socket(target.family, socket.SOCK_DGRAM) as sender:
        due_ns = time.monotonic_ns()
        for datagrams in cycles:
            if period_ns is not None:
                now_ns = time.monotonic_ns()
                if now_ns - due_ns > BEHIND_MAX_NS:
                    due_ns = now_ns
                if due_ns > now_ns:
                    time.sleep((due_ns - now_ns) / 1e9)
                due_ns += period_ns
            if stop.is_set():
                return
            for datagram in datagrams:
                sender.sendto(datagram, (target.address, target.port))
