"""The Python client with a clock and sockets that tests move."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from types import SimpleNamespace
from typing import Any

import pytest

from deploy.clients.python import graspd_client
from deploy.clients.python.graspd_client import Client
from tests.clients.messages import MS, frames, verdict

START_NS = 1000 * MS
ASK = "ipc:///nowhere.ask"
LOOK_NS = 1000
"""Time that each look at the clock takes, ns."""


@dataclass
class Call:
    """Stand-in for a client's `_Call`: questions `said`, and `answers` with their delays, ns."""

    world: World
    answers: list[tuple[int, bytes]]
    said: list[bytes] = field(default_factory=list)
    answered: list[bytes] = field(default_factory=list)
    due: tuple[int, bytes] | None = None

    def ask(self, question: bytes) -> bool:
        assert self.due is None, "one question at a time"
        self.said.append(question)
        if self.answers:
            delay_ns, payload = self.answers.pop(0)
            self.due = self.world.now_ns + delay_ns, payload
        return True

    def answer(self) -> bytes | None:
        if self.due is None or self.due[0] > self.world.now_ns:
            return None
        self.answered.append(self.due[1])
        self.due = None
        return self.answered[-1]

    def hang_up(self, *, lifts: bool = True) -> None:
        self.due = None


@dataclass
class World:
    """Stand-in for a client's `_Link` and clocks: sockets on which messages arrive at set times."""

    coming: list[tuple[int, list[bytes]]]
    """Messages to come: time of arrival, ns, and frames."""
    answers: list[tuple[int, bytes]] = field(default_factory=list)
    """Answers to `lift` in order: delay after the question, ns, and payload; then no more."""
    acknowledged: list[tuple[int, bytes]] = field(default_factory=list)
    """Answers to outcomes: delay after the report, ns, and payload."""
    now_ns: int = START_NS
    slept_ns: int = 0
    """Time for which the computer has slept; the monotonic clock does not count it."""
    came: list[list[bytes]] = field(default_factory=list)
    renewed: int = 0

    def __post_init__(self) -> None:
        self.asking, self.telling = Call(self, self.answers), Call(self, self.acknowledged)
        self.timing = Call(self, [])

    def monotonic_ns(self) -> int:
        self.now_ns += LOOK_NS
        return self.now_ns

    def boot_ns(self, _clock: int) -> int:
        return self.monotonic_ns() + self.slept_ns

    def receive(self) -> list[bytes] | None:
        if not self.coming or self.coming[0][0] > self.now_ns:
            return None
        self.came.append(self.coming.pop(0)[1])
        return self.came[-1]

    def wait(self, timeout_ms: int) -> None:
        calls = (self.asking.due, self.telling.due)
        due_ns = [due for due, _ in self.coming[:1]] + [due[0] for due in calls if due]
        self.now_ns = max(self.now_ns, min([self.now_ns + timeout_ms * MS, *due_ns]))

    def renew(self) -> None:
        self.renewed += 1

    def close(self) -> None:
        pass


@contextmanager
def client(world: World, ask: bool = False, same: bool | None = None) -> Iterator[Client]:
    """Make a client on the world's sockets and clocks; `ask`: one that asks the daemon. `same`: as
    `same_computer`."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(graspd_client, "_Link", lambda *_: world)
        clocks = {"monotonic_ns": world.monotonic_ns, "clock_gettime_ns": world.boot_ns}
        patch.setattr(graspd_client, "time", SimpleNamespace(**clocks, CLOCK_BOOTTIME=7))
        asks = ASK if ask else None
        with Client("ipc:///nowhere", ask_endpoint=asks, same_computer=same) as made:
            yield made


def coming(*messages: tuple[str, Mapping[str, Any]]) -> list[tuple[int, list[bytes]]]:
    """Make messages with arrival times, ns, one every 10 ms from `START_NS` on, each of a verdict
    and changed fields."""
    sent = []
    for seq, (outcome, more) in enumerate(messages):
        at_ns = START_NS + seq * 10 * MS
        read_ns = at_ns - round(more.get("age_ms", 1.0) * MS)
        sent.append((at_ns, frames(verdict(seq, read_ns, outcome, **more))))
    return sent
