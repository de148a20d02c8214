"""The ZeroMQ socket that carries the messages, and nothing else."""

from __future__ import annotations

import math
import time
from typing import Protocol

import zmq

from daemon.binding import Bound, PublishError, bind

SUBSCRIBED = 1
"""First byte of a subscription message on an XPUB socket."""
SUBSCRIPTION_MAX_BYTES = 128
"""A peer that sends more is no subscriber and is disconnected. A topic has 40 bytes, a greeting
with an identity of 80 bytes just fits."""
SUBSCRIPTIONS_WAITING_MAX = 4
"""Subscriptions of one peer that wait to be looked at; the rest waits in the peer."""
LINGER_MS = 500
"""How long closing waits for subscribers to take what is still queued, ms."""


class Stop(Protocol):
    """What ends waiting: its descriptor becomes readable."""

    def fileno(self) -> int:
        """Descriptor to wait on."""


class Publisher(Bound):
    """Publishes two-frame messages `[topic, payload]`; never blocks the caller.

    A subscriber that falls behind by the high-water mark loses messages, and sees the gap in
    `seq`; it cannot delay anyone else.

    What subscribers send is read by libzmq inside `send`. Repeated subscriptions and junk cost
    nothing to speak of. Different subscriptions are all remembered until the peer goes, and libzmq
    has no limit on their number: a peer that floods a daemon of 100 messages/s with topics of 120
    bytes as fast as it can makes it grow by 20 MB/s and holds up a message by 0.2 s at worst. So
    only those who may do that should be able to connect: keep the socket in a folder of yours.
    """

    def __init__(self, endpoint: str, high_water_mark: int = 1000, *, waits: bool = False) -> None:
        """Bind to `endpoint`. Raises `PublishError`.

        `waits`: `wait_for_subscriber` will be used. libzmq then keeps what peers send later too,
        without a limit: for a replay, not for a daemon.
        """
        super().__init__(endpoint)
        self._waits = waits
        try:
            self._socket = self._bound(high_water_mark)
        except zmq.ZMQError as error:
            self.close()
            raise PublishError(f"cannot publish on {endpoint}: {error.strerror}") from error

    def _bound(self, high_water_mark: int) -> zmq.Socket[bytes]:
        bound = self._context.socket(zmq.XPUB if self._waits else zmq.PUB)
        bound.linger = LINGER_MS
        bound.sndhwm = high_water_mark
        bound.rcvhwm = SUBSCRIPTIONS_WAITING_MAX
        bound.maxmsgsize = SUBSCRIPTION_MAX_BYTES
        bind(bound, self.endpoint, self._file)
        return bound

    def send(self, topic: bytes, payload: bytes) -> None:
        """Hand one message to ZeroMQ."""
        self._socket.send_multipart((topic, payload), flags=zmq.NOBLOCK, copy=True)

    def wait_for_subscriber(self, timeout_s: float, stop: Stop | None = None) -> bool:
        """Wait until somebody subscribes.

        False if nobody has within `timeout_s` seconds or when `stop` becomes readable.
        """
        if not self._waits:
            raise RuntimeError("the publisher was not made to wait")
        poller = zmq.Poller()
        poller.register(self._socket, zmq.POLLIN)
        if stop is not None:
            poller.register(stop, zmq.POLLIN)
        deadline_s = time.monotonic() + timeout_s
        while True:
            remaining_s = max(deadline_s - time.monotonic(), 0.0)
            ready = [which for which, _ in poller.poll(math.ceil(remaining_s * 1e3))]
            if ready != [self._socket]:
                return False
            if self._socket.recv(zmq.NOBLOCK)[:1] == bytes([SUBSCRIBED]):
                return True
            if remaining_s == 0.0:
                return False
