"""Drivers of UDP datagrams: a socket that never blocks, and the link to one sender."""

from __future__ import annotations

import ipaddress
import socket
import time
from abc import abstractmethod
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Final, Generic, NamedTuple, Protocol, TypeVar

from graspd.drivers.base import DriverCounters, Fact, LinkCause, LinkError, Opened, Reading
from graspd.drivers.kernel_stamps import ANCILLARY_BYTES, SO_RXQ_OVFL, SO_TIMESTAMPNS, read_stamps
from graspd.drivers.link import Link, LinkState

SCHEME = "udp://"
RECEIVE_BUFFER_BYTES: Final = 128 * 1024
"""Receive buffer requested of the kernel, bytes. The kernel doubles it: 0.2 s of palm packets.
Packets that wait longer are too old to judge, and a full buffer drops the newest."""
DRAIN_MAX = 256
"""Most datagrams of one call, so that a flood does not keep the loop from its other work."""
STEP_NS: Final = 5_000_000
"""Smallest change of wall clock against monotonic clock, ns, that is a step, not a slew."""
Sender = tuple[str, int]
"""Numeric address and port of a sender."""


@dataclass(frozen=True, slots=True)
class Endpoint:
    """Address and port to listen on."""

    address: str
    """Numeric address; with `0.0.0.0` or `::`, all interfaces, any computer may send."""
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


def plain(address: str) -> str:
    """Return an address as senders are compared: IPv4 if mapped into IPv6, without scope."""
    parsed = ipaddress.ip_address(address.partition("%")[0])
    mapped = parsed.ipv4_mapped if isinstance(parsed, ipaddress.IPv6Address) else None
    return str(mapped or parsed)


class Datagram(NamedTuple):
    """A datagram that was received."""

    data: bytes
    """Content; one byte longer than the receiver's limit if the datagram was too long."""
    age_ns: int
    """Time since the kernel received it, ns, 0 or more; its upper bound if the wall clock stepped
    meanwhile."""
    sender: Sender


class DatagramReceiver:
    """A bound socket. The constructor raises `LinkError` if it cannot be bound."""

    def __init__(self, endpoint: Endpoint, bytes_max: int) -> None:
        """`bytes_max`: longest valid datagram, bytes."""
        self._bytes_max = bytes_max
        self.dropped = 0
        """Datagrams that the kernel dropped because they were not read in time."""
        self._empty_ns = time.monotonic_ns()
        self._ahead_ns = self._empty_ns - time.time_ns()
        try:
            self._socket = _bound(endpoint)
        except OSError as error:
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
        now_ns = time.monotonic_ns()
        ahead_ns = now_ns - time.time_ns()
        has_stepped = abs(ahead_ns - self._ahead_ns) > STEP_NS
        for _ in range(most):
            try:
                data, ancillary, _, sender = self._socket.recvmsg(
                    self._bytes_max + 1, ANCILLARY_BYTES
                )
            except BlockingIOError:
                self._empty_ns, self._ahead_ns = now_ns, ahead_ns
                return
            except InterruptedError:
                continue
            except OSError as error:
                text = f"cannot receive: {error.strerror}"
                raise LinkError.from_errno(error, text) from error
            wall_ns, drops = read_stamps(ancillary)
            age_ns = 0 if wall_ns is None else max(0, time.time_ns() - wall_ns)
            if has_stepped:
                age_ns = now_ns - self._empty_ns
            self.dropped = self.dropped if drops is None else drops
            address = plain(sender[0]) if ":" in sender[0] else sender[0]
            yield Datagram(data, age_ns, (address, sender[1]))


def _bound(endpoint: Endpoint) -> socket.socket:
    """Return a socket that listens on `endpoint` and never blocks. Raises `OSError`."""
    made = socket.socket(endpoint.family, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC)
    try:
        made.setblocking(False)
        made.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, RECEIVE_BUFFER_BYTES)
        made.setsockopt(socket.SOL_SOCKET, SO_TIMESTAMPNS, True)
        made.setsockopt(socket.SOL_SOCKET, SO_RXQ_OVFL, True)
        made.bind((endpoint.address, endpoint.port))
    except OSError:
        made.close()
        raise
    return made


@dataclass(slots=True)
class DatagramCounters(DriverCounters):
    """Counters of the link; a driver's own counters contain them."""

    foreign_datagrams: int = 0
    """Datagrams from another sender than the current or allowed one; dropped."""
    kernel_drops: int = 0
    """Datagrams that the kernel dropped because they were not read in time."""
    link_losses: int = 0
    """Times that the link fell silent or broke after it had been up."""


class DatagramStream(Protocol):
    """Decoder of one sender's datagrams into readings. No I/O."""

    @property
    def counters(self) -> DatagramCounters:
        """Counters since the stream was made."""

    @property
    def sender_kind(self) -> str:
        """Kind of the sender, for people, such as `palm 0220`."""

    def receive(self, data: bytes, t_ns: int) -> Sequence[Reading] | None:
        """Return the readings that a datagram completes, or None if it is dropped."""

    def interrupt(self) -> None:
        """Forget the sender. Call when the link broke: another sender may come next."""


Stream = TypeVar("Stream", bound=DatagramStream)


class DatagramDriver(Opened, Generic[Stream]):
    """Driver that reads the datagrams of one sender by a stream.

    The sender (address and port) of the first good datagram is the only one until the link is
    lost, so two hands need two ports. The constructor raises `ValueError` for a wrong `source` or
    `only_from`, and `open` `LinkError` if it cannot listen. No fault of the link makes `read_ready`
    raise.
    """

    name: str
    bytes_max: int
    """Longest valid datagram, bytes."""
    silence_ns: int
    """Time without a good datagram after which the link is lost, ns."""
    exhausted = False
    live = True
    _fingers: tuple[str, ...] = ()
    """Fingers of the sensors whose values the sender reports."""

    def __init__(
        self,
        source: str,
        *,
        only_from: str | None = None,
        clock: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        """`source`: `udp://ADDRESS:PORT` to listen on.

        `only_from`: IP address whose datagrams are taken; None: any.
        """
        self._endpoint = Endpoint.parse(source)
        self._only_from = None if only_from is None else plain(only_from)
        self._clock = clock
        self._receiver: DatagramReceiver | None = None
        self._reset()

    @abstractmethod
    def _new_stream(self) -> Stream:
        """Return a new stream, for each `open`."""

    def _reset(self) -> None:
        self.stream = self._new_stream()
        self.link = Link(self.name)
        self._earlier_drops = 0
        self._sender: Sender | None = None
        self.sender: str | None = None
        """Last sender as `udp://ADDRESS:PORT`; None before the first good datagram."""
        self._t_ns = 0
        self._heard_from: str | None = None
        self._pauses = False

    @property
    def counters(self) -> DatagramCounters:
        return self.stream.counters

    @property
    def port(self) -> int | None:
        return None if self._receiver is None else self._receiver.port

    @property
    def serials(self) -> dict[str, str]:
        """The sender for each finger, because datagrams have no serial number."""
        return {} if self.sender is None else dict.fromkeys(self._fingers, self.sender)

    def describe(self) -> dict[str, Fact]:
        facts = {"source": Fact(str(self._endpoint)), **self.link.describe()}
        if self._heard_from is not None:
            facts["heard"] = Fact(self._heard_from)
        return facts

    def open(self) -> None:
        self.close()
        self._reset()
        receiver = DatagramReceiver(self._endpoint, self.bytes_max)
        self.link.start(self._clock())
        self._use(receiver)

    def close(self) -> None:
        self._drop_receiver()
        self._sender = None
        self.link.close()

    def fileno(self) -> int | None:
        return None if self._receiver is None else self._receiver.fileno()

    def due_ns(self) -> int | None:
        """Return the time, ns, to reopen the socket or to notice silence; None: neither."""
        if self.link.state is LinkState.UP:
            return self._good_t_ns + self.silence_ns
        return self.link.retry_ns

    def read_ready(self) -> Sequence[Reading]:
        if self._pauses:  # `Driver.serials` requires a pause between two senders
            self._pauses = False
            return ()
        readings: list[Reading] = []
        for data, t_ns in self._datagrams():
            completed = self.stream.receive(data, t_ns)
            if completed is not None:
                self._confirm()
                readings.extend(completed)
        if self._fell_silent():
            self.stream.interrupt()
            self._pauses = bool(readings)
        return readings

    def _datagrams(self) -> Iterator[tuple[bytes, int]]:
        """Yield waiting datagrams of accepted senders, oldest first, with arrival times, ns."""
        if self.link.state is LinkState.CLOSED:
            raise RuntimeError(f"the {self.name} link is not open")
        receiver = self._receiver or self._listen_again()
        if receiver is None:
            return
        try:
            for data, age_ns, sender in receiver.receive(DRAIN_MAX):
                if not self._is_heard(sender):
                    self.stream.counters.foreign_datagrams += 1
                    if self._sender is None:
                        self._refuse(sender[0])
                    continue
                self._heard = sender
                self._t_ns = max(self._t_ns, self._clock() - age_ns)
                yield data, self._t_ns
        except LinkError as error:
            self._lose(error)
            self._drop_receiver()
        else:
            self.stream.counters.kernel_drops = self._earlier_drops + receiver.dropped

    def _confirm(self) -> None:
        self._good_t_ns = self._t_ns
        if self.link.state is not LinkState.UP:
            self._sender = self._heard
            self.sender = str(Endpoint(*self._heard))
            self._heard_from = (
                f"{self.stream.sender_kind} from {self._heard[0]} port {self._heard[1]}"
            )
            self.link.up(self._heard_from, self._clock())

    def _fell_silent(self) -> bool:
        """Take a silent link down; return True if the link went down since the last call."""
        is_up = self.link.state is LinkState.UP
        if is_up and self._clock() - self._good_t_ns >= self.silence_ns:
            silence = f"nothing good for {self.silence_ns / 1e6:.0f} ms"
            self._lose(LinkError(LinkCause.TIMEOUT, silence))
            self.link.greeting()
            is_up = False
        lost = self._sender is not None and not is_up
        if lost:
            self._sender = None
        return lost

    def _is_heard(self, sender: Sender) -> bool:
        if self._sender is not None:
            return sender == self._sender
        return self._only_from is None or sender[0] == self._only_from

    def _refuse(self, address: str) -> None:
        why = f"datagrams of {address} are refused by only_from"
        if why != self.link.reason:
            self._lose(LinkError(LinkCause.FOREIGN, why))
            self.link.greeting()

    def _lose(self, error: LinkError) -> None:
        self.link.failed(error.cause, str(error), self._clock())
        self.stream.counters.link_losses = self.link.losses

    def _use(self, receiver: DatagramReceiver) -> DatagramReceiver:
        self._receiver = receiver
        self.link.greeting()
        return receiver

    def _listen_again(self) -> DatagramReceiver | None:
        if not self.link.is_due(self._clock()):
            return None
        try:
            return self._use(DatagramReceiver(self._endpoint, self.bytes_max))
        except LinkError as error:
            self._lose(error)
            return None

    def _drop_receiver(self) -> None:
        if self._receiver is not None:
            self._earlier_drops += self._receiver.dropped
            self._receiver.close()
            self._receiver = None
