"""What several hands on one computer cost, and several subscribers to one.

`python -m tests.bench.hands` prints a Markdown table: 1, 2, 4 and 8 daemons, each with a twin at
100 Hz, then one daemon with 1, 10 and 100 subscribers. A question is asked for every reading, so
that each is judged; the latency, of those that were, is from just before the system call that
writes the last byte to a subscriber in another process.
"""

from __future__ import annotations

import argparse
import os
import struct
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import Self

import numpy as np
import zmq
from numpy.typing import NDArray

from daemon.publish.messages import decode_verdict
from models import zoo
from tests.bench.live import (
    PATIENCE_S,
    Child,
    Kind,
    Subscriber,
    TwinPlan,
    Usage,
    end_children_at_sigterm,
    new_tally,
    start_daemon,
    start_listeners,
    start_twin,
    table,
    tactile_section,
    usage,
    where_of,
)

PERIOD_S = 0.01
PRIORITY = 50
"""Of SCHED_FIFO with `[realtime]`: its default."""
WARM_UP_S = 1.0
"""From the first verdict: what comes before is not counted."""
KNOWN_MIN_SHARE = 0.95
"""Just after a link has come up, times of readings are cautious."""
JUDGED_MIN_SHARE = 0.8
"""The network must judge most readings, or the CPU's share is of something else. In 3 % of them a
hand that holds is said to move, and some questions come late."""

ECHO = struct.Struct("<qq")
"""What an echo begins with: the number of the sweep, and when it was sent, monotonic ns."""
Micros = NDArray[np.float64]


@dataclass(slots=True)
class Record:
    """Messages of one publisher about readings, in order: monotonic times, ns."""

    told_ns: list[int] = field(default_factory=list)
    """The reading's `t_mono_ns`."""
    published_ns: list[int] = field(default_factory=list)
    received_ns: list[int] = field(default_factory=list)
    numbers: list[int] = field(default_factory=list)
    """Of the sweeps, where an echo tells them."""
    judged: int = 0
    """Those that the network judged."""
    readings: int = 0
    reasons: Counter[str] = field(default_factory=Counter)
    """Why the others are not."""

    def add(self, payload: bytes, received_ns: int, *, settled: bool) -> None:
        """Take in a verdict that the network was asked for, or with `settled` any.

        One that says that nothing came is none of a reading.
        """
        verdict = decode_verdict(payload)
        if verdict.still_ms is None:
            return
        self.readings += 1
        self.reasons.update(verdict.reasons)
        self.judged += verdict.judged
        if verdict.judged or settled:
            published_ns = verdict.t_mono_ns + round(verdict.age_ms * 1e6)
            self._note(verdict.t_mono_ns, published_ns, received_ns)

    def add_echo(self, payload: bytes, received_ns: int) -> None:
        """Take in a message of the echo."""
        number, sent_ns = ECHO.unpack_from(payload)
        self.numbers.append(number)
        self._note(sent_ns, sent_ns, received_ns)
        self.judged += 1
        self.readings += 1

    def _note(self, told_ns: int, published_ns: int, received_ns: int) -> None:
        self.told_ns.append(told_ns)
        self.published_ns.append(published_ns)
        self.received_ns.append(received_ns)

    def clear(self) -> None:
        """Forget what came so far."""
        for times in (self.told_ns, self.published_ns, self.received_ns, self.numbers):
            times.clear()
        self.judged = self.readings = 0
        self.reasons.clear()


def matched(
    record: Record, stamps_ns: NDArray[np.int64]
) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Which messages are about which sweeps: indices of both, without those that nobody knows.

    A reading's time is known better than to half a period. Raises `RuntimeError` if too few are.
    """
    if record.numbers:
        return np.arange(len(record.numbers)), np.array(record.numbers)
    told, ends = np.array(record.told_ns), stamps_ns[:, 0]
    after = np.searchsorted(ends, told).clip(1, len(ends) - 1)
    nearest = np.where(ends[after] - told < told - ends[after - 1], after, after - 1)
    (known,) = np.nonzero(np.abs(ends[nearest] - told) < PERIOD_S / 2 * 1e9)
    if len(known) < KNOWN_MIN_SHARE * len(told):
        raise RuntimeError(f"{len(known)} of {len(told)} messages are about a known sweep")
    return known, nearest[known]


def percentiles(values: Sequence[Micros]) -> dict[str, float]:
    """p50, p99, p99.9 and the maximum."""
    all_of_them = np.concatenate(values)
    shares = {"p50": 0.5, "p99": 0.99, "p99.9": 0.999, "max": 1.0}
    return {n: round(float(np.quantile(all_of_them, share)), 1) for n, share in shares.items()}


def scene_text(
    tactile: str, endpoint: str, model: str, hand: str, *, realtime: bool, settled: bool
) -> str:
    """A scene that keeps nothing and judges what has settled, as by default, or when asked."""
    text = (
        f'{tactile}[hand]\nname = "{hand}"\n[model]\nname = "{model}"\n'
        f'[session]\nkeep = false\n[publish]\nendpoint = "{endpoint}"\n'
    )
    text += "" if settled else f'[gate]\nmode = "request"\n[ask]\nendpoint = "{endpoint}.ask"\n'
    return text + (f"[realtime]\npriority = {PRIORITY}\n" if realtime else "")


def promote(pid: int, priority: int) -> None:
    """Run all threads of a process in realtime, or with 0 no more. Raises `PermissionError`."""
    policy = os.SCHED_FIFO if priority else os.SCHED_OTHER
    for thread in os.listdir(f"/proc/{pid}/task"):
        os.sched_setscheduler(int(thread), policy, os.sched_param(priority))


class Hand:
    """One publisher, daemon or echo, and its twin."""

    def __init__(
        self,
        folder: Path,
        kind: Kind,
        name: str = "right",
        *,
        ends: int = 0,
        settled: bool = False,
    ) -> None:
        """`ends`: priority in realtime of the twin; 0 for none. `settled`: whole grasps, each of
        which is judged once it has settled, and not each reading of one that lasts, as `ask`ed."""
        self.folder = folder / name
        self.folder.mkdir()
        self.log = self.folder / "log"
        self.name = name
        self.where = where_of(kind, self.folder)
        self.endpoint = f"ipc://{self.folder}/graspd"
        self.kind = kind
        self.record = Record()
        self.settled = settled
        self._ends = ends
        self._stack = ExitStack()
        self._asker: zmq.Socket[bytes] | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_details: object) -> None:
        self._stack.close()

    def start_daemon(self, model: str, *, realtime: bool = False) -> None:
        """Publish verdicts of this model."""
        scene = self.folder / "scene.toml"
        tactile = tactile_section(self.kind, self.where)
        text = scene_text(
            tactile, self.endpoint, model, self.name, realtime=realtime, settled=self.settled
        )
        scene.write_text(text)
        if not self.settled:
            context = self._stack.enter_context(zmq.Context())
            self._asker = self._stack.enter_context(context.socket(zmq.DEALER))
            self._asker.linger = 0
            self._asker.connect(f"{self.endpoint}.ask")
        self.publish(start_daemon(scene, self.log))

    def ask(self) -> None:
        """Have the next reading judged."""
        if self._asker is not None:
            while self._asker.poll(0):
                self._asker.recv()
            self._asker.send(b"judge")

    def publish(self, publisher: Child) -> None:
        """Start what publishes at `endpoint`, and its twin.

        Raises `RuntimeError` if it does not begin to publish.
        """
        self.publisher = self._stack.enter_context(publisher)
        socket_path = Path(self.endpoint.removeprefix("ipc://"))
        deadline_s = time.monotonic() + PATIENCE_S
        while not socket_path.exists():
            if time.monotonic() > deadline_s or self.publisher.process.poll() is not None:
                raise RuntimeError(f"nobody publishes: {self.log.read_text()}")
            time.sleep(PERIOD_S)
        new_tally(self.folder / "tally")
        plan = TwinPlan(
            kind=self.kind,
            where=self.where,
            tally=str(self.folder / "tally"),
            held=not self.settled,
            stamps=str(self.folder / "stamps.npy"),
        )
        self._twin = self._stack.enter_context(start_twin(plan))
        if self._ends:
            promote(self._twin.pid, self._ends)

    def stop(self) -> NDArray[np.int64]:
        """End twin and publisher; the `Stamp` of each sweep, shape (sweeps, 3), ns."""
        self._twin.terminate()
        self.publisher.kill()
        stamps_ns: NDArray[np.int64] = np.load(self.folder / "stamps.npy")
        return stamps_ns


def hear(
    subscriber: Subscriber, hands: Mapping[bytes, Hand], seconds: float, *, echo: bool = False
) -> None:
    """Take in what the hands publish, by topic, for so long."""
    until_s = time.monotonic() + seconds
    while (left_s := until_s - time.monotonic()) > 0:
        message = subscriber.take(left_s)
        if message is not None:
            hand = hands[message[0]]
            if echo:
                hand.record.add_echo(message[1], subscriber.received_ns)
            else:
                hand.record.add(message[1], subscriber.received_ns, settled=hand.settled)
                hand.ask()


def measure(
    hands: Sequence[Hand], seconds: float, *, ends: int = 0, echo: bool = False
) -> list[float]:
    """Fill the hands' records for so long; share of a core that each publisher used, %.

    Raises `RuntimeError` if not all that was to be judged was.
    """
    by_topic = {f"verdict.{hand.name}".encode(): hand for hand in hands}
    with Subscriber(*(hand.endpoint for hand in hands)) as subscriber:
        deadline_s = time.monotonic() + PATIENCE_S
        while any(not hand.record.judged for hand in hands) and time.monotonic() < deadline_s:
            hear(subscriber, by_topic, WARM_UP_S, echo=echo)
        hear(subscriber, by_topic, WARM_UP_S, echo=echo)
        for hand in hands:
            hand.record.clear()
        before = [usage(hand.publisher.pid) for hand in hands]
        promote(os.getpid(), ends)
        hear(subscriber, by_topic, seconds, echo=echo)
        promote(os.getpid(), 0)
        after = [usage(hand.publisher.pid) for hand in hands]
    for hand in hands:
        judged, readings = hand.record.judged, hand.record.readings
        if not judged or (judged < JUDGED_MIN_SHARE * readings and not hand.settled):
            why = dict(hand.record.reasons)
            raise RuntimeError(f"{judged} of {readings} readings were judged; others: {why}")
    return [100 * (b.cpu_s - a.cpu_s) / (b.t_s - a.t_s) for a, b in zip(before, after, strict=True)]


def measured(
    hands: Sequence[Hand], seconds: float
) -> tuple[list[float], list[Usage], list[Micros]]:
    """Share of a core, %, and use of each daemon, and latencies, us; ends the hands."""
    shares = measure(hands, seconds)
    used = [usage(hand.publisher.pid) for hand in hands]
    took_us = []
    for hand in hands:
        stamps_ns = hand.stop()
        record = hand.record
        known, sweeps = matched(record, stamps_ns)
        took_us.append((np.array(record.received_ns)[known] - stamps_ns[sweeps, 1]) / 1e3)
    return shares, used, took_us


def row(name: str, hands: Sequence[Hand], seconds: float) -> list[str]:
    """A row of the table; ends the hands."""
    shares, used, took_us = measured(hands, seconds)
    us = percentiles(took_us)
    return [
        name,
        f"{np.mean(shares):.1f}",
        f"{sum(shares):.1f}",
        f"{np.mean([one.rss_kib for one in used]) / 1024:.0f}",
        f"{sum(one.pss_kib for one in used) / 1024:.0f}",
        f"{us['p50']:.0f}",
        f"{us['p99']:.0f}",
    ]


def with_daemons(number: int, model: str, kind: Kind, seconds: float) -> list[str]:
    """So many hands, one subscriber to all of them."""
    with tempfile.TemporaryDirectory() as folder, ExitStack() as stack:
        hands = [stack.enter_context(Hand(Path(folder), kind, f"h{n}")) for n in range(number)]
        for hand in hands:
            hand.start_daemon(model)
        return row(f"{number} daemons", hands, seconds)


def with_subscribers(number: int, model: str, kind: Kind, seconds: float) -> list[str]:
    """One hand, so many subscribers; one of them is timed, the others share a process."""
    with tempfile.TemporaryDirectory() as folder, ExitStack() as stack:
        hand = stack.enter_context(Hand(Path(folder), kind))
        hand.start_daemon(model)
        if number > 1:
            stack.enter_context(start_listeners(hand.endpoint, number - 1)).line()
        return row(f"{number} subscribers", [hand], seconds)


HEAD = (
    "",
    "CPU of each, % of a core",
    "of all",
    "RSS of each, MiB",
    "PSS of all",
    "to a subscriber p50, us",
    "p99",
)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(prog="python -m tests.bench.hands", description=__doc__)
    parser.add_argument("--seconds", type=float, default=20.0, help="of each row")
    parser.add_argument("--model", default="small-session", choices=zoo.names())
    parser.add_argument("--link", choices=("spi", "can"), default="spi")
    parser.add_argument("--daemons", nargs="*", type=int, default=(1, 2, 4, 8))
    parser.add_argument("--subscribers", nargs="*", type=int, default=(1, 10, 100))
    given = parser.parse_args()
    end_children_at_sigterm()
    rows = [with_daemons(n, given.model, given.link, given.seconds) for n in given.daemons]
    rows += [with_subscribers(n, given.model, given.link, given.seconds) for n in given.subscribers]
    sys.stdout.write(table(HEAD, rows))


if __name__ == "__main__":
    main()
