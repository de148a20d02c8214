"""Who may connect over TCP: peers are asked for keys (ZAP, RFC 27), and refusals are told."""

from __future__ import annotations

import contextlib
import logging
import math
import os
import socket
import sys
import time
from collections import Counter, deque
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

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
ANSWERED_MAX = 256
"""Addresses that were answered and whose handshake has not ended yet; beyond, the log may name
another address of those that are at the door."""
EVENTS = (
    zmq.EVENT_ACCEPTED
    | zmq.EVENT_DISCONNECTED
    | zmq.EVENT_HANDSHAKE_SUCCEEDED
    | zmq.EVENT_HANDSHAKE_FAILED_PROTOCOL
    | zmq.EVENT_HANDSHAKE_FAILED_AUTH
)
KERNEL_PERIOD_S = 1.0
"""The kernel's table may be long: it is read so often at most, s."""
TABLE_MAX_CHARS = 1 << 16
"""Of it so much is read at most, some hundred connections: it takes 0.5 ms."""
TIME_WAIT = "06"
"""State of a connection that this side has closed."""
ANSWERED = (zmq.EVENT_HANDSHAKE_SUCCEEDED, zmq.EVENT_HANDSHAKE_FAILED_AUTH)
"""End a handshake in which we were asked: who it is has been told."""
NO_KEY_SHOWN = "turned away %s: it showed no key, has none, or does not speak ZeroMQ 4"
WRONG_KEYS = "turned away %s: it has no keys, or not the daemon's"
"""Of a handshake that failed without our being asked, which libzmq says right before the connection
goes. Who speaks another protocol, or notices first that the keys do not fit, just goes (4.3.5)."""


@dataclass(slots=True, eq=False)
class _Watched:
    """A listening socket, and who is at its door."""

    listening: zmq.Socket[bytes]
    monitor: zmq.Socket[bytes]
    waiting: dict[int, str | None] = field(default_factory=dict)
    """Connections whose handshake has not ended, oldest first: address by descriptor, None where
    it had gone before anybody looked. No more than the process may have descriptors."""
    why: str = NO_KEY_SHOWN
    """Of the connection that goes next."""


class Gatekeeper:
    """Answers libzmq's questions whether a peer may connect, and watches who does not even ask.

    Must be there before the sockets of its context are bound. Never blocks.
    """

    def __init__(
        self, context: zmq.Context[zmq.Socket[bytes]], admitted: Mapping[bytes, str]
    ) -> None:
        """`admitted` has names by public key, Z85."""
        self.counters = Counter(admitted=0, turned_away=0)
        self._admitted = dict(admitted)
        self._context = context
        self._requests = context.socket(zmq.ROUTER)
        self._requests.linger = 0
        self._requests.bind(ZAP_ENDPOINT)
        self._watched: list[_Watched] = []
        self._answered: deque[str] = deque(maxlen=ANSWERED_MAX)
        """Addresses of those who have shown a key and whose handshake has not ended."""
        self._asked_kernel_s = -math.inf

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
        """Take another list; whether somebody is no longer on it."""
        gone = self._admitted.keys() - admitted.keys()
        self._admitted = dict(admitted)
        return bool(gone)

    def filenos(self) -> list[int]:
        """Become readable when there may be something; call `take` before waiting for them."""
        monitors = (watched.monitor for watched in self._watched)
        return [int(each.fileno()) for each in (self._requests, *monitors)]

    def take(self) -> None:
        """Answer who asks, and see who failed."""
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

    def _answer(self, frames: list[bytes]) -> None:
        if len(frames) != REQUEST_FRAMES or frames[2] != ZAP_VERSION or frames[7] != b"CURVE":
            return  # libzmq alone can reach this socket, and asks so only for sockets with keys
        envelope, number, address, key = frames[:2], frames[3], frames[5], frames[8]
        name, who = self._admitted.get(z85.encode(key)), address.decode("ascii")
        self._answered.append(who)
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
            watched.waiting[value] = peer_of(value)
        elif event in ANSWERED:
            self._let_pass(watched)
        elif event == zmq.EVENT_HANDSHAKE_FAILED_PROTOCOL:
            watched.why = WRONG_KEYS
        elif event == zmq.EVENT_DISCONNECTED:
            why, watched.why = watched.why, NO_KEY_SHOWN
            if value in watched.waiting:
                address = watched.waiting.pop(value)
                self.counters["turned_away"] += 1
                log.warning(why, address or self._who_was_it())

    def _let_pass(self, watched: _Watched) -> None:
        """One handshake has ended. The event does not say which: the newest of an address that was
        answered, for a handshake takes no time, and who says nothing has long been there."""
        known = [each for each, who in watched.waiting.items() if who in self._answered]
        for descriptor in (known or list(watched.waiting))[-1:]:
            address = watched.waiting.pop(descriptor)
            if address is not None and address in self._answered:
                self._answered.remove(address)

    def _who_was_it(self) -> str:
        """A connection may be gone before anybody looks; the kernel remembers it for a minute."""
        now_s = time.monotonic()
        if now_s - self._asked_kernel_s < KERNEL_PERIOD_S:
            return "somebody"
        self._asked_kernel_s = now_s
        ports = {_port(watched.listening) for watched in self._watched}
        return " or ".join(sorted(gone_peers(ports))) or "somebody"

    def unwatch(self) -> None:
        """Watch no socket any more: they are about to be closed."""
        for watched in self._watched:
            if not watched.listening.closed:
                watched.listening.disable_monitor()
            watched.monitor.close(linger=0)
        self._watched.clear()
        self._answered.clear()

    def close(self) -> None:
        """Answer nobody any more."""
        self.unwatch()
        self._requests.close(linger=0)


def peer_of(descriptor: int) -> str | None:
    """Address of a connection that libzmq has; it may have gone already."""
    try:
        ours = os.dup(descriptor)
    except OSError:
        return None
    try:
        connection = socket.socket(fileno=ours)
    except OSError:  # by now another file than a socket has this number
        os.close(ours)
        return None
    with connection, contextlib.suppress(OSError, ValueError):
        host, *_ = connection.getpeername()
        return str(host)
    return None


def _port(listening: zmq.Socket[bytes]) -> int:
    endpoint = listening.last_endpoint
    return int(endpoint.rpartition(b":")[2]) if isinstance(endpoint, bytes) else 0


def gone_peers(ports: set[int]) -> set[str]:
    """Addresses of connections to local TCP ports that were closed lately (proc_pid_net(5))."""
    found = set()
    for table, family in (("tcp", socket.AF_INET), ("tcp6", socket.AF_INET6)):
        try:
            with Path("/proc/net", table).open(encoding="utf-8") as file:
                lines = file.read(TABLE_MAX_CHARS).rpartition("\n")[0].splitlines()[1:]
        except OSError:
            continue
        for line in lines:
            _, local, remote, state, *_ = line.split()
            if state == TIME_WAIT and int(local.rpartition(":")[2], 16) in ports:
                found.add(_address(remote.rpartition(":")[0], family))
    return found


def _address(words: str, family: socket.AddressFamily) -> str:
    """Words of 32 bits, each in the order of the machine's bytes."""
    raw = bytes.fromhex(words)
    if sys.byteorder == "little":
        raw = b"".join(raw[start : start + 4][::-1] for start in range(0, len(raw), 4))
    return socket.inet_ntop(family, raw)
