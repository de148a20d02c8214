"""Checks the keys of peers that connect by TCP (ZAP, RFC 27); counts and logs who is refused."""

from __future__ import annotations

import contextlib
import logging
import socket
import sys
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field

import zmq
from zmq.utils import z85
from zmq.utils.monitor import parse_monitor_message

log = logging.getLogger("graspd")

ZAP_ENDPOINT = "inproc://zeromq.zap.01"
ZAP_VERSION = b"1.0"
REQUEST_FRAMES = 9
"""Of a CURVE request: who asks (2), version, id, domain, address, identity, mechanism, key."""
TAKEN_MAX = 64
"""Requests and events looked at in one round, so that a flood does not hold up readings."""
STRANGERS_MAX = 128
"""Connections to a socket that have not shown a key yet; the oldest makes place for a newer one, so
that there are always descriptors for files and devices."""
SHOWN_BYTES = 500
"""Who has sent less has not shown a key: greeting, HELLO and INITIATE have 64, 202 and 259 bytes at
least (RFC 26)."""
TCP_BYTES_RECEIVED = slice(128, 136)
"""Where in tcp_info (linux/tcp.h, tcpi_bytes_received)."""
EVENTS = (
    zmq.EVENT_ACCEPTED
    | zmq.EVENT_DISCONNECTED
    | zmq.EVENT_HANDSHAKE_SUCCEEDED
    | zmq.EVENT_HANDSHAKE_FAILED_PROTOCOL
    | zmq.EVENT_HANDSHAKE_FAILED_AUTH
)
ANSWERED = (zmq.EVENT_HANDSHAKE_SUCCEEDED, zmq.EVENT_HANDSHAKE_FAILED_AUTH)
"""End a handshake in which the key was asked about: who it is has been logged."""
NO_KEY_SHOWN = "turned away a peer: it showed no key, has none, or does not speak ZeroMQ 4"
WRONG_KEYS = "turned away a peer: it has no keys, or not the daemon's"
"""Of a handshake that failed without our being asked, which libzmq says right before the connection
goes. Who speaks another protocol, or notices first that the keys do not fit, just goes (4.3.5)."""


@dataclass(slots=True, eq=False)
class _Watched:
    """A listening socket, and its connections that have not shown a key yet."""

    listening: zmq.Socket[bytes]
    monitor: zmq.Socket[bytes]
    waiting: dict[int, None] = field(default_factory=dict)
    """Descriptors of connections whose handshake has not ended, oldest first. No more than the
    process may have descriptors."""
    why: str = NO_KEY_SHOWN
    """Of the connection that goes next."""


class Authenticator:
    """Answers libzmq whether a peer's key is known, and counts peers that show none.

    Make it before the sockets of its context are bound. Never blocks. The log has the address of
    an unknown key; libzmq does not give those of peers that show no key.
    """

    def __init__(
        self, context: zmq.Context[zmq.Socket[bytes]], admitted: Mapping[bytes, str]
    ) -> None:
        """`admitted` maps public keys (Z85, 40 bytes) to the names of who may connect."""
        self.counters = Counter(admitted=0, turned_away=0, crowded_out=0, files_refused=0)
        self._admitted = dict(admitted)
        self._context = context
        self._requests = context.socket(zmq.ROUTER)
        self._requests.linger = 0
        self._requests.bind(ZAP_ENDPOINT)
        self._watched: list[_Watched] = []

    def watch(self, listening: zmq.Socket[bytes]) -> None:
        """Hear of peers of this socket that fail without asking: those without keys, those that
        speak no ZeroMQ, those that say nothing (until their handshake has taken too long)."""
        endpoint = f"inproc://graspd-monitor-{id(listening)}"
        listening.monitor(endpoint, EVENTS)
        monitor = self._context.socket(zmq.PAIR)
        monitor.linger = 0
        # Else libzmq's own thread waits in the middle of its work when nobody has looked for long.
        monitor.rcvhwm = 0
        monitor.connect(endpoint)
        self._watched.append(_Watched(listening, monitor))

    def admit(self, admitted: Mapping[bytes, str]) -> bool:
        """Replace the list of known keys; True if a key was removed from it."""
        gone = self._admitted.keys() - admitted.keys()
        self._admitted = dict(admitted)
        return bool(gone)

    def filenos(self) -> list[int]:
        """Readable when `take` has something to do; call that once before waiting for them."""
        monitors = (watched.monitor for watched in self._watched)
        return [int(each.fileno()) for each in (self._requests, *monitors)]

    def take(self) -> None:
        """Answer what libzmq has asked, and count whose handshake has failed."""
        for _ in range(TAKEN_MAX):
            if not int(self._requests.get(zmq.EVENTS)) & zmq.POLLIN:
                break
            self._answer(self._requests.recv_multipart(zmq.NOBLOCK))
        for watched in self._watched:
            for _ in range(TAKEN_MAX):
                if not int(watched.monitor.get(zmq.EVENTS)) & zmq.POLLIN:
                    break
                event = parse_monitor_message(watched.monitor.recv_multipart(zmq.NOBLOCK))
                self._note(watched, event["event"], event["value"])
            while len(watched.waiting) > STRANGERS_MAX:
                descriptor = next(iter(watched.waiting))
                del watched.waiting[descriptor]
                self.counters["crowded_out"] += _hang_up(descriptor)

    def _answer(self, frames: list[bytes]) -> None:
        if len(frames) != REQUEST_FRAMES or frames[2] != ZAP_VERSION or frames[7] != b"CURVE":
            return  # libzmq alone can reach this socket, and asks so only for sockets with keys
        envelope, number, address, key = frames[:2], frames[3], frames[5], frames[8]
        name, who = self._admitted.get(z85.encode(key)), address.decode("ascii")
        if name is None:
            self.counters["turned_away"] += 1
            log.warning("turned away %s: its key is not on the list", who)
        else:
            self.counters["admitted"] += 1
            log.info("%s is %s", who, name)
        status = (b"400", b"not on the list") if name is None else (b"200", b"OK")
        user = b"" if name is None else name.encode()
        self._requests.send_multipart([*envelope, ZAP_VERSION, number, *status, user, b""])

    def _note(self, watched: _Watched, event: int, value: int) -> None:
        """`value` is a descriptor where somebody comes or goes."""
        if event == zmq.EVENT_ACCEPTED:
            watched.waiting[value] = None
        elif event in ANSWERED and watched.waiting:
            # The event does not say which handshake has ended: the newest, for a handshake takes
            # no time, and who says nothing has been there for long.
            watched.waiting.popitem()
        elif event == zmq.EVENT_HANDSHAKE_FAILED_PROTOCOL:
            watched.why = WRONG_KEYS
        elif event == zmq.EVENT_DISCONNECTED:
            why, watched.why = watched.why, NO_KEY_SHOWN
            if value in watched.waiting:
                del watched.waiting[value]
                self.counters["turned_away"] += 1
                log.warning(why)

    def unwatch(self) -> None:
        """Watch no socket any more. Call it before they are closed."""
        for watched in self._watched:
            if not watched.listening.closed:
                watched.listening.disable_monitor()
            watched.monitor.close(linger=0)
        self._watched.clear()

    def close(self) -> None:
        """Answer nobody any more."""
        self.unwatch()
        self._requests.close(linger=0)


def _hang_up(descriptor: int) -> bool:
    """End a connection of libzmq's that has not shown a key, as if its peer had."""
    try:
        connection = socket.socket(fileno=descriptor)
    except OSError:  # it has gone meanwhile
        return False
    with contextlib.suppress(OSError):
        about = connection.getsockopt(socket.IPPROTO_TCP, socket.TCP_INFO, TCP_BYTES_RECEIVED.stop)
        if int.from_bytes(about[TCP_BYTES_RECEIVED], sys.byteorder) < SHOWN_BYTES:
            connection.shutdown(socket.SHUT_RDWR)
            connection.detach()
            return True
    connection.detach()
    return False
