"""A hand whose latency is measured: a daemon or an echo, its twin, and what a subscriber hears.

A question is asked for every reading, so that each is judged. The latency is from just before the
system call that writes the last byte to a subscriber in another process.
"""

from __future__ import annotations

import os
import struct
import time
from collections import Counter
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import Self

import numpy as np
import zmq
from numpy.typing import NDArray

from tests.bench.live import (
    PATIENCE_S,
    Child,
    Subscriber,
    TwinPlan,
    new_tally,
    start_daemon,
    start_twin,
    tactile_section,
    usage,
    where_of,
)
from tests.kit.messages import decode_verdict

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


def scene_text(tactile: str, endpoint: str, model: str, *, realtime: bool, settled: bool) -> str:
    """A scene that keeps nothing and judges what has settled, as by default, or when asked."""
    text = (
        f'{tactile}[hand]\nname = "right"\n[model]\nname = "{model}"\n'
        f'[session]\nkeep = false\n[publish]\nendpoint = "{endpoint}"\n'
    )
    text += "" if settled else f'[gate]\nmode = "request"\n[ask]\nendpoint = "{endpoint}.ask"\n'
    return text + (f"[realtime]\npriority = {PRIORITY}\n" if realtime else "")


def promote(pid: int, priority: int) -> None:
    """Run all threads of a process in realtime. Raises `PermissionError`."""
    for thread in os.listdir(f"/proc/{pid}/task"):
        os.sched_setscheduler(int(thread), os.SCHED_FIFO, os.sched_param(priority))


class Hand:
    """One publisher, daemon or echo, and its twin."""

    def __init__(self, folder: Path, *, settled: bool = False) -> None:
        """With `settled` whole grasps, each judged once it has settled; else a grasp that lasts,
        each reading of which is `ask`ed for."""
        self.folder = folder
        self.log = folder / "log"
        self.where = where_of("spi", folder)
        self.endpoint = f"ipc://{self.folder}/graspd"
        self.record = Record()
        self.settled = settled
        self._stack = ExitStack()
        self._asker: zmq.Socket[bytes] | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_details: object) -> None:
        self._stack.close()

    def start_daemon(self, model: str, *, realtime: bool = False) -> None:
        """Publish verdicts of this model."""
        scene = self.folder / "scene.toml"
        tactile = tactile_section("spi", self.where)
        text = scene_text(tactile, self.endpoint, model, realtime=realtime, settled=self.settled)
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
            kind="spi",
            where=self.where,
            tally=str(self.folder / "tally"),
            held=not self.settled,
            stamps=str(self.folder / "stamps.npy"),
        )
        self._twin = self._stack.enter_context(start_twin(plan))

    def stop(self) -> NDArray[np.int64]:
        """End twin and publisher; the `Stamp` of each sweep, shape (sweeps, 3), ns."""
        self._twin.terminate()
        self.publisher.kill()
        stamps_ns: NDArray[np.int64] = np.load(self.folder / "stamps.npy")
        return stamps_ns


def hear(subscriber: Subscriber, hand: Hand, seconds: float, *, echo: bool = False) -> None:
    """Take in what the hand publishes, for so long."""
    until_s = time.monotonic() + seconds
    while (left_s := until_s - time.monotonic()) > 0:
        message = subscriber.take(left_s)
        if message is None:
            continue
        if echo:
            hand.record.add_echo(message[1], subscriber.received_ns)
        else:
            hand.record.add(message[1], subscriber.received_ns, settled=hand.settled)
            hand.ask()


def measure(hand: Hand, seconds: float, *, echo: bool = False) -> float:
    """Fill the hand's record for so long; return the share of a core that it used, %.

    Raises `RuntimeError` if not all that was to be judged was.
    """
    record = hand.record
    with Subscriber(hand.endpoint) as subscriber:
        deadline_s = time.monotonic() + PATIENCE_S
        while not record.judged and time.monotonic() < deadline_s:
            hear(subscriber, hand, WARM_UP_S, echo=echo)
        hear(subscriber, hand, WARM_UP_S, echo=echo)
        record.clear()
        before = usage(hand.publisher.pid)
        hear(subscriber, hand, seconds, echo=echo)
        after = usage(hand.publisher.pid)
    is_enough = hand.settled or record.judged >= JUDGED_MIN_SHARE * record.readings
    if not record.judged or not is_enough:
        why = dict(record.reasons)
        raise RuntimeError(
            f"{record.judged} of {record.readings} readings were judged; others: {why}"
        )
    return 100 * (after.cpu_s - before.cpu_s) / (after.t_s - before.t_s)
