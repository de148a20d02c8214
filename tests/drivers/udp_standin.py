"""A stand-in for the sockets of drivers that receive datagrams."""

from __future__ import annotations

from collections.abc import Iterator

from graspd.drivers.base import LinkError
from graspd.drivers.udp import Datagram

HERE, THERE = ("127.0.0.1", 7), ("127.0.0.1", 8)


class Receiver:
    """Stand-in for `DatagramReceiver`: yields what a test puts in `waiting`, raises its errors."""

    port = 5700

    def __init__(self, dropped: int = 0) -> None:
        self.waiting: list[Datagram | LinkError] = []
        self.dropped = dropped
        self.closed = False

    def send(self, *datagrams: bytes, sender: tuple[str, int] = HERE) -> None:
        """Put in datagrams that arrive, with age 0, when they are read."""
        self.waiting += [Datagram(data, 0, sender) for data in datagrams]

    def receive(self, most: int) -> Iterator[Datagram]:
        while self.waiting and most:
            most -= 1
            datagram = self.waiting.pop(0)
            if isinstance(datagram, LinkError):
                raise datagram
            yield datagram

    def fileno(self) -> int:
        return 99

    def close(self) -> None:
        self.closed = True
