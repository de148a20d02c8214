"""Peers that fill a queue, send a heartbeat and hang up, whereupon libzmq 4.3.5 aborts."""

from __future__ import annotations

import contextlib
import time
from pathlib import Path

import zmq

from graspd.daemon.publish.keys import load_pair
from tests.bench.attacks.doors import (
    AS_DEALER,
    AS_SUB,
    GREETING,
    Connect,
    Hand,
    Outcome,
    Plan,
    hand,
)

PING = bytes.fromhex("04 07 04") + b"PING" + bytes(2)
SUBSCRIPTIONS = b"".join(bytes([0, 2, 1, 97 + number]) for number in range(12))
HANG_UPS = (
    (b"", b"", PING),
    (GREETING[:12], b"", PING),
    (GREETING, b"\x04", PING),
    (AS_SUB, b"READY", PING),
    (AS_SUB, b"READY", SUBSCRIPTIONS + PING),
    (AS_SUB, b"READY", SUBSCRIPTIONS * 50 + PING),
    (AS_DEALER, b"READY", (b"\0\5clock") * 40 + PING),
    (AS_DEALER, b"READY", (b"\0\5clock") * 40 + PING * 20),
)
"""Bytes that a peer sends, that it waits for, and that it sends before it hangs up."""
HANG_UPS_AT_ONCE, WITH_KEYS = 50, 20
"""Peers of each kind, without keys and with keys."""
MADE_MIN = 0.8
"""Smallest rate of verdicts during the attack, as a share of that at rest: restarts cost some."""
FILLING = 300
"""Subscriptions or questions of a peer with keys: more than the queue takes."""
REST_S = 2.0
RESTART_S = 3.0
"""Longest restart of the daemon's process that runs libzmq, s."""


def hang_ups(plan: Plan) -> Outcome:
    """Attack by peers that fill a queue, send a heartbeat and hang up, in all handshake states."""
    tried, ends, share = 0, 0, 1.0
    for folder in plan.folders():
        for number, (tcp, keyed) in enumerate(((False, False), (True, False), (True, True))):
            place = folder / str(number)
            place.mkdir()
            with hand(place, curve=keyed, tcp=tcp) as daemon:
                rest_hz = _made_hz(daemon, REST_S)
                first, began_s = daemon.friend.wait_for(lambda _: True), time.monotonic()
                for door in daemon.doors:
                    for says in HANG_UPS:
                        tried += hang_up(door, *says)
                if keyed:
                    tried += _hang_up_with_keys(daemon.publish, zmq.SUB, place)
                    tried += _hang_up_with_keys(daemon.ask, zmq.DEALER, place)
                time.sleep(RESTART_S)
                daemon.friend.drain()
                last = daemon.friend.wait_for(lambda _: True)
                took_s = time.monotonic() - began_s
                share = min(share, (last.seq - first.seq) / took_s / rest_hz)
                outcome = daemon.outcome(tried)
                ends += (place / "log").read_text().count("process has ended")
                if not outcome.held:
                    return outcome
    said = f"{ends} ends of libzmq's process, {100 * share:.0f} % of the verdicts made, "
    return Outcome(tried, said + "the daemon continues and others receive again", share >= MADE_MIN)


def _made_hz(daemon: Hand, seconds: float) -> float:
    """Return the rate at which the daemon makes verdicts, 1/s, by their `seq` over `seconds`."""
    daemon.friend.drain()
    first, began_s = daemon.friend.wait_for(lambda _: True), time.monotonic()
    time.sleep(seconds)
    daemon.friend.drain()
    last = daemon.friend.wait_for(lambda _: True)
    return (last.seq - first.seq) / (time.monotonic() - began_s)


def hang_up(door: Connect, first: bytes, awaited: bytes, then: bytes) -> int:
    """Have `HANG_UPS_AT_ONCE` peers send `first`, wait for `awaited`, send `then` and hang up.

    Return the number of those that sent all.
    """
    with contextlib.ExitStack() as stack:
        peers = []
        for _ in range(HANG_UPS_AT_ONCE):
            with contextlib.suppress(OSError):
                peers.append(stack.enter_context(door()))
                peers[-1].settimeout(2.0)
                peers[-1].sendall(first)
        said = 0
        for peer in peers:
            with contextlib.suppress(OSError):
                greeted = b""
                while awaited not in greeted:
                    more = peer.recv(1 << 10)
                    if not more:
                        raise ConnectionResetError
                    greeted += more
                peer.sendall(then)
                said += 1
        return said


def _hang_up_with_keys(endpoint: str, kind: int, folder: Path) -> int:
    """Fill queues and hang up as `WITH_KEYS` peers with keys, of socket type `kind`; return their
    number. libzmq sends their heartbeats. `folder`: of the keys."""
    own, server = load_pair(folder / "clients" / "friend.key_secret"), folder / "daemon.key_secret"
    with zmq.Context() as context:
        for _ in range(WITH_KEYS):
            with context.socket(kind) as peer:
                peer.linger = 0
                peer.heartbeat_ivl = 1
                peer.curve_publickey, peer.curve_secretkey = own
                peer.curve_serverkey = load_pair(server)[0]
                if kind == zmq.SUB:
                    for number in range(FILLING):
                        peer.subscribe(b"%d" % number)
                    peer.subscribe("verdict.")
                peer.connect(endpoint)
                if kind == zmq.DEALER:
                    for _ in range(FILLING):
                        peer.send(b"clock")
                peer.poll(1000)
    return WITH_KEYS
