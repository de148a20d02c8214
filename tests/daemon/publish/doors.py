"""Opened `Door` objects, sockets of peers that connect to them, and a stand-in for the loop."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Self

import pytest
import zmq
from msgspec.structs import replace

from graspd.daemon import scene
from graspd.daemon.judge.pipeline import Judgement
from graspd.daemon.judge.reasons import Moment
from graspd.daemon.publish.companion import KEPT, Answer, PublishedVerdict, Reply, at_once
from graspd.daemon.publish.keys import load_pair, make
from graspd.daemon.publish.listener import Listener
from graspd.daemon.publish.porter import Frames
from graspd.daemon.publish.sockets import Door, Sockets
from graspd.daemon.trust.lift_book import GraspId, LiftBook, Report
from graspd.models.judge.grasp_judge import Opinion
from tests.kit.messages import GOLDEN, decode_verdict
from tests.kit.waiting import wait_until
from tests.ports import free_port

WAIT_MS = 100_000
QUIET_S = 0.3

Keys = tuple[bytes, bytes]
CURVE: dict[str, object] = {"secret_key": "daemon.key_secret", "clients": "clients"}
"""Section `curve` of a scene with keys beside it."""


USER = b"user 1000"
"""Credential of a peer on an `ipc://` socket: its user id."""


def published(
    payload: bytes = b"{}",
    name: str = "stable",
    lifts: LiftBook | None = None,
    keep: Callable[[Answer], None] = at_once,
    grasp: int = 7,
    **changes: object,
) -> PublishedVerdict:
    """Return the golden verdict `name` with `changes`, as if published with `payload`.

    `lifts`: the book of lifts that has the `grasp`; None: an empty one. `keep`: calls its argument
    once outcomes are on the disk.
    """
    verdict = replace(decode_verdict((GOLDEN / f"verdict_{name}.json").read_bytes()), **changes)
    judgement = Judgement(0, verdict.verdict, (), 0.1, Moment(grasp), Opinion(0.1))
    about = GraspId("0" * 32, grasp), LiftBook() if lifts is None else lifts, keep
    return PublishedVerdict(judgement, verdict, payload, None, True, *about)


class Publisher:
    """A `Door` with a socket for subscribers only."""

    def __init__(self, endpoint: str, high_water_mark: int = 1000) -> None:
        self._listener = Listener(endpoint)
        try:
            self.door = Door([self._listener], high_water_mark=high_water_mark)
        except BaseException:
            self._listener.close()
            raise

    def send(self, topic: bytes, payload: bytes) -> bool:
        return self.door.send(topic, payload)

    def close(self) -> None:
        assert self.door.close()
        self._listener.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_details: object) -> None:
        self.close()


class Asked:
    """Stand-in for the loop that counts questions and takes outcomes."""

    def __init__(self, reply: Callable[[Report], Reply] = lambda _report: KEPT) -> None:
        """`reply`: returns the reply to an outcome."""
        self.times = 0
        self.outcomes: list[Report] = []
        self.waiting: list[Answer] | None = None
        """Answers that wait until the outcomes are kept; None: they are kept at once."""
        self._reply = reply

    def ask(self) -> None:
        self.times += 1

    def silence(self) -> None:
        raise AssertionError("a verdict was published")

    def outcome(self, report: Report, answer: Answer) -> None:
        self.outcomes.append(report)
        reply = self._reply(report)
        if reply != KEPT or self.waiting is None:
            answer(reply)
        else:
            self.waiting.append(answer)


class Peers:
    """Makes sockets that connect to a door, and closes them all."""

    def __init__(self) -> None:
        self.context = zmq.Context()
        self._sockets: list[zmq.Socket[bytes]] = []

    def connect(
        self, kind: int, endpoint: str, high_water_mark: int = 1000, name: bytes | None = None
    ) -> zmq.Socket[bytes]:
        made = self.context.socket(kind)
        made.ipv6 = True
        made.rcvhwm = high_water_mark
        made.rcvtimeo = WAIT_MS
        if name is not None:
            made.routing_id = name
        made.connect(endpoint)
        self._sockets.append(made)
        return made

    def subscribe(
        self, endpoint: str, topic: str = "", high_water_mark: int = 1000
    ) -> zmq.Socket[bytes]:
        subscriber = self.connect(zmq.SUB, endpoint, high_water_mark)
        subscriber.subscribe(topic)
        return subscriber

    def close(self) -> None:
        for each in self._sockets:
            each.close(linger=0)
        self.context.term()


class KeyedDoor:
    """A daemon's sockets with keys, and clients that connect to them."""

    def __init__(self, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        self._log = folder / "log"
        self._stderr = self._log.open("a")
        popen = partial(subprocess.Popen, stderr=self._stderr)
        monkeypatch.setattr(subprocess, "Popen", popen)
        make(folder, "daemon")
        self.clients = folder / "clients"
        self.known = self.client("controller", folder / "theirs")
        (folder / "theirs" / "controller.key").rename(self.clients / "controller.key")
        self.port = free_port()
        self.endpoint = f"tcp://127.0.0.1:{self.port}"
        self._ask = f"tcp://127.0.0.1:{free_port()}"
        sections: dict[str, dict[str, object]] = {
            "publish": {"endpoint": self.endpoint},
            "ask": {"endpoint": self._ask},
            "curve": CURVE,
        }
        self.sockets = Sockets(scene_of(folder, **sections))
        self.public = load_pair(folder / "daemon.key_secret")[0]
        self.context = zmq.Context()
        self.connected: list[zmq.Socket[bytes]] = []

    def close(self) -> None:
        for each in self.connected:
            each.close(linger=0)
        self.context.term()
        self.sockets.close()
        self._stderr.close()

    def client(self, name: str, folder: Path) -> Keys:
        self.clients.mkdir(exist_ok=True)
        return load_pair(make(folder, name)[1])

    def admitted(self, name: str, folder: Path) -> Keys:
        """Make the keys `name` of a second client in `folder`; return them once the daemon has
        them on its list."""
        keys = self.client(name, folder)
        (folder / f"{name}.key").rename(self.clients / f"{name}.key")
        self.knows(2)
        return keys

    def said(self) -> str:
        """Return the log of the sockets' process until now."""
        return self._log.read_text()

    def knows(self, number: int) -> None:
        """Wait until `number` keys may connect."""
        wait_until(lambda: re.findall(r"(\d+) keys may", self.said())[-1:] == [str(number)])

    def is_deaf(self, subscriber: zmq.Socket[bytes]) -> None:
        """Wait until no message comes to the subscriber. Some may still be on their way."""
        wait_until(lambda: not self.hears(subscriber, QUIET_S))

    def connect(
        self, keys: Keys | None, kind: int = zmq.SUB, server: bytes | None = None
    ) -> zmq.Socket[bytes]:
        made = self.context.socket(kind)
        self.connected.append(made)
        made.linger = 0
        if keys is not None:
            made.curve_publickey, made.curve_secretkey = keys
            made.curve_serverkey = server or self.public
        made.connect(self.endpoint if kind == zmq.SUB else self._ask)
        if kind == zmq.SUB:
            made.subscribe("")
        return made

    def hears(self, subscriber: zmq.Socket[bytes], patience_s: float) -> bool:
        deadline_s = time.monotonic() + patience_s
        while time.monotonic() < deadline_s:
            self.sockets.before_wait(Asked())
            self.sockets.send(b"verdict.right", b"{}")
            if subscriber.poll(5):
                subscriber.recv_multipart()
                return True
        return False


def processes() -> list[int]:
    """Return the ids of this process's running children, such as those of `Door`."""
    folder = Path(f"/proc/{os.getpid()}/task")
    return [
        int(number)
        for thread in folder.iterdir()
        for number in (thread / "children").read_text().split()
    ]


def halt(process: int) -> None:
    """Send SIGSTOP to a child, and wait until all its threads have stopped."""
    os.kill(process, signal.SIGSTOP)
    os.waitid(os.P_PID, process, os.WSTOPPED | os.WNOWAIT)


def first_message(publisher: Publisher, subscriber: zmq.Socket[bytes]) -> list[bytes]:
    """Send until a message arrives, and return its frames.

    The publisher does not learn of subscriptions.
    """
    deadline_s = time.monotonic() + WAIT_MS / 1e3
    while not subscriber.poll(10):
        assert time.monotonic() < deadline_s
        publisher.door.check()
        publisher.send(b"verdict.right", b"first")
    return subscriber.recv_multipart()


@contextmanager
def opened_door(folder: Path, mode: int | None = None) -> Iterator[tuple[Door, str]]:
    """Yield a `Door` with sockets `v` for messages and `ask` for questions, and `ask`'s endpoint.

    `mode`: file mode of both sockets; None: that of the process.
    """
    listeners = [Listener(f"ipc://{folder}/{name}", mode) for name in ("v", "ask")]
    door = Door(listeners)
    yield door, listeners[1].endpoint
    assert door.close()
    for listener in listeners:
        listener.close()


def scene_of(folder: Path, **sections: dict[str, object]) -> scene.Scene:
    """Return a scene with sockets `v` and `ask` in a folder, changed by `sections`."""
    usual: dict[str, dict[str, object]] = {
        "tactile": {"driver": "replay", "recordings": ["any.csv"]},
        "publish": {"endpoint": f"ipc://{folder}/v"},
        "ask": {"endpoint": f"ipc://{folder}/ask"},
    }
    text = {name: usual.get(name, {}) | sections.get(name, {}) for name in usual | sections}
    return scene.parse(text, folder / "scene.toml")


def receive(door: Door, wanted: int = 1) -> list[Frames]:
    """Wait until at least `wanted` questions have come, and return them."""
    received: list[Frames] = []

    def have_come() -> bool:
        received.extend(door.receive())
        return len(received) >= wanted

    wait_until(have_come)
    return received
