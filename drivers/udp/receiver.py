"""Receive UDP datagrams without blocking, with their age and the kernel's count of drops."""

from __future__ import annotations

import ipaddress
import socket
import time
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final, NamedTuple

from graspd.drivers.base import LinkError
from graspd.drivers.kernel_stamps import ANCILLARY_BYTES, SO_RXQ_OVFL, SO_TIMESTAMPNS, read_stamps

SCHEME = "udp://"
RECEIVE_BUFFER_BYTES: Final = 128 * 1024
"""Receive buffer asked of the kernel, bytes; doubled by it, it holds 0.2 s of palm packets.

Packets that wait longer are too old to judge, and a full buffer drops the newest.
"""

Sender = tuple[str, int]
"""Numeric address and port of a sender."""


@dataclass(frozen=True, slots=True)
class Endpoint:
    """Address and port to listen on."""

    address: str
    """Numeric address; `0.0.0.0` or `::` is all interfaces, so any computer may send."""
    port: int
    """Port; 0 lets the kernel choose one, for tests."""

    @classmethod
    def parse(cls, source: str) -> Endpoint:
        """Return the endpoint in `udp://ADDRESS:PORT`. Raises `ValueError`."""
        host, separator, port = source.removeprefix(SCHEME).rpartition(":")
        is_number = port.isascii() and port.isdigit() and int(port) < 1 << 16
        if not source.startswith(SCHEME) or not separator or not is_number:
            raise ValueError(f"{source!r} is not like udp://127.0.0.1:5700")
        try:
            address = ipaddress.ip_address(host.removeprefix("[").removesuffix("]"))
        except ValueError:
            raise ValueError(f"{source!r}: {host!r} is not an IP address") from None
        return cls(str(address), int(port))

    def __str__(self) -> str:
        host = f"[{self.address}]" if ":" in self.address else self.address
        return f"{SCHEME}{host}:{self.port}"

    @property
    def family(self) -> socket.AddressFamily:
        return socket.AF_INET6 if ":" in self.address else socket.AF_INET


class Datagram(NamedTuple):
    """One datagram."""

    data: bytes
    """Content; one byte longer than the receiver's limit if the datagram was too long."""
    age_ns: int
    """Time since the kernel received it, ns, 0 or more; wrong if the wall clock just stepped."""
    sender: Sender


class DatagramReceiver:
    """A bound socket. The constructor raises `LinkError` if it cannot be bound."""

    def __init__(self, endpoint: Endpoint, bytes_max: int) -> None:
        """`bytes_max`: longest valid datagram, bytes."""
        self._bytes_max = bytes_max
        self.dropped = 0
        """Datagrams that the kernel dropped because they were not read in time."""
        self._socket = socket.socket(endpoint.family, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC)
        try:
            self._socket.setblocking(False)
            self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, RECEIVE_BUFFER_BYTES)
            self._socket.setsockopt(socket.SOL_SOCKET, SO_TIMESTAMPNS, True)
            self._socket.setsockopt(socket.SOL_SOCKET, SO_RXQ_OVFL, True)
            self._socket.bind((endpoint.address, endpoint.port))
        except OSError as error:
            self._socket.close()
            text = f"cannot listen on {endpoint}: {error.strerror}"
            raise LinkError.from_errno(error, text, str(endpoint)) from error

    @property
    def port(self) -> int:
        port: int = self._socket.getsockname()[1]
        return port

    def fileno(self) -> int:
        return self._socket.fileno()

    def close(self) -> None:
        self._socket.close()

    def receive(self, most: int) -> Iterator[Datagram]:
        """Yield up to `most` datagrams, oldest first. Raises `LinkError`."""
        for _ in range(most):
            try:
                data, ancillary, _, sender = self._socket.recvmsg(
                    self._bytes_max + 1, ANCILLARY_BYTES
                )
            except BlockingIOError:
                return
            except InterruptedError:
                continue
            except OSError as error:
                text = f"cannot receive: {error.strerror}"
                raise LinkError.from_errno(error, text) from error
            wall_ns, drops = read_stamps(ancillary)
            age_ns = 0 if wall_ns is None else max(0, time.time_ns() - wall_ns)
            self.dropped = self.dropped if drops is None else drops
            yield Datagram(data, age_ns, sender[:2])
