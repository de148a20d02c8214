"""Peers with keys, over TCP: libzmq checks them, encrypts, and reads what they send.

It bounds nobody's unfinished message, and cuts off all peers of a socket or none: so the memory of
the process is watched, and when it grows too much all of them have to connect again.
"""

from __future__ import annotations

import ctypes
import os
import time
from collections import Counter
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from typing import Final

import zmq

from daemon.publish.binding import Door, OwnKeys, Peer, PublishError
from daemon.publish.zmtp import CANCEL, FRAMES_MAX, SUBSCRIBE, Message, Role

REBIND_S, REBIND_STEP_S = 0.5, 0.002
"""How long a closed socket may hold its port, s."""
MESSAGE_MAX_BYTES: Final = 1024
"""The longest message of the handshake, INITIATE, has 257 bytes and metadata (RFC 26)."""
HANDSHAKE_MS: Final = 5000
"""Who connects and says nothing is disconnected after so long: libzmq's 30 s let a few strangers
hold more connections than the process may have."""
HEARTBEAT_MS, HEARTBEAT_TIMEOUT_MS = 1000, 3000
"""Between two signs of life, and when a peer that gives none is gone, ms."""
LINGER_MS: Final = 500
"""How long closing waits for peers to take what is still queued, ms."""
ZAP_DOMAIN: Final = b"graspd"
"""Named in requests to whoever admits peers (RFC 27); libzmq asks nobody for an empty one."""
SUBSCRIBED_MAX: Final = 100
"""Topics that are remembered as wanted; the daemon has five."""
WAITING_MAX: Final = {Role.XPUB: 2, Role.ROUTER: 16}
"""Messages of one peer that wait in the socket; the rest waits in the peer. With four
subscriptions, libzmq can go round in `send` for as long as a peer floods it (measured: over a
second); with two it cannot keep up, and takes some two thousand a second. With one, a peer is never
heard."""
TAKEN_MAX: Final = {Role.XPUB: 256, Role.ROUTER: 64}
"""Messages, and at most so many frames, taken in one round, in half a millisecond."""
GROWTH_MAX_BYTES: Final = 16 << 20
"""So much more memory than at rest may be the peers'."""
LOOK_NS: Final = 2_000_000
"""How often the memory is looked at, at most; it takes 4 us."""
FREED_NS: Final = 50_000_000
"""How long libzmq may take to give back what it held for peers that were cut off."""
PAGE_BYTES: Final = os.sysconf("SC_PAGESIZE")


@dataclass(frozen=True, slots=True)
class CurvePeer:
    """One connection."""

    identity: bytes
    user: str
    """Name of its key."""
    is_open: bool = True
    """libzmq does not say when it goes."""

    def stands_for(self, former: object) -> bool:
        """Whether it has the same key."""
        return isinstance(former, CurvePeer) and self.user == former.user

    def may_follow(self, former: object) -> bool:
        """Whether it stands for the other once that has gone, but not yet: never."""
        return False


EVERYBODY: Final = CurvePeer(b"", "")
"""libzmq does not say who subscribes, and sends to all alike."""


class CurveDoor(Door):
    """Listens, for peers whose keys are admitted. Never blocks."""

    def __init__(self, endpoint: str, role: Role, high_water_mark: int, keys: OwnKeys) -> None:
        """Queue so many messages per peer. Raises `PublishError`."""
        self.counters = Counter()
        self._endpoint, self._role, self._keys = endpoint, role, keys
        self._high_water_mark = high_water_mark
        self._subscribed: set[bytes] = set()
        """What topics that somebody wants begin with."""
        self._frames: Message = []
        """Of the message at hand, as far as it has been read."""
        self._made: zmq.Socket[bytes] | None = None
        self.renew()

    @property
    def socket(self) -> zmq.Socket[bytes]:
        """The socket. Raises `PublishError` if it could not be opened again."""
        if self._made is None:
            raise PublishError(f"{self._endpoint} is closed")
        return self._made

    @property
    def is_open(self) -> bool:
        """False once it is closed, or could not be opened again."""
        return self._made is not None

    def renew(self) -> None:
        """Open the socket, or close all connections and open it again.

        Peers connect again by themselves, as far as they are still admitted. Raises `PublishError`
        if the endpoint cannot be had.
        """
        again = self._made is not None
        if self._made is not None:
            self._made.close(linger=0)
            self._made = None
        self._subscribed.clear()
        self._frames.clear()
        deadline_s = time.monotonic() + REBIND_S
        while True:
            try:
                self._made = self._open()
            except zmq.ZMQError as error:
                # A socket of ours that has just been closed may hold its port for a moment.
                if again and error.errno == zmq.EADDRINUSE and time.monotonic() < deadline_s:
                    time.sleep(REBIND_STEP_S)
                    continue
                raise PublishError(f"cannot bind {self._endpoint}: {error.strerror}") from error
            else:
                return

    def _open(self) -> zmq.Socket[bytes]:
        made = self._keys.context.socket(int(getattr(zmq, self._role.name)))
        try:
            made.linger = LINGER_MS
            made.sndhwm = self._high_water_mark
            made.rcvhwm = WAITING_MAX[self._role]
            if self._role is Role.XPUB:
                made.setsockopt(zmq.XPUB_NODROP, 1)
                # Else only the first who wants a topic is heard of.
                made.setsockopt(zmq.XPUB_VERBOSE, 1)
            made.heartbeat_ivl = HEARTBEAT_MS
            made.heartbeat_timeout = HEARTBEAT_TIMEOUT_MS
            made.curve_publickey, made.curve_secretkey = self._keys.public, self._keys.secret
            made.curve_server = True
            made.zap_domain = ZAP_DOMAIN
            made.maxmsgsize = MESSAGE_MAX_BYTES
            made.ipv6 = "[" in self._endpoint
            made.handshake_ivl = HANDSHAKE_MS
            made.bind(self._endpoint)
        except zmq.ZMQError:
            made.close(linger=0)
            raise
        return made

    def fileno(self) -> int:
        """Of libzmq's own descriptor."""
        return int(self.socket.fileno())

    def receive(self) -> Sequence[tuple[Peer, Message]]:
        """What peers have sent: some of it, so that a flood does not hold up readings."""
        received: list[tuple[Peer, Message]] = []
        if self._made is None:
            return received
        for _ in range(TAKEN_MAX[self._role]):
            if not int(self._made.get(zmq.EVENTS)) & zmq.POLLIN:
                break
            frame = self._made.recv(zmq.NOBLOCK, copy=False)
            if len(self._frames) <= FRAMES_MAX:
                self._frames.append(frame.bytes)
            if not self._made.get(zmq.RCVMORE):
                message, self._frames = self._frames, []
                received.append(self._told(frame, message))
        return received

    def _told(self, frame: zmq.Frame, message: Message) -> tuple[Peer, Message]:
        """Who sent a message, and what without the name of the connection."""
        if self._role is Role.ROUTER:
            return CurvePeer(message[0], str(frame.get("User-Id"))), message[1:]
        topic = message[0][1:]
        if message[0][:1] == CANCEL:
            self._subscribed.discard(topic)
        elif message[0][:1] == SUBSCRIBE and len(self._subscribed) < SUBSCRIBED_MAX:
            self._subscribed.add(topic)
        return EVERYBODY, message

    def send(self, peer: Peer, frames: Sequence[bytes]) -> None:
        """Send to one peer. Whoever is gone, or reads too slowly, misses it."""
        if self._made is not None and isinstance(peer, CurvePeer):
            self._made.send_multipart((peer.identity, *frames), flags=zmq.NOBLOCK)

    def publish(self, topic: bytes, payload: bytes, to: Collection[Peer] | None = None) -> bool:
        """Send to all that want the topic."""
        if self._made is None:
            return True
        try:
            self._made.send_multipart((topic, payload), flags=zmq.NOBLOCK, copy=True)
        except zmq.Again:
            # Some peer's queue is full: drop it for that one, and send it to the others.
            self._made.setsockopt(zmq.XPUB_NODROP, 0)
            self._made.send_multipart((topic, payload), flags=zmq.NOBLOCK, copy=True)
            self._made.setsockopt(zmq.XPUB_NODROP, 1)
            return False
        return True

    def wanted(self, topic: bytes) -> bool:
        """Whether somebody subscribes to a topic, as far as `receive` has seen."""
        return any(topic.startswith(prefix) for prefix in self._subscribed)

    def close(self) -> None:
        """Close the socket; libzmq goes on for a moment to send what is queued."""
        if self._made is not None:
            self._made.close()
            self._made = None


class Guard:
    """Has all peers cut off when what libzmq holds for them has grown too much.

    It takes any growth of the process's memory for theirs, until cutting them off has not helped.
    """

    def __init__(self, cut_off: Callable[[], None]) -> None:
        """`cut_off` closes all connections."""
        self._cut_off = cut_off
        self._statm = os.open("/proc/self/statm", os.O_RDONLY | os.O_CLOEXEC)
        self._rest_bytes = self._resident_bytes()
        self._due_ns = 0
        self._is_cut_off = False

    def look(self, now_ns: int) -> None:
        """Look whether there is too much now."""
        if now_ns < self._due_ns:
            return
        self._due_ns = now_ns + LOOK_NS
        if self._is_cut_off:
            self._is_cut_off = False
            ctypes.CDLL(None).malloc_trim(0)
            resident_bytes = self._resident_bytes()
            if resident_bytes - self._rest_bytes > GROWTH_MAX_BYTES // 2:
                self._rest_bytes = resident_bytes
        elif self._resident_bytes() - self._rest_bytes > GROWTH_MAX_BYTES:
            self._cut_off()
            self._is_cut_off = True
            self._due_ns = now_ns + FREED_NS

    def _resident_bytes(self) -> int:
        return int(os.pread(self._statm, 100, 0).split()[1]) * PAGE_BYTES

    def close(self) -> None:
        """Look no more."""
        os.close(self._statm)
