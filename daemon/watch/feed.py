"""The subscriber of `graspd watch`: connects to a daemon like any other, and takes messages."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Final, Self

import zmq
from zmq.utils.monitor import recv_monitor_message

from daemon.process.sleep import boottime_ns
from daemon.publish.keys import load_pair, load_public

TOPICS: Final = ("verdict.", "gate.", "tactile.", "status.", "outcome.")
WAITING_MAX = 2000
"""Messages that wait here; at 100 Hz those of seven seconds. More are lost, and seen as lost."""
TAKEN_MAX = 5000
"""Messages taken at a time, more than can wait: after a pause the newest is there at once."""
PAUSE_NS = 1_000_000_000
"""Who has not looked for longer connects anew: what waits is old, and what is new may be lost."""
RETRY_NS = 5_000_000_000
"""After being turned away: libzmq does not try again by itself, and the key may be known by then.
"""
MESSAGE_MAX_BYTES = 1 << 20
"""A status has some kilobytes; who sends more is no daemon."""
HEARTBEAT_MS, HEARTBEAT_TIMEOUT_MS = 1000, 3000
"""On TCP, as the daemon has them, ms."""
RECONNECT_MS, RECONNECT_MAX_MS = 100, 1000
"""Before connecting again, at first and at most, ms."""
NOT_CONNECTED: Final = "not connected"
EVENTS: Final = {
    int(zmq.EVENT_HANDSHAKE_SUCCEEDED): "connected",
    int(zmq.EVENT_DISCONNECTED): NOT_CONNECTED,
    int(zmq.EVENT_CONNECT_RETRIED): NOT_CONNECTED,
    int(zmq.EVENT_HANDSHAKE_FAILED_AUTH): "turned away: the daemon does not know this key",
}
"""What the connection is like after an event."""
REFUSALS: Final = {
    int(zmq.EVENT_HANDSHAKE_FAILED_PROTOCOL): (
        "turned away: the daemon wants a key (--keys)",
        "turned away: this daemon takes no keys",
    ),
    int(zmq.EVENT_HANDSHAKE_FAILED_NO_DETAIL): (
        "turned away: the daemon wants a key (--keys)",
        "turned away: is the daemon's key right?",
    ),
}
"""The same without keys and with keys."""
FOLLOW = 2
"""Events that follow when one is turned away, and say less: disconnected, will be tried again."""


class Feed:
    """Subscribed to all topics of an endpoint until `close`; connects again by itself."""

    def __init__(
        self,
        endpoint: str,
        keys: tuple[bytes, bytes, bytes] | None = None,
        clock: Callable[[], int] = boottime_ns,
    ) -> None:
        """`keys`: own public and secret key and the daemon's public one, Z85, where it needs them;
        `clock` gives ns, also while the computer sleeps.

        Raises `zmq.ZMQError` for an endpoint that is none.
        """
        self.link = "connecting"
        """What the connection is like, in words."""
        self._endpoint = endpoint
        self._keys = keys
        self._clock = clock
        self._taken_ns = self._opened_ns = clock()
        self.empty_ns = self._opened_ns
        """When nothing waited: what `take` gives has come since, and may be as old."""
        self._context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
        self._events = EVENTS | {event: says[keys is not None] for event, says in REFUSALS.items()}
        self._follow = 0
        self._open()

    def _open(self) -> None:
        self._socket = self._context.socket(zmq.SUB)
        self._socket.linger = 0
        self._socket.rcvhwm = WAITING_MAX
        self._socket.maxmsgsize = MESSAGE_MAX_BYTES
        self._socket.reconnect_ivl = RECONNECT_MS
        self._socket.reconnect_ivl_max = RECONNECT_MAX_MS
        if self._keys is not None:
            self._socket.curve_publickey, self._socket.curve_secretkey = self._keys[:2]
            self._socket.curve_serverkey = self._keys[2]
        if self._endpoint.startswith("tcp://"):
            self._socket.heartbeat_ivl = HEARTBEAT_MS
            self._socket.heartbeat_timeout = HEARTBEAT_TIMEOUT_MS
        self._monitor = self._socket.get_monitor_socket(sum(EVENTS) + sum(REFUSALS))
        try:
            self._socket.connect(self._endpoint)
        except zmq.ZMQError:
            self.close()
            raise
        for topic in TOPICS:
            self._socket.subscribe(topic)

    def take(self) -> Iterator[tuple[bytes, bytes]]:
        """Topic and payload of each message that has come; never waits."""
        self._connect_anew_if_need_be()
        self._look_at_link()
        for _ in range(TAKEN_MAX):
            before_ns = self._clock()
            try:
                frames = self._socket.recv_multipart(zmq.NOBLOCK)
            except zmq.Again:
                self.empty_ns = before_ns
                return
            if len(frames) == 2:
                yield frames[0], frames[1]

    def _connect_anew_if_need_be(self) -> None:
        now_ns = self._clock()
        paused = now_ns - self._taken_ns > PAUSE_NS
        self._taken_ns = now_ns
        if paused or (self.is_turned_away and now_ns - self._opened_ns > RETRY_NS):
            self._opened_ns = self.empty_ns = now_ns
            self._let_go()
            self._open()

    @property
    def is_turned_away(self) -> bool:
        """Whether the daemon does not let us in."""
        return self.link.startswith("turned away")

    def _look_at_link(self) -> None:
        while self._monitor.poll(0):
            event = int(recv_monitor_message(self._monitor)["event"])
            link = self._events.get(event, self.link)
            if link == NOT_CONNECTED and self._follow:
                self._follow -= 1
                continue
            self.link = link
            self._follow = FOLLOW if self.is_turned_away else 0

    def close(self) -> None:
        """Let go of the endpoint. May be called again."""
        self._let_go()
        self._context.term()

    def _let_go(self) -> None:
        if not self._socket.closed:
            self._socket.disable_monitor()
            self._monitor.close(0)
            self._socket.close(0)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_details: object) -> None:
        self.close()


def load_keys(own: Path, daemon: Path) -> tuple[bytes, bytes, bytes]:
    """Own public and secret key, and the daemon's public one, Z85.

    `own` is a `.key_secret` file of mode 0600, `daemon` the daemon's `.key`. Raises `KeysError`.
    """
    return *load_pair(own), load_public(daemon, "the daemon's key")
