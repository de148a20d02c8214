"""The subscriber of `graspd watch`."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Final, Self

import zmq
from zmq.utils.monitor import recv_monitor_message

from graspd.daemon.process.sleep import boottime_ns
from graspd.daemon.publish.keys import load_pair, load_public
from graspd.daemon.watch.snapshot import Link

TOPICS: Final = ("verdict.", "gate.", "tactile.", "status.", "outcome.")
WAITING_MAX: Final = 2000
"""Most messages that wait in the socket: seven seconds of them."""
TAKEN_MAX: Final = 5000
"""Most messages taken in one call, more than can wait."""
PAUSE_NS: Final = 1_000_000_000
"""Pause of the viewer, ns, after which it reconnects, because waiting messages are old."""
RETRY_NS: Final = 5_000_000_000
"""Time from a refusal to the next try, ns. The daemon may know the key by then."""
MESSAGE_MAX_BYTES: Final = 1 << 20
HEARTBEAT_MS, HEARTBEAT_TIMEOUT_MS = 1000, 3000
"""Time between two heartbeats on TCP, and their timeout, as in the daemon, ms."""
RECONNECT_MS, RECONNECT_MAX_MS = 100, 1000
"""Shortest and longest time before connecting again, ms."""
EVENTS: Final = {
    int(zmq.EVENT_HANDSHAKE_SUCCEEDED): Link.CONNECTED,
    int(zmq.EVENT_DISCONNECTED): Link.NOT_CONNECTED,
    int(zmq.EVENT_CONNECT_RETRIED): Link.NOT_CONNECTED,
    int(zmq.EVENT_HANDSHAKE_FAILED_AUTH): Link.UNKNOWN_KEY,
    int(zmq.EVENT_HANDSHAKE_FAILED_PROTOCOL): Link.NEEDS_KEY,
    int(zmq.EVENT_HANDSHAKE_FAILED_NO_DETAIL): Link.NEEDS_KEY,
}
"""State of the connection after each event of the socket's monitor."""
EVENTS_WITH_KEYS: Final = EVENTS | {
    int(zmq.EVENT_HANDSHAKE_FAILED_PROTOCOL): Link.TAKES_NO_KEYS,
    int(zmq.EVENT_HANDSHAKE_FAILED_NO_DETAIL): Link.WRONG_DAEMON,
}
FOLLOW: Final = 2
"""Number of events after a refusal that must not hide it: disconnected, retried."""


class Feed:
    """Subscribes to all topics of an endpoint until `close`; reconnects by itself."""

    def __init__(
        self,
        endpoint: str,
        keys: tuple[bytes, bytes, bytes] | None = None,
        clock: Callable[[], int] = boottime_ns,
    ) -> None:
        """Connect. Raises `zmq.ZMQError` for a wrong endpoint.

        `keys`: from `load_keys`; None: no keys. `clock`: returns ns, which count in a sleep too.
        """
        self.link = Link.CONNECTING
        self._endpoint = endpoint
        self._keys = keys
        self._clock = clock
        self._taken_ns = self._opened_ns = clock()
        self.empty_ns = self._opened_ns
        """Last time at which no message waited, ns. Messages from `take` arrived after it."""
        self.looked_ns = self._opened_ns
        """Time of the last look for a message, ns. Messages from `take` arrived before it."""
        self.stood_still = 0, 0
        """Begin and end of this process's last pause of over `PAUSE_NS`, ns."""
        self._context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
        self._events = EVENTS if keys is None else EVENTS_WITH_KEYS
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
            self._socket.ipv6 = "[" in self._endpoint
            self._socket.heartbeat_ivl = HEARTBEAT_MS
            self._socket.heartbeat_timeout = HEARTBEAT_TIMEOUT_MS
        self._monitor = self._socket.get_monitor_socket(sum(EVENTS))
        try:
            self._socket.connect(self._endpoint)
        except zmq.ZMQError:
            self.close()
            raise
        for topic in TOPICS:
            self._socket.subscribe(topic)

    def take(self) -> Iterator[tuple[bytes, bytes]]:
        """Yield topic and payload of each message that has arrived, at most `TAKEN_MAX`."""
        self._reconnect_if_needed()
        self._update_link()
        for _ in range(TAKEN_MAX):
            self.looked_ns = self._clock()
            try:
                frames = self._socket.recv_multipart(zmq.NOBLOCK)
            except zmq.Again:
                self.empty_ns = self.looked_ns
                return
            if len(frames) == 2:
                yield frames[0], frames[1]

    def _reconnect_if_needed(self) -> None:
        now_ns = self._clock()
        paused = now_ns - self._taken_ns > PAUSE_NS
        if paused:
            self.stood_still = self._taken_ns, now_ns
        self._taken_ns = now_ns
        if paused or (self.link.is_turned_away and now_ns - self._opened_ns > RETRY_NS):
            self._opened_ns = self.empty_ns = now_ns
            self._close_sockets()
            self._open()

    def _update_link(self) -> None:
        while self._monitor.poll(0):
            event = int(recv_monitor_message(self._monitor)["event"])
            link = self._events.get(event, self.link)
            if link is Link.NOT_CONNECTED and self._follow:
                self._follow -= 1
                continue
            self.link = self._obstacle() if link is Link.NOT_CONNECTED else link
            self._follow = FOLLOW if link.is_turned_away else 0

    def _obstacle(self) -> Link:
        """Return why there is no connection, by the socket's file; over TCP the reason is not
        known."""
        scheme, _, path = self._endpoint.partition("://")
        if scheme != "ipc":
            return Link.NOT_CONNECTED
        try:
            os.stat(path)
        except FileNotFoundError:
            return Link.NO_SOCKET
        except PermissionError:
            return Link.NOT_ALLOWED
        except OSError:
            return Link.NOT_CONNECTED
        return Link.NO_DAEMON if os.access(path, os.W_OK) else Link.NOT_ALLOWED

    def close(self) -> None:
        self._close_sockets()
        self._context.term()

    def _close_sockets(self) -> None:
        if not self._socket.closed:
            self._socket.disable_monitor()
            self._monitor.close(0)
            self._socket.close(0)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_details: object) -> None:
        self.close()


def load_keys(own: Path, daemon: Path) -> tuple[bytes, bytes, bytes]:
    """Return public and secret key of the file `own`, then the daemon's public key, from the file
    `daemon`; all in Z85. Raises `KeysError`."""
    return *load_pair(own), load_public(daemon, "the daemon's key")
