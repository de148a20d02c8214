"""A link that consists of datagrams from one sender: heard, silent, or broken and opened again."""

from __future__ import annotations

import ipaddress
from collections.abc import Callable, Iterator
from dataclasses import dataclass

from drivers.base import DriverCounters, LinkError, Opened
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
    """Datagrams that the kernel dropped because nobody took them in time."""
    link_losses: int = 0
    """Times that the link was up and fell silent or broke."""


class DatagramLink:
    """Hands over the datagrams of one sender, each with its time of arrival.

    The first sender of a good datagram is the sender until the link is lost: two hands on one port
    would otherwise be mixed, as nothing else tells them apart. Its address and its port do: two
    relays may run on one computer. With `only_from` no other address is ever heard.
    """

    def __init__(
        self,
        name: str,
        source: str,
        clock: Callable[[], int],
        *,
        bytes_max: int,
        silence_ns: int,
        only_from: str | None = None,
    ) -> None:
        """`source` is `udp://ADDRESS:PORT`, `only_from` an IP address; `clock` gives monotonic ns.

        Without a good datagram for `silence_ns` the link is lost. Raises `ValueError`.
        """
        self._name = name
        self._endpoint = Endpoint.parse(source)
        self._only_from = None if only_from is None else str(ipaddress.ip_address(only_from))
        self._bytes_max = bytes_max
        self._silence_ns = silence_ns
        self._clock = clock
        self._receiver: DatagramReceiver | None = None
        self._described = {"source": str(self._endpoint)}
        self._begin(DatagramCounters())

    def _begin(self, counters: DatagramCounters) -> None:
        self._counters = counters
        self._link = Link(self._name)
        self._earlier_drops = 0
        self._sender: Sender | None = None
        self.sender: str | None = None
        """Who was heard last, `udp://ADDRESS:PORT`; None before the first good datagram."""
        self._t_ns = 0
        self._heard_from: str | None = None
        """What was heard last, from whom."""

    @property
    def state(self) -> LinkState:
        """`GREETING` while listening and nothing good comes."""
        return self._link.state

    @property
    def port(self) -> int | None:
        """The port that is listened on, or None."""
        return None if self._receiver is None else self._receiver.port

    def describe(self) -> dict[str, str]:
        """Address, state, what is heard and why it is not, for people; after `close` as then."""
        if self._link.state is LinkState.CLOSED:
            return self._described
        known = {"source": str(self._endpoint), "link": str(self._link.state)}
        if self._heard_from is not None:
            known["heard"] = self._heard_from
        if self._link.reason is not None:
            known["why"] = self._link.reason
        return known

    def open(self, counters: DatagramCounters) -> None:
        """Begin to listen; `counters` count what comes.

        Raises `LinkError` if it cannot: at the start that means that the scene is wrong.
        """
        self.close()
        self._begin(counters)
        receiver = DatagramReceiver(self._endpoint, self._bytes_max)
        self._link.start(self._clock())
        self._listen(receiver)

    def close(self) -> None:
        """Stop listening."""
        self._described = self.describe()
        self._drop_receiver()
        self._sender = None
        self._link.close()

    def fileno(self) -> int | None:
        """Readable when a datagram waits."""
        return None if self._receiver is None else self._receiver.fileno()

    def due_ns(self) -> int | None:
        """When to call `receive` without a datagram: to open again, or to notice silence."""
        if self._link.state is LinkState.UP:
            return self._good_t_ns + self._silence_ns
        return self._link.retry_ns

    def receive(self) -> Iterator[tuple[bytes, int]]:
        """Datagrams that wait, oldest first, each with its monotonic time of arrival, ns.

        Whoever takes one and finds it good calls `confirm` before the next.
        """
        if self._link.state is LinkState.CLOSED:
            raise RuntimeError(f"the {self._name} link is not open")
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
            self._lose(str(error))
            self._drop_receiver()
        else:
            self._counters.kernel_drops = self._earlier_drops + receiver.dropped

    def confirm(self, what: str) -> None:
        """The datagram at hand is good: `what` sent it, for the log."""
        self._good_t_ns = self._t_ns
        if self._link.state is not LinkState.UP:
            self._sender = self._heard
            self.sender = str(Endpoint(*self._heard))
            self._heard_from = f"{what} from {self._heard[0]} port {self._heard[1]}"
            self._link.up(self._heard_from, self._clock())

    def fell_silent(self) -> bool:
        """Call after `receive`: whether the link is down now and was up the last time."""
        is_up = self._link.state is LinkState.UP
        if is_up and self._clock() - self._good_t_ns >= self._silence_ns:
            self._lose(f"nothing good for {self._silence_ns / 1e6:.0f} ms")
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

    def _lose(self, why: str) -> None:
        self._link.failed(why, self._clock())
        self._counters.link_losses = self._link.losses

    def _listen(self, receiver: DatagramReceiver) -> DatagramReceiver:
        self._receiver = receiver
        self._link.greeting()
        return receiver

    def _listen_again(self) -> DatagramReceiver | None:
        if not self._link.is_due(self._clock()):
            return None
        try:
            return self._listen(DatagramReceiver(self._endpoint, self._bytes_max))
        except LinkError as error:
            self._lose(str(error))
            return None

    def _drop_receiver(self) -> None:
        if self._receiver is not None:
            self._earlier_drops += self._receiver.dropped
            self._receiver.close()
            self._receiver = None


class DatagramDriver(Opened):
    """Base of drivers that listen to datagrams; whoever derives opens `link` and reads from it."""

    exhausted = False
    live = True

    def __init__(self, link: DatagramLink) -> None:
        """Nothing is listened to yet."""
        self.link = link

    @property
    def link_state(self) -> LinkState:
        """What the link is doing."""
        return self.link.state

    @property
    def port(self) -> int | None:
        """The port that is listened on, or None."""
        return self.link.port

    @property
    def serials(self) -> dict[str, str]:
        """Empty, unless who derives knows of sensors."""
        return {}

    def describe(self) -> dict[str, str]:
        """Source, link, what is heard from whom; after `close` as it was then."""
        return self.link.describe()

    def fileno(self) -> int | None:
        """The socket."""
        return self.link.fileno()

    def due_ns(self) -> int | None:
        """When silence is to be noticed."""
        return self.link.due_ns()

    def close(self) -> None:
        """Release the socket."""
        self.link.close()
