"""The ZeroMQ socket that carries the messages, and nothing else."""

from __future__ import annotations

import math
import time
from collections import Counter
from collections.abc import Callable
from typing import Protocol

import zmq

from daemon.publish.binding import Binding, Bound

SUBSCRIBED, UNSUBSCRIBED = 1, 0
"""First byte of a message on an XPUB socket: somebody wants a topic, nobody does any more."""
VERDICT = b"verdict."
"""What the topics of verdicts begin with."""
REPEATED = (VERDICT, b"status.")
"""Topics whose last message is for those who come later, too."""
VERDICT_REPEATED_NS = 100_000_000
"""An older verdict is not repeated: who gets it would take it for new."""
SUBSCRIBED_MAX = 100
"""Topics that are remembered as wanted; the daemon has five."""
SUBSCRIPTION_MAX_BYTES = 128
"""A peer that sends more is no subscriber and is disconnected. A topic has 40 bytes, a greeting
with an identity of 80 bytes just fits."""
SUBSCRIPTIONS_WAITING_MAX = 2
"""Subscriptions of one peer that wait in the socket; the rest waits in the peer. With four, libzmq
can go round in `send` for as long as a peer floods it (measured: over a second); with two it cannot
keep up, and takes some two thousand a second. With one, a peer with keys is never heard."""
TAKEN_MAX = 256
"""Subscriptions looked at in one round, in half a millisecond: a flood must not hold up readings.
"""
REPEAT_NS = 50_000_000
"""New subscribers get the last messages at once, but everybody sees that: so often at most."""
LINGER_MS = 500
"""How long closing waits for subscribers to take what is still queued, ms."""
HEARTBEAT_MS, HEARTBEAT_TIMEOUT_MS = 1000, 3000
"""On TCP: between two signs of life, and when a peer that gives none is gone, ms."""


class Stop(Protocol):
    """What ends waiting: its descriptor becomes readable."""

    def fileno(self) -> int:
        """Descriptor to wait on."""


class Publisher(Bound):
    """Publishes two-frame messages `[topic, payload]`; never blocks the caller.

    Whoever subscribes gets the last status and, if it is fresh, the last verdict at once; others
    may see such a message twice, with the same `seq`.

    A subscriber that falls behind by the high-water mark loses messages, which is counted, and sees
    the gap in `seq`; it cannot delay anyone else. Different subscriptions are all remembered by
    libzmq until the peer goes: one that sends them as fast as it can makes the daemon grow by half
    a MB/s. So only those who may do that should be able to connect: see `[publish] file_mode` and
    `[curve]`.
    """

    def __init__(
        self,
        endpoint: str,
        high_water_mark: int = 1000,
        binding: Binding | None = None,
        clock: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        """Bind to `endpoint`, queueing so many messages per peer. Raises `PublishError`."""
        super().__init__(endpoint, binding)
        self.counters = Counter(queues_full=0, repeated=0, subscriptions=0)
        """How often a peer's queue was full (it misses messages until it has read on, as `seq`
        tells), messages repeated for new peers, subscriptions."""
        self._high_water_mark = high_water_mark
        self._clock = clock
        self._last: dict[bytes, tuple[bytes, int]] = {}
        """Last payload, and when it was sent, by topic; the daemon has two."""
        self._subscribed: set[bytes] = set()
        """What topics that somebody wants begin with."""
        self._owed: set[bytes] = set()
        """Topics whose last message somebody waits for."""
        self._repeat_due_ns = 0
        self.renew()

    def _open(self) -> zmq.Socket[bytes]:
        self._subscribed.clear()
        made = self._context.socket(zmq.XPUB)
        made.linger = LINGER_MS
        made.sndhwm = self._high_water_mark
        made.rcvhwm = SUBSCRIPTIONS_WAITING_MAX
        made.maxmsgsize = SUBSCRIPTION_MAX_BYTES
        made.setsockopt(zmq.XPUB_NODROP, 1)
        made.setsockopt(zmq.XPUB_VERBOSE, 1)  # else only the first who wants a topic is heard of
        if self.endpoint.startswith("tcp://"):
            made.heartbeat_ivl = HEARTBEAT_MS
            made.heartbeat_timeout = HEARTBEAT_TIMEOUT_MS
        self._bind(made, "publish")
        return made

    def fileno(self) -> int:
        """Becomes readable when somebody may have subscribed; call `take` before waiting for it."""
        return int(self.socket.fileno())

    def send(self, topic: bytes, payload: bytes) -> None:
        """Hand one message to ZeroMQ, and keep it for those who come later."""
        if topic.startswith(REPEATED):
            self._last[topic] = (payload, self._clock())
        self._send(topic, payload)

    def _send(self, topic: bytes, payload: bytes) -> None:
        if not self.is_open:
            return
        try:
            self.socket.send_multipart((topic, payload), flags=zmq.NOBLOCK, copy=True)
        except zmq.Again:
            # Some peer's queue is full: drop it for that one, and send it to the others.
            self.counters["queues_full"] += 1
            self.socket.setsockopt(zmq.XPUB_NODROP, 0)
            self.socket.send_multipart((topic, payload), flags=zmq.NOBLOCK, copy=True)
            self.socket.setsockopt(zmq.XPUB_NODROP, 1)

    def take(self) -> None:
        """See who has subscribed, and repeat the last messages for them."""
        for _ in range(TAKEN_MAX):
            if not int(self.socket.get(zmq.EVENTS)) & zmq.POLLIN:
                break
            self._note(self.socket.recv(zmq.NOBLOCK))
        if self._owed:
            self._repeat()

    def wanted(self, topic: bytes) -> bool:
        """Whether somebody subscribes to a topic, as far as `take` has seen."""
        return any(topic.startswith(prefix) for prefix in self._subscribed)

    def _note(self, message: bytes) -> None:
        if message[:1] == bytes([UNSUBSCRIBED]):
            self._subscribed.discard(message[1:])
        if message[:1] != bytes([SUBSCRIBED]):
            return
        self.counters["subscriptions"] += 1
        if len(self._subscribed) < SUBSCRIBED_MAX:
            self._subscribed.add(message[1:])
        self._owed.update(topic for topic in self._last if topic.startswith(message[1:]))

    def _repeat(self) -> None:
        now_ns = self._clock()
        if now_ns < self._repeat_due_ns:
            return
        self._repeat_due_ns = now_ns + REPEAT_NS
        for topic in self._owed:
            payload, sent_ns = self._last[topic]
            if not topic.startswith(VERDICT) or now_ns - sent_ns <= VERDICT_REPEATED_NS:
                self._send(topic, payload)
                self.counters["repeated"] += 1
        self._owed.clear()

    def forget(self) -> None:
        """Repeat nothing of what was sent up to now."""
        self._last.clear()
        self._owed.clear()

    def wait_for_subscriber(self, timeout_s: float, stop: Stop | None = None) -> bool:
        """Wait until somebody subscribes.

        False if nobody has within `timeout_s` seconds or when `stop` becomes readable.
        """
        poller = zmq.Poller()
        poller.register(self.socket, zmq.POLLIN)
        if stop is not None:
            poller.register(stop, zmq.POLLIN)
        deadline_s = time.monotonic() + timeout_s
        while True:
            remaining_s = max(deadline_s - time.monotonic(), 0.0)
            ready = [which for which, _ in poller.poll(math.ceil(remaining_s * 1e3))]
            if ready != [self.socket]:
                return False
            self._note(self.socket.recv(zmq.NOBLOCK))
            if self.counters["subscriptions"]:
                return True
            if remaining_s == 0.0:
                return False
