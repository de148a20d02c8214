"""Ports and multicast groups for one test alone: others may run beside it."""

from __future__ import annotations

import contextlib
import itertools
import os
import socket

import pytest

from graspd.biotac import FINGERS

PORTS = (10_000 + (211 * os.getpid() + number) % 20_000 for number in itertools.count())
"""Ports to try: below those that the system chooses, and others than processes beside it try."""


def free_port(kind: socket.SocketKind = socket.SOCK_STREAM) -> int:
    """Return a free port of the loopback, of TCP, or of UDP with `SOCK_DGRAM`."""
    while True:
        port = next(PORTS)
        with socket.socket(socket.AF_INET, kind) as probe, contextlib.suppress(OSError):
            probe.bind(("127.0.0.1", port))
            return port


def free_ipv6_endpoint() -> str:
    """Return a TCP endpoint on IPv6's loopback; skip the test where there is none."""
    with socket.socket(socket.AF_INET6) as probe:
        try:
            probe.bind(("::1", 0))
        except OSError:
            pytest.skip("this computer has no IPv6")
    return f"tcp://[::1]:{free_port()}"


def multicast_group() -> str:
    """Return the address of a group of python-can's `udp_multicast` for this process."""
    return f"239.74.{os.getpid() % 250}.{2 + os.getpid() // 250 % 250}"


def can_id(group: str) -> int:
    """Return the arbitration id of finger `ff` in a group: other groups' frames have other ids.

    A socket of python-can hears all groups that any process of this computer has joined.
    """
    _, _, third, fourth = map(int, group.split("."))
    return 0x10000 + (third << 8 | fourth) * len(FINGERS)
