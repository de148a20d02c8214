"""What many subscribers, stopped and hostile ones among them, do to the loop's latency.

`python -m tests.bench.subscribers` prints a Markdown table. Each turn is a daemon of its own that
judges every reading of the demo table at 100 Hz; the cases take turns of some seconds, in the same
run. Every subscriber is a socket of its own, in processes apart from the daemon's. The queue per
peer is short, so that the queues of those who are stopped are full for most of a turn.
"""

from __future__ import annotations

import argparse
import contextlib
import itertools
import os
import signal
import socket
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import zmq
from numpy.typing import NDArray

from daemon.publish.messages import Status, Verdict, decode_status, decode_verdict
from drivers.recordings.csv_player import DEMO_TABLE
from tests.bench.live import (
    HEARING,
    PATIENCE_S,
    Child,
    Subscriber,
    start_daemon,
    start_listeners,
    table,
)

WARM_UP_S = 1.0
"""From when all are there to what is counted, s."""
HIGH_WATER_MARK = 100
"""Messages kept per peer: a second of them. What the sockets themselves hold comes on top."""
LISTENERS_PER_PROCESS = 30
FLOOD_TOPICS = 1000
"""Different topics that the flood subscribes to and gives up again: it loads, but does not fill."""
AS_FLOOD = ("-m", "tests.bench.subscribers", "--flood")
AS_GARBAGE = ("-m", "tests.bench.subscribers", "--garbage")
AS_BUSY = ("-m", "tests.bench.subscribers", "--busy")
GREETING = b"\xff" + bytes(8) + b"\x7f"
"""Signature of a ZMTP 3 greeting (RFC 23)."""
SHARES = {"p50": 0.5, "p99": 0.99, "p99.9": 0.999}


@dataclass(frozen=True, slots=True)
class Crowd:
    """Who is there besides the subscriber who measures."""

    listeners: int = 0
    stopped: int = 0
    """Subscribers who were stopped with SIGSTOP once they heard."""
    flood: bool = False
    """One subscribes to topics and gives them up as fast as it can."""
    garbage: bool = False
    """One connects and sends what is no ZMTP, over and over."""
    busy: int = 0
    """Processes that use a processor and do nothing else."""


@dataclass(frozen=True, slots=True)
class Setup:
    """How the daemon is set up."""

    realtime: bool = False
    learns: bool = True
    """Without, what is said of a reading does not depend on those before it."""
    high_water_mark: int = HIGH_WATER_MARK


CASES: dict[str, Crowd] = {
    "1 subscriber": Crowd(),
    "100, ten of them stopped": Crowd(listeners=89, stopped=10),
    "1, and two busy processes": Crowd(busy=2),
    "100, ten stopped, a flood, a malformed one": Crowd(
        listeners=89, stopped=10, flood=True, garbage=True
    ),
}


@dataclass(slots=True)
class Turn:
    """What was heard in a turn."""

    verdicts: list[Verdict] = field(default_factory=list)
    received_ns: list[int] = field(default_factory=list)
    """When each came, monotonic ns."""
    status: Status | None = None
    """The last one."""

    def add(self, payload: bytes, received_ns: int) -> None:
        """Take in a verdict."""
        self.verdicts.append(decode_verdict(payload))
        self.received_ns.append(received_ns)

    @property
    def lost(self) -> int:
        """Messages that did not come."""
        return self.verdicts[-1].seq - self.verdicts[0].seq + 1 - len(self.verdicts)

    def figures(self) -> dict[str, NDArray[np.float64]]:
        """Of each message: latency, age, time since the last, and time to the subscriber, us."""
        rows = [
            (each.latency_us, each.age_ms * 1e3, each.t_mono_ns / 1e3, received / 1e3)
            for each, received in zip(self.verdicts, self.received_ns, strict=True)
        ]
        latency, age, read, received = np.array(rows, dtype=np.float64).T
        return {
            "latency": latency,
            "age": age,
            "between": np.diff(read + age),
            "to the subscriber": received - read,
        }


def scene_text(endpoint: str, setup: Setup) -> str:
    """A scene in which each row of the demo table is judged, for ever."""
    text = (
        f'[tactile]\ndriver = "replay"\nrecordings = ["{DEMO_TABLE}"]\nloop = true\n'
        f'[gate]\nmode = "every"\n[session]\nkeep = false\n'
        f"learn = {'true' if setup.learns else 'false'}\n"
        f'[publish]\nendpoint = "{endpoint}"\nhigh_water_mark = {setup.high_water_mark}\n'
    )
    return text + ("[realtime]\n" if setup.realtime else "")


@contextmanager
def gathered(crowd: Crowd, endpoint: str) -> Iterator[None]:
    """The crowd, from when all of it is there."""
    with ExitStack() as stack:
        sizes = [LISTENERS_PER_PROCESS] * (crowd.listeners // LISTENERS_PER_PROCESS)
        sizes += [crowd.listeners % LISTENERS_PER_PROCESS, crowd.stopped]
        children = [
            stack.enter_context(start_listeners(endpoint, size)) if size else None for size in sizes
        ]
        for child in children:
            if child is not None and child.line().strip() != HEARING:
                raise RuntimeError("a listener hears nothing")
        if (stopped := children[-1]) is not None:
            os.kill(stopped.pid, signal.SIGSTOP)
        if crowd.flood:
            stack.enter_context(Child([*AS_FLOOD, endpoint]))
        if crowd.garbage:
            stack.enter_context(Child([*AS_GARBAGE, endpoint]))
        for _ in range(crowd.busy):
            stack.enter_context(Child(AS_BUSY))
        yield


def take_turn(crowd: Crowd, seconds: float, setup: Setup) -> Turn:
    """Hear a daemon for so long. Raises `RuntimeError` if it, or who is to hear it, is silent."""
    turn = Turn()
    with tempfile.TemporaryDirectory() as folder:
        endpoint = f"ipc://{folder}/graspd"
        scene = Path(folder) / "scene.toml"
        scene.write_text(scene_text(endpoint, setup))
        with (
            start_daemon(scene),
            Subscriber(endpoint, topics=("verdict.", "status.")) as subscriber,
        ):
            if subscriber.take(PATIENCE_S) is None:
                raise RuntimeError("the daemon says nothing")
            with gathered(crowd, endpoint):
                _hear(subscriber, turn, seconds)
    return turn


def _hear(subscriber: Subscriber, turn: Turn, seconds: float) -> None:
    warm_s = time.monotonic() + WARM_UP_S
    while time.monotonic() < warm_s:
        subscriber.take(warm_s - time.monotonic())
    ends_s = time.monotonic() + seconds
    while (left_s := ends_s - time.monotonic()) > 0.0:
        message = subscriber.take(left_s)
        if message is None:
            continue
        topic, payload = message
        if topic.startswith(b"status."):
            turn.status = decode_status(payload)
        else:
            turn.add(payload, subscriber.received_ns)
    if not turn.verdicts:
        raise RuntimeError("the daemon has fallen silent")


def alone(seconds: float, setup: Setup) -> Status:
    """The daemon's own figures of a turn in which nobody listened but for the end."""
    with tempfile.TemporaryDirectory() as folder:
        endpoint = f"ipc://{folder}/graspd"
        scene = Path(folder) / "scene.toml"
        scene.write_text(scene_text(endpoint, setup))
        with start_daemon(scene):
            time.sleep(WARM_UP_S + seconds)
            with Subscriber(endpoint, topics=("status.",)) as subscriber:
                message = subscriber.take(PATIENCE_S)
    if message is None:
        raise RuntimeError("the daemon says nothing")
    return decode_status(message[1])


def flood(endpoint: str) -> None:
    """Subscribe and unsubscribe as fast as the socket takes it, until killed."""
    with zmq.Context() as context, context.socket(zmq.XSUB) as flooding:
        flooding.connect(endpoint)
        for number in itertools.cycle(range(FLOOD_TOPICS)):
            for wanted in (b"\1", b"\0"):
                flooding.send(wanted + b"nothing.%d" % number)


def garbage(endpoint: str) -> None:
    """Connect, send what is no ZMTP, and again, until killed."""
    draw = np.random.default_rng(1)
    for number in itertools.count():
        with (
            contextlib.suppress(OSError),  # the daemon hangs up, as it should
            socket.socket(socket.AF_UNIX) as line,
        ):
            line.connect(endpoint.removeprefix("ipc://"))
            line.sendall((GREETING if number % 2 else b"") + draw.bytes(200))
            line.settimeout(0.01)
            line.recv(1000)


def busy() -> None:
    """Use a processor, until killed."""
    while True:
        pass


HEAD = ("case", "p50", "p99", "p99.9", "max, us", "to 1 subscriber, p99.9", "messages", "lost")


def quantiles(values: Sequence[NDArray[np.float64]]) -> dict[str, float]:
    """By name, us."""
    together = np.concatenate(values)
    found = {name: float(np.quantile(together, share)) for name, share in SHARES.items()}
    return found | {"max": float(together.max())}


def report(found: Mapping[str, Sequence[Turn]]) -> Iterator[str]:
    """A table for each figure."""
    for name in ("latency", "age", "between", "to the subscriber"):
        rows, base = [], 0.0
        for case, turns in found.items():
            values = quantiles([turn.figures()[name] for turn in turns])
            base = base or values["p99.9"]
            lost = sum(turn.lost for turn in turns)
            heard = sum(len(turn.verdicts) for turn in turns)
            change = f"{values['p99.9'] / base - 1:+.0%}"
            rows.append((case, *(f"{value:.0f}" for value in values.values()), change, heard, lost))
        yield f"{name}:\n{table(HEAD, rows)}"


def counters(turns: Sequence[Turn]) -> dict[str, int]:
    """What the daemon counted about its subscribers in the last turn."""
    status = turns[-1].status
    return {} if status is None else status.drivers["publish"]


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(prog="python -m tests.bench.subscribers", description=__doc__)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--seconds", type=float, default=20.0, help="of a turn")
    parser.add_argument("--realtime", action="store_true", help="the daemon has [realtime]")
    for kind in ("flood", "garbage"):
        parser.add_argument(f"--{kind}", metavar="ENDPOINT", help=argparse.SUPPRESS)
    parser.add_argument("--busy", action="store_true", help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.flood or given.garbage or given.busy:
        work = flood if given.flood else garbage
        busy() if given.busy else work(given.flood or given.garbage)
        return
    found: dict[str, list[Turn]] = {name: [] for name in CASES}
    nobody: list[Status] = []
    setup = Setup(realtime=given.realtime)
    for number in range(given.rounds):
        sys.stderr.write(f"round {number + 1}\n")
        nobody.append(alone(given.seconds, setup))
        for name, crowd in CASES.items():
            found[name].append(take_turn(crowd, given.seconds, setup))
    for text in report(found):
        print(text)  # noqa: T201
    for name in ("p50", "p99", "max"):
        middle = float(np.median([status.latency_us[name] for status in nobody]))  # type: ignore[index]
        print(f"latency with nobody, {name}: {middle:.0f} us, median of the turns")  # noqa: T201
    for case, turns in found.items():
        print(f"{case}: {counters(turns)}")  # noqa: T201


if __name__ == "__main__":
    main()
