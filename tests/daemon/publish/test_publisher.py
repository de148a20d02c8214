"""The socket: what a plain ZeroMQ subscriber gets, and that nothing it sends does harm."""

from __future__ import annotations

import os
import signal
import socket
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
import zmq

from daemon.process.signals import StopSignal
from daemon.publish.binding import PublishError
from daemon.publish.publisher import Publisher
from tests.ports import free_port

WAIT_MS = 100_000


class Peers:
    """Makes sockets that connect to a publisher, and closes them all."""

    def __init__(self) -> None:
        self.context = zmq.Context()
        self._sockets: list[zmq.Socket[bytes]] = []

    def connect(self, kind: int, endpoint: str, high_water_mark: int = 1000) -> zmq.Socket[bytes]:
        made = self.context.socket(kind)
        made.ipv6 = True
        made.rcvhwm = high_water_mark
        made.rcvtimeo = WAIT_MS
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


@pytest.fixture
def peers() -> Iterator[Peers]:
    peers = Peers()
    yield peers
    peers.close()


SCHEMES = ("ipc", "tcp", "ip6")


def endpoint_of(scheme: str, folder: Path) -> str:
    """A place for a socket that nobody else has."""
    if scheme == "ipc":
        return f"ipc://{folder}/v"
    return f"tcp://{'[::1]' if scheme == 'ip6' else '127.0.0.1'}:{free_port()}"


def has_ipv6() -> bool:
    with socket.socket(socket.AF_INET6) as probe:
        try:
            probe.bind(("::1", 0))
        except OSError:
            return False
    return True


@pytest.mark.parametrize("scheme", SCHEMES)
def test_a_plain_subscriber_gets_two_frames_in_order(
    tmp_path: Path, peers: Peers, scheme: str
) -> None:
    if scheme == "ip6" and not has_ipv6():
        pytest.skip("this computer has no IPv6")
    endpoint = endpoint_of(scheme, tmp_path)
    with Publisher(endpoint) as publisher:
        subscriber = peers.subscribe(endpoint, "verdict.")
        assert publisher.wait_for_subscriber(WAIT_MS / 1e3)
        end_s = time.monotonic() + WAIT_MS / 1e3
        publisher.send(b"status.right", b"not wanted")
        for number in range(100):
            publisher.send(b"verdict.right", b"%d" % number)
        received: list[list[bytes]] = []
        while len(received) < 100:
            publisher.take()  # what a busy subscriber's socket has no room for is sent later
            assert time.monotonic() < end_s
            if subscriber.poll(10):
                received.append(subscriber.recv_multipart())
    assert received == [[b"verdict.right", b"%d" % number] for number in range(100)]


def first_message(publisher: Publisher, subscriber: zmq.Socket[bytes]) -> list[bytes]:
    """Send until something arrives: without waiting nobody knows when a subscription is there."""
    deadline_s = time.monotonic() + WAIT_MS / 1e3
    while not subscriber.poll(10):
        assert time.monotonic() < deadline_s
        publisher.send(b"verdict.right", b"{}")
    return subscriber.recv_multipart()


def test_a_publisher_that_nobody_looks_after_serves_many_topics_too(
    tmp_path: Path, peers: Peers
) -> None:
    endpoint = f"ipc://{tmp_path}/v"
    with Publisher(endpoint) as publisher:
        subscriber = peers.connect(zmq.SUB, endpoint)
        for topic in [*map(str, range(50)), "verdict."]:
            subscriber.subscribe(topic)
        assert first_message(publisher, subscriber) == [b"verdict.right", b"{}"]


def test_nobody_to_wait_for_is_said(tmp_path: Path) -> None:
    with Publisher(f"ipc://{tmp_path}/v") as publisher:
        assert not publisher.wait_for_subscriber(0.01)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_the_waiting(tmp_path: Path, number: signal.Signals) -> None:
    with StopSignal() as stop, Publisher(f"ipc://{tmp_path}/v") as publisher:
        timer = threading.Timer(0.05, os.kill, (os.getpid(), number))
        timer.start()
        start_s = time.monotonic()
        assert not publisher.wait_for_subscriber(30.0, stop)
        assert time.monotonic() - start_s < 5
        timer.join()
        assert stop.received is number


def test_sending_without_a_subscriber_does_not_block_or_fail(tmp_path: Path) -> None:
    with Publisher(f"ipc://{tmp_path}/v", high_water_mark=1) as publisher:
        for _ in range(1000):
            publisher.send(b"verdict.right", b"{}")


def test_a_subscriber_that_does_not_read_loses_messages_and_nothing_else(
    tmp_path: Path, peers: Peers
) -> None:
    endpoint = f"ipc://{tmp_path}/v"
    with Publisher(endpoint, high_water_mark=10) as publisher:
        subscriber = peers.subscribe(endpoint, high_water_mark=10)
        assert publisher.wait_for_subscriber(WAIT_MS / 1e3)
        for number in range(20_000):
            publisher.send(b"verdict.right", b"%d" % number + b" " * 1000)
        received = []
        while subscriber.poll(200):
            received.append(int(subscriber.recv_multipart()[1]))
    assert received
    assert len(received) < 20_000
    assert received == sorted(set(received))


def test_a_second_publisher_on_the_same_port_is_refused(tmp_path: Path) -> None:
    endpoint = endpoint_of("tcp", tmp_path)
    with Publisher(endpoint), pytest.raises(PublishError, match="in use"):
        Publisher(endpoint)


def test_a_peer_that_sends_more_than_a_subscription_is_cut_off(
    tmp_path: Path, peers: Peers
) -> None:
    endpoint = f"ipc://{tmp_path}/v"
    with Publisher(endpoint) as publisher:
        hostile = peers.connect(zmq.XSUB, endpoint)
        hostile.send(b"\x05" + b"x" * 100)
        hostile.send(b"\x01" + b"x" * 100_000)
        assert not publisher.wait_for_subscriber(0.3)
        subscriber = peers.subscribe(endpoint)
        assert publisher.wait_for_subscriber(WAIT_MS / 1e3)
        publisher.send(b"verdict.right", b"{}")
        assert subscriber.recv_multipart() == [b"verdict.right", b"{}"]


def resident_mib() -> float:
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGESIZE") / 2**20


FLOODS: dict[str, Callable[[int], bytes]] = {
    "junk": lambda number: b"\x05" + b"x" * 100,
    "one topic": lambda number: b"\x01verdict.right",
    "on and off": lambda number: b"\x01v" if number % 2 else b"\x00v",
}


@pytest.mark.parametrize("kind", FLOODS)
def test_a_flood_of_what_is_no_subscription_neither_delays_nor_grows(
    tmp_path: Path, peers: Peers, kind: str
) -> None:
    endpoint = f"ipc://{tmp_path}/v"
    ended = threading.Event()

    def flood() -> None:
        hostile = peers.connect(zmq.XSUB, endpoint)
        number = 0
        while not ended.is_set():
            number += 1
            try:
                hostile.send(FLOODS[kind](number), zmq.NOBLOCK)
            except zmq.Again:
                time.sleep(0.001)

    with Publisher(endpoint) as publisher:
        subscriber = peers.subscribe(endpoint)
        first_message(publisher, subscriber)
        before_mib, slowest_s = resident_mib(), 0.0
        thread = threading.Thread(target=flood)
        thread.start()
        for _ in range(100):
            start_s = time.monotonic()
            publisher.send(b"verdict.right", b"{}")
            slowest_s = max(slowest_s, time.monotonic() - start_s)
            assert subscriber.recv_multipart() == [b"verdict.right", b"{}"]
            time.sleep(0.01)
        ended.set()
        thread.join()
    assert slowest_s < 0.5  # the flood runs in this process, on a machine with other work
    assert resident_mib() - before_mib < 20
