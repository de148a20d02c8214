"""Hostile peers: thousands of connections, noise, and floods that obey the protocol."""

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
"""Connections of each kind to each socket in one round."""
OPEN_MAX = 1500
"""Most connections at a time."""
FLOOD_S = 1.5
FLOODERS = 8
KEEPING_RULES_S = 3.0
"""Time for which the loop's cost is measured, without and with a flood of valid messages, s."""
ADDED_MAX_MS = 2.0
"""Processor time that a flood may add to a round of the loop, ms. It adds 0.05 to 0.5, by
the machine; a server in the loop itself took 3.6 to 6.2."""
HEARD_MIN = 0.95
"""Smallest share of the verdicts given that must be received in a flood."""
PATIENCE_MS = 500
"""Time by which the daemon answers a question, ms (`request_ms`)."""
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
"""Socket (0: messages, 1: questions), greeting and messages of peers that obey the protocol:
SUBSCRIBE and CANCEL in turns, two bytes, questions, malformed outcomes."""

Connect = Callable[[], socket.socket]


@dataclass(frozen=True, slots=True)
class Plan:
    """Time, random numbers and folder for one attack."""

    seconds: float
    """Time after which no further round begins, s; there is at least one."""
    random: random.Random
    """Source of all random numbers of the attack."""
    folder: Path
    """Folder for files and sockets; removed afterwards."""

    def rounds(self) -> Iterator[int]:
        """Yield 0, 1, 2 ... until `seconds` are over, at least once."""
        end_s = time.monotonic() + self.seconds
        tried = 0
        while tried == 0 or time.monotonic() < end_s:
            yield tried
            tried += 1

    def folders(self) -> Iterator[Path]:
        """Yield a new folder for each round."""
        for number in self.rounds():
            folder = self.folder / str(number)
            folder.mkdir()
            yield folder


@dataclass(frozen=True, slots=True)
class Outcome:
    """Result of an attack."""

    tried: int
    """Number of connections, bytes or what else the attack counts."""
    happened: str
    """Result in plain words with figures, such as "0 of 995 verdicts `stable`"."""
    held: bool
    """True if graspd did what it must."""


@dataclass(slots=True)
class Hand:
    """A daemon under attack, its endpoints, a subscriber that does no harm (`friend`), and
    the daemon's memory before the attack, MiB."""

    process: Child
    publish: str
    ask: str
    friend: Subscriber
    rest_mib: float

    @property
    def doors(self) -> tuple[Connect, Connect]:
        """Functions that connect to the socket of the messages, and to that of the questions."""
        return partial(connect, self.publish), partial(connect, self.ask)

    def outcome(self, tried: int, well: bool = True, said: str = "") -> Outcome:
        """Return the outcome after an attack; held if `well`, the daemon runs, its messages arrive,
        and its memory grew little. `said`: the attack's own figures, which begin the text."""
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
    """Run a daemon that replays the demo table, without an attack yet.

    On Unix sockets, on TCP if `tcp`, and on TCP with keys if `curve`. `high_water_mark`: most
    messages that wait for a subscriber; None: the daemon's own limit.
    """
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
    """Return a connected, non-blocking socket. Raises `OSError` if refused."""
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
    """Attack by many connections that send nothing, half a greeting, or subscribe and read none."""
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
    """Send random bytes as fast as possible over `FLOODERS` connections; return how many bytes."""
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
    """Attack by peers that send random bytes."""
    sent = 0
    with hand(plan.folder) as daemon:
        for _ in plan.rounds():
            for door in daemon.doors:
                sent += _flood(door, plan.random)
        return daemon.outcome(sent)


def flood(plan: Plan) -> Outcome:
    """Attack by eight peers that send valid messages as fast as possible."""
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
    """Measure the processor time of the loop's thread for each verdict, ms, and the share of the
    verdicts that the friend received; infinite and 0 if one never came."""
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
