"""The socket: what a plain ZeroMQ subscriber gets, and who may bind."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
import zmq

from daemon.publisher import Publisher, PublishError

WAIT_MS = 5000


class Peers:
    """Makes sockets that connect to a publisher, and closes them all."""

    def __init__(self) -> None:
        self.context = zmq.Context()
        self._sockets: list[zmq.Socket[bytes]] = []

    def connect(self, kind: int, endpoint: str, high_water_mark: int = 1000) -> zmq.Socket[bytes]:
        socket = self.context.socket(kind)
        socket.rcvhwm = high_water_mark
        socket.rcvtimeo = WAIT_MS
        socket.connect(endpoint)
        self._sockets.append(socket)
        return socket

    def subscribe(
        self, endpoint: str, topic: str = "", high_water_mark: int = 1000
    ) -> zmq.Socket[bytes]:
        socket = self.connect(zmq.SUB, endpoint, high_water_mark)
        socket.subscribe(topic)
        return socket

    def close(self) -> None:
        for socket in self._sockets:
            socket.close(linger=0)
        self.context.term()


@pytest.fixture
def peers() -> Iterator[Peers]:
    peers = Peers()
    yield peers
    peers.close()


@pytest.mark.parametrize("scheme", ["ipc", "tcp"])
def test_a_plain_subscriber_gets_two_frames_in_order(
    tmp_path: Path, peers: Peers, scheme: str
) -> None:
    endpoint = f"ipc://{tmp_path}/v" if scheme == "ipc" else "tcp://127.0.0.1:45917"
    with Publisher(endpoint) as publisher:
        socket = peers.subscribe(endpoint, "verdict.")
        assert publisher.wait_for_subscriber(5.0)
        publisher.send(b"status.right", b"not wanted")
        for number in range(100):
            publisher.send(b"verdict.right", b"%d" % number)
        received = [socket.recv_multipart() for _ in range(100)]
    assert received == [[b"verdict.right", b"%d" % number] for number in range(100)]


def test_nobody_to_wait_for_is_said(tmp_path: Path) -> None:
    with Publisher(f"ipc://{tmp_path}/v") as publisher:
        assert not publisher.wait_for_subscriber(0.01)


def test_sending_without_a_subscriber_does_not_block_or_fail(tmp_path: Path) -> None:
    with Publisher(f"ipc://{tmp_path}/v", high_water_mark=1) as publisher:
        for _ in range(1000):
            publisher.send(b"verdict.right", b"{}")


def test_a_subscriber_that_does_not_read_loses_messages_and_nothing_else(
    tmp_path: Path, peers: Peers
) -> None:
    endpoint = f"ipc://{tmp_path}/v"
    with Publisher(endpoint, high_water_mark=10) as publisher:
        socket = peers.subscribe(endpoint, high_water_mark=10)
        assert publisher.wait_for_subscriber(5.0)
        for number in range(20_000):
            publisher.send(b"verdict.right", b"%d" % number + b" " * 1000)
        received = []
        while socket.poll(200):
            received.append(int(socket.recv_multipart()[1]))
    assert received
    assert len(received) < 20_000
    assert received == sorted(set(received))


def test_a_second_publisher_on_the_same_socket_is_refused(tmp_path: Path) -> None:
    endpoint = f"ipc://{tmp_path}/v"
    with Publisher(endpoint), pytest.raises(PublishError, match="another graspd"):
        Publisher(endpoint)
    with Publisher("tcp://127.0.0.1:45918"), pytest.raises(PublishError, match="in use"):
        Publisher("tcp://127.0.0.1:45918")


def test_a_socket_left_by_a_killed_daemon_is_taken_over(tmp_path: Path) -> None:
    (tmp_path / "v").touch()
    (tmp_path / "v.lock").touch()
    with Publisher(f"ipc://{tmp_path}/v"):
        pass


def test_closing_leaves_no_file_and_may_be_repeated(tmp_path: Path) -> None:
    publisher = Publisher(f"ipc://{tmp_path}/v")
    assert (tmp_path / "v").is_socket()
    publisher.close()
    publisher.close()
    assert list(tmp_path.iterdir()) == []


def test_a_folder_that_is_not_there_is_said(tmp_path: Path) -> None:
    with pytest.raises(PublishError, match=r"absent.*No such file or directory"):
        Publisher(f"ipc://{tmp_path}/absent/v")


def test_a_peer_that_sends_more_than_a_subscription_is_cut_off(
    tmp_path: Path, peers: Peers
) -> None:
    endpoint = f"ipc://{tmp_path}/v"
    with Publisher(endpoint) as publisher:
        hostile = peers.connect(zmq.XSUB, endpoint)
        hostile.send(b"\x05" + b"x" * 100)
        hostile.send(b"\x01" + b"x" * 100_000)
        socket = peers.subscribe(endpoint)
        assert publisher.wait_for_subscriber(5.0)
        publisher.drain()
        publisher.send(b"verdict.right", b"{}")
        assert socket.recv_multipart() == [b"verdict.right", b"{}"]
