"""Hostile peers: connections by the thousand, noise, floods that keep every rule."""

from __future__ import annotations

import contextlib
import math
import random
import resource
import socket
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from graspd.daemon.publish.keys import make
from graspd.drivers.recordings.csv_player import DEMO_TABLE
from tests.bench.live import (
    PATIENCE_S,
    Child,
    Subscriber,
    memory_mib,
    peak_mib,
    running,
)
from tests.ports import free_port
from tests.threads import at_work

MEMORY_MAX_MIB = 32.0
"""Largest growth of the daemon's memory, MiB."""
CONNECTIONS = 2500
"""In one round to each socket, of each kind."""
OPEN_MAX = 1500
"""Most connections at a time."""
FLOOD_S = 1.5
FLOODERS = 8
KEEPING_RULES_S = 3.0
"""How long the loop's cost is measured, without and with peers that keep every rule."""
ADDED_MAX_MS = 2.0
"""Processor time that a flood may add to a round of the loop, ms. It adds 0.05 to 0.5, by
the machine; a server in the loop itself took 3.6 to 6.2."""
HEARD_MIN = 0.95
"""Smallest share of the verdicts given that must be received in a flood."""
PATIENCE_MS = 500
"""A question is answered by then."""
GREETING = bytes.fromhex("ff 00 00 00 00 00 00 00 01 7f 03 01 4e 55 4c 4c") + bytes(48)
READY = bytes.fromhex("04 19 05") + b"READY\x0bSocket-Type\x00\x00\x00\x03"
READY_DEALER = bytes.fromhex("04 1c 05") + b"READY\x0bSocket-Type\x00\x00\x00\x06DEALER"
AS_SUB = GREETING + READY + b"SUB"
AS_DEALER = GREETING + READY_DEALER
QUESTION = bytes.fromhex("00 05") + b"judge"
KEEPS_RULES = (
    (0, AS_SUB, bytes.fromhex("00 02 01 78 00 02 00 78") * 300),
    (1, AS_DEALER, bytes.fromhex("00 02 78 78") * 500),
    (1, AS_DEALER, QUESTION * 300),
    (1, AS_DEALER, (bytes.fromhex("00 09") + b"outcome x") * 200),
)
"""Door, greeting and messages of peers that keep every rule: SUBSCRIBE and CANCEL in turns, two
bytes, questions, malformed outcomes."""

Connect = Callable[[], socket.socket]


@dataclass(frozen=True, slots=True)
class Plan:
    """What an attack is given."""

    seconds: float
    """How long it lasts, s; a round that has begun is ended. It does one at least."""
    random: random.Random
    """For all that it draws."""
    folder: Path
    """For its files and sockets; removed afterwards."""

    def rounds(self) -> Iterator[int]:
        """0, 1, 2 ... until the time is over."""
        end_s = time.monotonic() + self.seconds
        tried = 0
        while tried == 0 or time.monotonic() < end_s:
            yield tried
            tried += 1

    def folders(self) -> Iterator[Path]:
        """A new folder for each round."""
        for number in self.rounds():
            folder = self.folder / str(number)
            folder.mkdir()
            yield folder


@dataclass(frozen=True, slots=True)
class Outcome:
    """What came of it."""

    tried: int
    """How often: readings, connections, bytes or what else the attack counts."""
    happened: str
    """Result in plain words with figures, such as "0 of 995 verdicts `stable`"."""
    held: bool
    """Whether graspd did what it must."""


@dataclass(slots=True)
class Hand:
    """A daemon, its doors, and a friend that hears it."""

    process: Child
    publish: str
    ask: str
    friend: Subscriber
    rest_mib: float

    @property
    def doors(self) -> tuple[Connect, Connect]:
        """Connect to the messages, and to the questions."""
        return partial(connect, self.publish), partial(connect, self.ask)

    def outcome(self, tried: int, well: bool = True, said: str = "") -> Outcome:
        """What became of it: whether it lives, its messages arrive, and it has little memory."""
        self.friend.drain()
        grown_mib = peak_mib(self.process.pid) - self.rest_mib
        lives = self.process.poll() is None
        heard = lives and self.friend.take(2.0) is not None
        happened = f"{said}memory {self.rest_mib:.0f} + {grown_mib:.1f} MiB, "
        happened += "the others hear it" if heard else "no subscriber hears it"
        if not lives:
            happened += f", it has ended with {self.process.returncode}"
        return Outcome(tried, happened, well and heard and grown_mib < MEMORY_MAX_MIB)


@contextlib.contextmanager
def hand(
    folder: Path,
    *,
    curve: bool = False,
    tcp: bool = False,
    high_water_mark: int | None = None,
) -> Iterator[Hand]:
    """A daemon at rest: on Unix sockets, or on TCP, with keys; the rest as of `running`."""
    endpoint, questions = f"ipc://{folder}/v", f"ipc://{folder}/ask"
    section, keys = "", None
    if curve:
        make(folder, "daemon")
        make(folder / "clients", "friend")
        section, keys = '[curve]\nsecret_key = "daemon.key_secret"\nclients = "clients"\n', folder
    if curve or tcp:
        endpoint, questions = (f"tcp://127.0.0.1:{port}" for port in (free_port(), free_port()))
    sections = (
        f'[tactile]\ndriver = "replay"\nloop = true\nrecordings = ["{DEMO_TABLE}"]\n'
        f'[gate]\nmode = "every"\nrequest_ms = {PATIENCE_MS}.0\n[model]\nname = "cnn1"\n'
        f'[ask]\nendpoint = "{questions}"\n{section}'
    )
    _, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (hard, hard))
    started = running(
        folder,
        sections,
        high_water_mark=high_water_mark,
        endpoint=endpoint,
        keys=keys,
    )
    with started as (process, friend):
        if friend.take(PATIENCE_S) is None:
            raise TimeoutError("the daemon says nothing")
        for _ in range(100):
            friend.take(1.0)
        yield Hand(process, endpoint, questions, friend, memory_mib(process.pid))


def connect(endpoint: str) -> socket.socket:
    """A connection. Raises `OSError`."""
    scheme, _, where = endpoint.partition("://")
    family = socket.AF_UNIX if scheme == "ipc" else socket.AF_INET
    made = socket.socket(family, socket.SOCK_STREAM)
    try:
        if scheme == "tcp":
            made.settimeout(0.05)
        host, _, port = where.rpartition(":")
        made.connect(where if scheme == "ipc" else (host, int(port)))
    except OSError:
        made.close()
        raise
    made.setblocking(False)
    return made


def connections(plan: Plan) -> Outcome:
    """Many, that say nothing or half of what they must, or are subscribers and do not read."""
    tried = 0
    with hand(plan.folder, curve=True) as daemon:
        for _ in plan.rounds():
            for door in daemon.doors:
                for says in (b"", GREETING[:12], AS_SUB + b"\x00\x01\x01"):
                    tried += _many(door, says)
        return daemon.outcome(tried)


def _many(door: Connect, says: bytes) -> int:
    with contextlib.ExitStack() as stack:
        made = 0
        for attempt in range(CONNECTIONS):
            if attempt % OPEN_MAX == OPEN_MAX - 1:
                stack.close()
            with contextlib.suppress(OSError):
                connection = stack.enter_context(door())
                made += 1
                connection.send(says)
        return made


def _flood(door: Connect, numbers: random.Random) -> int:
    """Send noise as fast as can be, with some connections, for a while; how many bytes it was."""
    sent, until_s = 0, time.monotonic() + FLOOD_S
    left: list[bytes] = [b""] * FLOODERS
    flooders: list[socket.socket | None] = [None] * FLOODERS
    while time.monotonic() < until_s:
        for number, flooder in enumerate(flooders):
            try:
                if flooder is None:
                    flooders[number], left[number] = door(), b""
                    continue
                left[number] = left[number] or numbers.randbytes(numbers.randrange(1, 300))
                size = flooder.send(left[number])
                left[number] = left[number][size:]
                sent += size
            except BlockingIOError:
                pass
            except OSError:
                if flooder is not None:
                    flooder.close()
                flooders[number] = None
    for flooder in flooders:
        if flooder is not None:
            flooder.close()
    return sent


def noises(plan: Plan) -> Outcome:
    """Anything, by many peers."""
    sent = 0
    with hand(plan.folder) as daemon:
        for _ in plan.rounds():
            for door in daemon.doors:
                sent += _flood(door, plan.random)
        return daemon.outcome(sent)


def flood(plan: Plan) -> Outcome:
    """Eight peers that keep every rule, as fast as can be."""
    tried, added_ms, share = 0, 0.0, 1.0
    # As many as the friend takes late; by default ten wait for a subscriber.
    with hand(plan.folder, high_water_mark=1000) as daemon:
        for _ in plan.rounds():
            rest_ms, _ = cost(daemon)
            peers = [
                partial(_keep_rules, daemon.doors[door], first, then)
                for door, first, then in KEEPS_RULES * 2
            ]
            with at_work(*peers):
                time.sleep(1.0)
                busy_ms, heard = cost(daemon)
            added_ms = max(added_ms, busy_ms - rest_ms)
            share = min(share, heard)
            tried += len(peers)
        said = f"{added_ms:.2f} ms more a round, {100 * share:.0f} % of the verdicts heard, "
        return daemon.outcome(tried, added_ms <= ADDED_MAX_MS and share >= HEARD_MIN, said)


def cost(daemon: Hand) -> tuple[float, float]:
    """Processor time of the loop's thread for each verdict, ms, and share of verdicts received."""
    daemon.friend.drain()
    path = Path(f"/proc/{daemon.process.pid}/task/{daemon.process.pid}/schedstat")
    end_s, began_ns = time.monotonic() + KEEPING_RULES_S, int(path.read_text().split()[0])
    heard: list[int] = []
    while time.monotonic() < end_s or len(heard) < 2:
        verdict = daemon.friend.verdict(PATIENCE_S)
        if verdict is None:
            return math.inf, 0.0
        heard.append(verdict.seq)
    took_ns = int(path.read_text().split()[0]) - began_ns
    given = heard[-1] - heard[0] + 1
    return took_ns / 1e6 / given, len(heard) / given


def _keep_rules(door: Connect, first: bytes, then: bytes, stop: threading.Event) -> None:
    with door() as peer:
        peer.setblocking(True)
        peer.sendall(first)
        greeted = b""
        while b"READY" not in greeted:  # a message before the handshake's end breaks a rule
            greeted += peer.recv(1 << 10)
        peer.setblocking(False)
        left = then
        while not stop.is_set():
            try:
                left = left[peer.send(left) :] or then
            except BlockingIOError:
                time.sleep(0.0005)
            with contextlib.suppress(BlockingIOError):
                while peer.recv(1 << 16):
                    pass
