"""An open door with one socket for messages, sockets of peers, and what stands for the loop."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Self

import zmq

from daemon.publish.companion import Answer
from daemon.publish.door import Door
from daemon.publish.listener import Listener
from daemon.trust.lift_book import Report

WAIT_MS = 100_000


class Publisher:
    """A door that only publishes."""

    def __init__(self, endpoint: str, high_water_mark: int = 1000, *, awaits: bool = False) -> None:
        self._listener = Listener(endpoint)
        try:
            self.door = Door(
                self._listener, high_water_mark=high_water_mark, awaits_subscriber=awaits
            )
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
    """Stands for the loop: counts questions, takes outcomes, and keeps them at once."""

    def __init__(self, why: Callable[[Report], str | None] = lambda _report: None) -> None:
        """`why` says why an outcome is refused; None: it is taken."""
        self.times = 0
        self.outcomes: list[Report] = []
        self.waiting: list[Answer] | None = None
        """Answers that wait until the outcomes are kept; None: they are kept at once."""
        self._why = why

    def ask(self) -> None:
        self.times += 1

    def outcome(self, report: Report, answer: Answer) -> None:
        self.outcomes.append(report)
        why = self._why(report)
        if why is not None or self.waiting is None:
            answer(why)
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


def first_message(publisher: Publisher, subscriber: zmq.Socket[bytes]) -> list[bytes]:
    """Send until something arrives: the publisher does not learn of subscriptions."""
    deadline_s = time.monotonic() + WAIT_MS / 1e3
    while not subscriber.poll(10):
        assert time.monotonic() < deadline_s
        publisher.send(b"verdict.right", b"first")
    return subscriber.recv_multipart()
