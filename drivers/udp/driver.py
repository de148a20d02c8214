"""Base of drivers that take datagrams from one sender: heard, silent, or broken and reopened."""

from __future__ import annotations

import ipaddress
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass

from drivers.base import DriverCounters, Fact, LinkCause, LinkError, Opened
from drivers.link import Link, LinkState
from drivers.udp.receiver import DatagramReceiver, Endpoint, Sender

DRAIN_MAX = 256
"""Datagrams taken at once at most: a flood must not keep the loop from its other work."""


@dataclass(slots=True)
class DatagramCounters(DriverCounters):
    """What the link counts, in the counters of its driver."""

    foreign_datagrams: int = 0
    """Datagrams from another sender than the one that is listened to; dropped."""
    kernel_drops: int = 0
    """Datagrams that the kernel dropped because they were not taken in time."""
    link_losses: int = 0
    """Times that the link was up and fell silent or broke."""


class DatagramDriver(Opened):
    """Takes the datagrams of one sender, each with its time of arrival.

    The first sender of a good datagram is the sender until the link is lost: two hands on one port
    would otherwise be mixed, as nothing else tells them apart. Its address and its port do: two
    relays may run on one computer. With `only_from` no other address is ever heard.

    A subclass calls `listen` to open. To read it takes `datagrams`, calls `confirm` for each good
    one before the next, and `fell_silent` after the last.
    """

    name: str
    bytes_max: int
    """Longest datagram that makes sense."""
    silence_ns: int
    """Time without a good datagram after which the link is lost, ns."""
    exhausted = False
    live = True

    def __init__(
        self,
        source: str,
        *,
        only_from: str | None = None,
        clock: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        """`source` is `udp://ADDRESS:PORT`, `only_from` an IP address; `clock` gives monotonic ns.

        Raises `ValueError`.
        """
        self._endpoint = Endpoint.parse(source)
        self._only_from = None if only_from is None else str(ipaddress.ip_address(only_from))
        self._clock = clock
        self._receiver: DatagramReceiver | None = None
        self._begin(DatagramCounters())

    def _begin(self, counters: DatagramCounters) -> None:
        self._counters = counters
        self._link = Link(self.name)
        self._earlier_drops = 0
        self._sender: Sender | None = None
        self.sender: str | None = None
        """Who was heard last, `udp://ADDRESS:PORT`; None before the first good datagram."""
        self._t_ns = 0
        self._heard_from: str | None = None
        """What was heard last, from whom."""

    @property
    def link_state(self) -> LinkState:
        """What the link is doing: `GREETING` while listening and nothing good comes."""
        return self._link.state

    @property
    def port(self) -> int | None:
        """The port that is listened on, or None."""
        return None if self._receiver is None else self._receiver.port

    @property
    def serials(self) -> dict[str, str]:
        """Empty, unless a subclass knows of sensors."""
        return {}

    def describe(self) -> dict[str, Fact]:
        """Address, state, what is heard, and why nothing is."""
        known = {"source": Fact(str(self._endpoint)), **self._link.describe()}
        if self._heard_from is not None:
            known["heard"] = Fact(self._heard_from)
        return known

    def listen(self, counters: DatagramCounters) -> None:
        """Begin to listen, while closed; `counters` count what comes.

        Raises `LinkError` if it cannot: at the start that means that the scene is wrong.
        """
        self._begin(counters)
        receiver = DatagramReceiver(self._endpoint, self.bytes_max)
        self._link.start(self._clock())
        self._use(receiver)

    def close(self) -> None:
        """Stop listening."""
        self._drop_receiver()
        self._sender = None
        self._link.close()

    def fileno(self) -> int | None:
        """Readable when a datagram waits."""
        return None if self._receiver is None else self._receiver.fileno()

    def due_ns(self) -> int | None:
        """When to read without a datagram: to open again, or to notice silence."""
        if self._link.state is LinkState.UP:
            return self._good_t_ns + self.silence_ns
        return self._link.retry_ns

    def datagrams(self) -> Iterator[tuple[bytes, int]]:
        """Datagrams that wait, oldest first, each with its monotonic time of arrival, ns."""
        if self._link.state is LinkState.CLOSED:
            raise RuntimeError(f"the {self.name} link is not open")
        receiver = self._receiver or self._listen_again()
        if receiver is None:
            return
        try:
            for data, age_ns, sender in receiver.receive(DRAIN_MAX):
                if not self._is_heard(sender):
                    self._counters.foreign_datagrams += 1
                    continue
                self._heard = sender
                self._t_ns = max(self._t_ns, self._clock() - age_ns)
                yield data, self._t_ns
        except LinkError as error:
            self._lose(error)
            self._drop_receiver()
        else:
            self._counters.kernel_drops = self._earlier_drops + receiver.dropped

    def confirm(self, what: str) -> None:
        """The last datagram is good: `what` sent it, for the log."""
        self._good_t_ns = self._t_ns
        if self._link.state is not LinkState.UP:
            self._sender = self._heard
            self.sender = str(Endpoint(*self._heard))
            self._heard_from = f"{what} from {self._heard[0]} port {self._heard[1]}"
            self._link.up(self._heard_from, self._clock())

    def fell_silent(self) -> bool:
        """True if the link is down now and was up the last time."""
        is_up = self._link.state is LinkState.UP
        if is_up and self._clock() - self._good_t_ns >= self.silence_ns:
            silence = f"nothing good for {self.silence_ns / 1e6:.0f} ms"
            self._lose(LinkError(LinkCause.TIMEOUT, silence))
            self._link.greeting()
            is_up = False
        lost = self._sender is not None and not is_up
        if lost:
            self._sender = None
        return lost

    def _is_heard(self, sender: Sender) -> bool:
        if self._sender is not None:
            return sender == self._sender
        return self._only_from is None or sender[0] == self._only_from

    def _lose(self, error: LinkError) -> None:
        self._link.failed(error.cause, str(error), self._clock())
        self._counters.link_losses = self._link.losses

    def _use(self, receiver: DatagramReceiver) -> DatagramReceiver:
        self._receiver = receiver
        self._link.greeting()
        return receiver

    def _listen_again(self) -> DatagramReceiver | None:
        if not self._link.is_due(self._clock()):
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
