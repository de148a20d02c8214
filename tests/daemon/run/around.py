"""Stand-ins for what is around a daemon, in simulated time: clock, disk, sockets, peers."""

from __future__ import annotations

import heapq
import itertools
import json
import random
import selectors
from collections.abc import Callable, Sequence
from contextlib import suppress
from functools import partial
from typing import Any

from graspd.daemon.trust.lift_book import GraspId, Peer
from tests.daemon.fakes import MS
from tests.kit.clock import Clock

S = 1000 * MS
PATIENCE_NS, SLACK_NS = S, 25 * MS
"""Longest wait for an answer, and how late a message may come after its limit, ns."""


class KilledError(BaseException):
    """Ends the daemon as a kill does: no code in it catches a `BaseException`."""


class World(Clock):
    """A simulated clock, with the actions that are due at given times."""

    def __init__(self, seed: int) -> None:
        super().__init__()
        self.random = random.Random(seed)
        self.away_ns = 0
        """Total time in which the computer did something else, ns."""
        self._worked_ns = 0
        self.has_trouble = False
        self.kill_ns: int | None = None
        self._due: list[tuple[int, int, Callable[[], object]]] = []
        self._numbers = itertools.count()

    @property
    def worked_ns(self) -> int:
        """Time without `away_ns`, ns; never goes back."""
        self._worked_ns = max(self._worked_ns, self.now_ns - self.away_ns)
        return self._worked_ns

    def after(self, ns: int, do: Callable[[], object]) -> None:
        heapq.heappush(self._due, (self.now_ns + ns, next(self._numbers), do))

    def pump(self) -> None:
        """Run the actions that are due; the clock shows to each its own time."""
        now_ns = self.now_ns
        while self._due and self._due[0][0] <= now_ns:
            self.now_ns, _, do = heapq.heappop(self._due)
            away_ns = self.away_ns
            do()
            now_ns += self.away_ns - away_ns
        self.now_ns = now_ns

    def wait(self, ns: int) -> None:
        """Move time to the next action, by `ns` at most. Raises `KilledError` if a kill is due."""
        until_ns = min(self.now_ns + ns, self._due[0][0])
        if self.kill_ns is not None and self.kill_ns <= until_ns:
            self.kill_ns = None
            raise KilledError
        self.now_ns = max(self.now_ns, until_ns)
        self.pump()

    def kill_soon(self) -> None:
        if self.has_trouble:
            self.kill_ns = self.now_ns + self.random.randrange(20) * MS

    def stall(self, ns: int) -> None:
        self.now_ns += ns
        self.away_ns += ns


class Selector(selectors.SelectSelector):
    """Selector that moves the simulated time instead of waiting, unless a question waits."""

    def __init__(self, world: World, door: Door) -> None:
        super().__init__()
        self._world, self._door = world, door

    def select(self, timeout: float | None = None) -> list[tuple[selectors.SelectorKey, int]]:
        if not self._door.questions:
            self._world.wait(round((timeout or 0.0) * 1e9))
        return []


class Disk:
    """Stands for the thread that saves: a job is done after a while, or never."""

    filenos: Sequence[int] = ()

    def __init__(self, world: World) -> None:
        self.world = world
        self.is_full = self.is_slow = self.is_dead = False
        self._job: Callable[[], object] | None = None
        self._due_ns = 0

    def plug(self, _name: str) -> Disk:
        self._job, self.is_dead = None, False
        return self

    @property
    def busy(self) -> bool:
        return self._job is not None

    def submit(self, job: Callable[[], object]) -> bool:
        took_ms = self.world.random.choice((1, 5, 300, 8000) if self.is_slow else (1, 5, 20))
        self._job, self._due_ns = job, self.world.now_ns + took_ms * MS
        self.world.after(took_ms * MS, lambda: None)
        return True

    def take(self, wait_s: float = 0.0) -> object:
        if self._job is None or self.is_dead or self._due_ns > self.world.now_ns + wait_s * S:
            return None
        self.world.now_ns = max(self.world.now_ns, self._due_ns)
        job, self._job = self._job, None
        try:
            return job()
        except Exception as error:  # noqa: BLE001 - as the thread does
            return error

    def close(self, _wait_s: float) -> bool:
        return True

    def kill(self) -> None:
        """End as by a kill: a running save is done or not, never in part (see test_folder)."""
        self.is_dead = True
        if self._job is not None and self.world.random.random() < 0.5:
            with suppress(Exception):
                self._job()

    def fsync(self, _descriptor: int) -> None:
        if self.is_full:
            raise OSError(28, "No space left on device")


class Controller:
    """A program that asks whether it may lift, lifts, and later reports the outcome, or never."""

    def __init__(self, world: World, door: Door, name: bytes, user: bytes) -> None:
        self.world, self.door, self.known = world, door, Peer(name, user)
        self.asked_ns: int | None = None
        """`World.worked_ns` at the open question; None: no question is open."""
        self.lifts = False
        self.told: tuple[GraspId, str] | None = None
        self.offers: set[GraspId] = set()
        """Grasps that it was offered to lift, and whose outcome is not acknowledged yet."""
        self.kept: set[GraspId] = set()
        """Grasps whose outcome was acknowledged."""
        self.last: dict[str, Any] = {}

    def ask(self, *, lifts: bool = True) -> None:
        if self.door.is_open and self.told is None and self.asked_ns is None:
            self.asked_ns, self.lifts = self.world.worked_ns, lifts
            self.door.questions.append([*self.known, b"lift" if lifts else b"judge"])

    def tell(self, grasp: GraspId, outcome: str) -> None:
        if self.told is not None or not self.door.is_open:
            self.world.after(300 * MS, partial(self.tell, grasp, outcome))
            return
        self.told = grasp, outcome
        text = f"outcome {grasp.boot_id} {grasp.grasp} {outcome}"
        self.door.questions.append([*self.known, text.encode()])

    def hear(self, answer: dict[str, Any]) -> None:
        if "ok" in answer:
            taken = "repeated" if "repeated" in answer else "ok"
            self._hear_reply(taken if answer["ok"] else answer["why"].partition(":")[0])
        else:
            self._hear_verdict(answer)

    def _hear_reply(self, word: str) -> None:
        assert self.told is not None, "a reply to nothing"
        (grasp, outcome), self.told = self.told, None
        if word in ("not kept", "busy"):
            self.world.after(S, partial(self.tell, grasp, outcome))
            return
        assert word in ("ok", "repeated"), f"{word} to {outcome} of {grasp}"
        self.kept.add(grasp)
        self.offers.discard(grasp)
        self._may_kill()

    def _hear_verdict(self, answer: dict[str, Any]) -> None:
        self.check_answered()
        assert self.asked_ns is not None, "an answer to nothing"
        self.asked_ns, self.last = None, answer
        grasp = GraspId(answer["boot_id"], answer["grasp"])
        if not self.lifts or answer.get("owner") != "you" or grasp in self.offers | self.kept:
            return
        assert answer["verdict"] == "stable" or answer["supervised"], "an offer of what is unknown"
        self.offers.add(grasp)
        self._may_kill()
        draw = self.world.random
        if draw.random() < 0.9:  # else it hangs
            outcome = draw.choice(("stable", "stable", "stable", "slip"))
            after_ms = draw.choice((100, 800, 800, 5000))
            self.world.after(after_ms * MS, partial(self.tell, grasp, outcome))

    def _may_kill(self) -> None:
        """Kill the daemon soon, in one call of ten: what was just acknowledged could be lost."""
        if self.world.random.random() < 0.1:
            self.world.kill_soon()

    def check_answered(self) -> None:
        if self.asked_ns is not None:
            waited_ns = self.world.worked_ns - self.asked_ns
            assert waited_ns <= PATIENCE_NS + SLACK_NS, f"no answer after {waited_ns / MS} ms"


class Door:
    """Stands for the process with the sockets."""

    is_late = False

    def __init__(self, world: World) -> None:
        self.world = world
        self.questions: list[list[bytes]] = []
        self.is_open = False
        self.peers = [
            Controller(world, self, b"controller-16byt", b"user 0"),
            Controller(world, self, b"another-16-bytes", b"user 0"),
            Controller(world, self, b"stranger-16bytes", b"user 9"),
        ]
        self.evening = Controller(world, self, b"in-the-evening-1", b"user 0")
        """Asks only once all works again."""
        self.all = [*self.peers, self.evening]
        self.hear: Callable[[bytes, bytes], None] = lambda _topic, _payload: None
        """Called with each message."""

    def plug(self, *_arguments: object) -> Door:
        self.is_open = True
        return self

    def shut(self) -> None:
        """Have peers see that the daemon is gone: they report again, and drop their questions."""
        self.is_open = False
        self.questions.clear()
        for peer in self.all:
            if peer.told is not None:
                self.world.after(S, partial(peer.tell, *peer.told))
            peer.told = peer.asked_ns = None

    def fileno(self) -> int:
        return 1

    def check(self) -> None:
        """Do nothing: this process never ends or hangs."""

    def send(self, topic: bytes, payload: bytes) -> bool:
        if self.is_open:
            self.hear(topic, payload)
        return True

    def answer(self, frames: Sequence[bytes]) -> bool:
        for peer in self.all:
            if self.is_open and peer.known.routing_id == frames[0]:
                peer.hear(json.loads(frames[-1]))
        return True

    def receive(self) -> list[list[bytes]]:
        self.world.pump()
        taken, self.questions = self.questions[:8], self.questions[8:]
        return taken

    @property
    def is_asked(self) -> bool:
        return bool(self.questions)

    def flood(self) -> None:
        """Send questions of many connections, and messages that are not questions."""
        for number in range(300 * self.is_open):
            text = self.world.random.choice((b"judge", b"lift", b"clock", b"outcome x", b"?"))
            self.questions.append([b"flood-%010d" % number, b"user 9", text])

    def close(self) -> bool:
        return True
