"""Peers without keys, over Unix sockets and loopback TCP, read by graspd itself.

libzmq counts whole messages, so that one without an end takes all memory; it cannot cut off a
single peer, and aborts the process where a Unix socket has no descriptor left for a new one. Here
every peer has its bounds, who breaks a rule goes alone, and a message is sent without a thread
between.
"""

from __future__ import annotations

import contextlib
import select
import socket
import time
from collections import Counter
from collections.abc import Collection, Sequence
from typing import Final

from daemon.publish.binding import Binding, Door, Peer, PublishError, socket_file
from daemon.publish.peer import SHARE_BYTES, PlainPeer
from daemon.publish.socket_file import BACKLOG, SocketFile
from daemon.publish.zmtp import (
    GREETING,
    MORE,
    Message,
    Role,
    ZmtpError,
    frame,
    message,
)

PEERS_MAX: Final = 256
"""Connections at a time."""
HANDSHAKE_NS: Final = 5_000_000_000
"""Who has not said what it is by then is cut off."""
EVENTS_MAX: Final = 8
"""Peers that are looked at in one round, in turns: a flood must not hold up readings."""
ACCEPTED_MAX: Final = 16
"""Connections accepted in one round."""
READ_BYTES: Final = 512
"""Taken of one peer in one round."""
SHARE_NS: Final = 100_000_000
"""How often each peer has its share of bytes anew."""
REST_NS: Final = 100_000_000
"""How long nobody is accepted after the process had no descriptor for somebody."""
SEND_BUFFER_BYTES: Final = 32 * 1024
RECEIVE_BUFFER_BYTES: Final = 8 * 1024
"""Held by the kernel for each peer, which counts as the daemon's memory; it doubles them."""
LINGER_S: Final = 0.5
"""How long closing waits for peers to take what is queued, s."""
_READ, _WRITE = select.EPOLLIN, select.EPOLLOUT


class PlainDoor(Door):
    """Listens, and holds every peer to its bounds; never blocks."""

    def __init__(self, endpoint: str, role: Role, high_water_mark: int, binding: Binding) -> None:
        """Queue so many messages per peer. Raises `PublishError`."""
        self.counters = Counter()
        """`cut_off`: peers that broke a rule or said nothing for too long; `crowded_out`: for which
        there was no place."""
        self._role = role
        self._high_water_mark = high_water_mark
        self._peers: dict[int, PlainPeer] = {}
        """By descriptor."""
        self._strangers: dict[int, PlainPeer] = {}
        """Those whose handshake has not ended, oldest first."""
        self._waiting: list[PlainPeer] = []
        """Those that have had their share."""
        self._share_due_ns = self._listen_due_ns = 0
        self._audience: dict[bytes, tuple[PlainPeer, ...]] = {}
        """Who wants a topic, as far as that was looked up."""
        self._file: SocketFile | None = socket_file(endpoint, binding)
        try:
            self._listener = _listener(endpoint) if self._file is None else self._file.listener
            self._epoll = select.epoll()
        except OSError as error:
            if self._file is not None:
                self._file.close()
            raise PublishError(f"cannot bind {endpoint}: {error.strerror or error}") from error
        self._listening = self._listener.fileno()
        self._epoll.register(self._listening, _READ)

    @property
    def is_open(self) -> bool:
        """False once it is closed."""
        return not self._epoll.closed

    def fileno(self) -> int:
        """Of the descriptor that waits for all the others."""
        return self._epoll.fileno()

    def receive(self) -> Sequence[tuple[Peer, Message]]:
        """What peers have sent: some of it, so that a flood does not hold up readings."""
        if self._epoll.closed:
            return ()
        if self._strangers or self._waiting or self._listen_due_ns:
            self._see_to_time(time.monotonic_ns())
        received: list[tuple[Peer, Message]] = []
        for descriptor, events in self._epoll.poll(0, EVENTS_MAX):
            if descriptor == self._listening:
                self._accept()
                continue
            peer = self._peers.get(descriptor)
            if peer is None:  # it had to make place a moment ago
                continue
            if events & _WRITE:
                self._flush(peer)
            if events & ~_WRITE:
                received += [(peer, each) for each in self._read(peer)]
        return received

    def _see_to_time(self, now_ns: int) -> None:
        for peer in list(self._strangers.values()):
            if now_ns - peer.since_ns < HANDSHAKE_NS:
                break
            self._cut_off(peer)
        if self._waiting and now_ns >= self._share_due_ns:
            waiting, self._waiting = self._waiting, []
            for peer in waiting:
                self._want(peer, peer.events | _READ)
        if self._listen_due_ns and now_ns >= self._listen_due_ns:
            self._listen_due_ns = 0
            self._epoll.modify(self._listening, _READ)

    def _accept(self) -> None:
        for _ in range(ACCEPTED_MAX):
            try:
                connection, _ = self._listener.accept()
            except BlockingIOError:
                return
            except OSError as error:
                if isinstance(error, ConnectionError):  # it has gone already
                    continue
                self._epoll.modify(self._listening, 0)
                self._listen_due_ns = time.monotonic_ns() + REST_NS
                return
            peer = PlainPeer(connection, self._role, time.monotonic_ns())
            if len(self._peers) >= PEERS_MAX:
                self.counters["crowded_out"] += 1
                leaving = self._who_makes_place_for(peer)
                if leaving is None:
                    connection.close()
                    continue
                self._close(leaving)
            self._greet(peer, connection)

    def _who_makes_place_for(self, peer: PlainPeer) -> PlainPeer | None:
        """Of the process that has far more than this peer's: its oldest stranger, or its
        newest peer; else the oldest stranger of anybody."""
        number = Counter(each.process for each in self._peers.values())
        process, most = number.most_common(1)[0]
        crowd = most > number[peer.process] + 1
        for stranger in self._strangers.values():
            if not crowd or stranger.process == process:
                return stranger
        if not crowd:
            return None
        return next(each for each in reversed(self._peers.values()) if each.process == process)

    def _greet(self, peer: PlainPeer, connection: socket.socket) -> None:
        connection.setblocking(False)
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, SEND_BUFFER_BYTES)
        if connection.family != socket.AF_UNIX:
            connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        descriptor = connection.fileno()
        self._peers[descriptor] = self._strangers[descriptor] = peer
        self._epoll.register(descriptor, _READ)
        self._write(peer, GREETING)

    def _read(self, peer: PlainPeer) -> list[Message]:
        connection = peer.socket
        if connection is None:
            return []
        try:
            data = connection.recv(READ_BYTES)
        except BlockingIOError:
            return []
        except OSError:
            data = b""
        if not data:
            self._close(peer)
            return []
        self._account(peer, len(data))
        messages: list[Message] = []
        try:
            answers = peer.parser.take(data, messages)
            if self._role is Role.XPUB and peer.subscribe(messages):
                self._audience.clear()
        except ZmtpError:
            self._cut_off(peer)
            return messages
        if peer.parser.is_ready and self._strangers:
            self._strangers.pop(connection.fileno(), None)
        if answers and not peer.queue:
            self._write(peer, answers)
        return messages

    def _account(self, peer: PlainPeer, size: int) -> None:
        """Have a peer wait that has had its share."""
        now_ns = time.monotonic_ns()
        if now_ns >= self._share_due_ns:
            self._share_due_ns = now_ns + SHARE_NS
            for each in self._peers.values():
                each.share = SHARE_BYTES
        peer.share -= size
        if peer.share <= 0 and peer.events & _READ:
            self._want(peer, peer.events & ~_READ)
            self._waiting.append(peer)

    def _want(self, peer: PlainPeer, events: int) -> None:
        peer.events = events
        if peer.socket is not None:
            self._epoll.modify(peer.socket.fileno(), events)

    def send(self, peer: Peer, frames: Sequence[bytes]) -> None:
        """Send to one peer. Whoever is gone, or reads too slowly, misses it."""
        if isinstance(peer, PlainPeer):
            self._write(peer, message(frames))

    def publish(self, topic: bytes, payload: bytes, to: Collection[Peer] | None = None) -> bool:
        """Send to all that want the topic, or to those named in `to` alone."""
        audience = self._who_wants(topic)
        if not audience:
            return True
        data = frame(topic, MORE) + frame(payload)
        taken = True
        for peer in audience:
            if to is None or peer in to:
                taken &= self._write(peer, data)
        return taken

    def wanted(self, topic: bytes) -> bool:
        """Whether somebody subscribes to a topic, as far as `receive` has seen."""
        return bool(self._who_wants(topic))

    def _who_wants(self, topic: bytes) -> tuple[PlainPeer, ...]:
        audience = self._audience.get(topic)
        if audience is None:
            audience = tuple(
                peer
                for peer in self._peers.values()
                if any(topic.startswith(prefix) for prefix in peer.subscriptions)
            )
            self._audience[topic] = audience
        return audience

    def _write(self, peer: PlainPeer, data: bytes) -> bool:
        """Send or queue; False if the queue is full, so that the oldest message is given up.

        So what slow peers have not read is the same for all of them, and held once. The one that
        may have been sent in part stays.
        """
        if peer.socket is None:
            return True
        if peer.queue:
            is_full = len(peer.queue) > self._high_water_mark
            if is_full:
                del peer.queue[1]
            peer.queue.append(data)
            return not is_full
        try:
            sent = peer.socket.send(data)
        except BlockingIOError:
            sent = 0
        except OSError:
            self._close(peer)
            return True
        if sent < len(data):
            peer.queue.append(data[sent:])
            self._want(peer, peer.events | _WRITE)
        return True

    def _flush(self, peer: PlainPeer) -> None:
        """Send what is queued, as far as the kernel takes it."""
        while peer.queue and peer.socket is not None:
            try:
                sent = peer.socket.send(peer.queue[0])
            except BlockingIOError:
                return
            except OSError:
                self._close(peer)
                return
            if sent < len(peer.queue[0]):
                peer.queue[0] = peer.queue[0][sent:]
                return
            peer.queue.popleft()
        self._want(peer, peer.events & ~_WRITE)

    def _cut_off(self, peer: PlainPeer) -> None:
        self.counters["cut_off"] += 1
        self._close(peer)

    def _close(self, peer: PlainPeer) -> None:
        if peer.socket is None:
            return
        descriptor = peer.socket.fileno()
        self._epoll.unregister(descriptor)
        self._peers.pop(descriptor)
        self._strangers.pop(descriptor, None)
        peer.socket.close()
        peer.socket = None
        peer.queue.clear()
        if peer.subscriptions:
            self._audience.clear()

    def close(self) -> None:
        """Close all connections once what waits is sent, for half a second at most."""
        if not self.is_open:
            return
        until_s = time.monotonic() + LINGER_S
        self._epoll.modify(self._listening, 0)
        for peer in self._peers.values():
            self._want(peer, peer.events & ~_READ)
        while (left_s := until_s - time.monotonic()) > 0 and any(
            peer.queue for peer in self._peers.values()
        ):
            for descriptor, events in self._epoll.poll(left_s, EVENTS_MAX):
                peer = self._peers[descriptor]
                if events & ~_WRITE:
                    self._close(peer)
                else:
                    self._flush(peer)
        for peer in list(self._peers.values()):
            self._close(peer)
        self._epoll.close()
        self._listener.close()
        if self._file is not None:
            self._file.close()


def _listener(endpoint: str) -> socket.socket:
    """Bound to TCP. Raises `OSError`."""
    host, _, port = endpoint.removeprefix("tcp://").rpartition(":")
    family = socket.AF_INET6 if host.startswith("[") else socket.AF_INET
    with contextlib.ExitStack() as stack:
        listener = stack.enter_context(socket.socket(family, socket.SOCK_STREAM))
        listener.setblocking(False)
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        # Before it listens: connections inherit it, and the window is made by it.
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, RECEIVE_BUFFER_BYTES)
        listener.bind((host.strip("[]"), int(port)))
        listener.listen(BACKLOG)
        stack.pop_all()
    return listener
