"""The sockets: what peers get, and that nothing they send holds up the loop."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest
import zmq

from graspd.daemon.process.signals import StopSignal
from graspd.daemon.publish import PublishError
from graspd.daemon.publish.listener import Listener
from graspd.daemon.publish.porter import QUESTIONS_MAX, Plan
from graspd.daemon.publish.sockets import Door
from tests.daemon.publish.doors import (
    WAIT_MS,
    Peers,
    Publisher,
    first_message,
    halt,
    opened_door,
    processes,
    receive,
)
from tests.kit.waiting import wait_until
from tests.ports import free_ipv6_endpoint, free_port

SCHEMES = ("ipc", "tcp", "ip6")
ME = b"user %d" % os.getuid()


@pytest.fixture
def asked(tmp_path: Path) -> Iterator[tuple[Door, str]]:
    """A `Door` with a socket for questions, and the endpoint of this socket."""
    with opened_door(tmp_path) as opened:
        yield opened


def endpoint_of(scheme: str, folder: Path) -> str:
    """Return a free endpoint of a scheme, one of `SCHEMES`."""
    if scheme == "ipc":
        return f"ipc://{folder}/v"
    return free_ipv6_endpoint() if scheme == "ip6" else f"tcp://127.0.0.1:{free_port()}"


@pytest.mark.parametrize("scheme", SCHEMES)
def test_a_subscriber_gets_messages_of_two_frames_in_order(
    tmp_path: Path, peers: Peers, scheme: str
) -> None:
    endpoint = endpoint_of(scheme, tmp_path)
    with Publisher(endpoint) as publisher:
        subscriber = peers.subscribe(endpoint, "verdict.")
        assert publisher.door.wait_for_subscriber(WAIT_MS / 1e3)
        publisher.send(b"status.right", b"not wanted")
        for number in range(100):
            assert publisher.send(b"verdict.right", b"%d" % number)
        received = [subscriber.recv_multipart() for _ in range(100)]
    assert received == [[b"verdict.right", b"%d" % number] for number in range(100)]


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_the_wait_for_a_subscriber(tmp_path: Path, number: signal.Signals) -> None:
    with StopSignal() as stop, Publisher(f"ipc://{tmp_path}/v") as publisher:
        timer = threading.Timer(0.05, os.kill, (os.getpid(), number))
        timer.start()
        assert not publisher.door.wait_for_subscriber(3600.0, stop)
        timer.join()
        assert stop.received is number


def test_messages_are_dropped_while_the_socket_process_is_stopped(tmp_path: Path) -> None:
    with Publisher(f"ipc://{tmp_path}/v", high_water_mark=5) as publisher:
        (process,) = processes()
        halt(process)
        sent = [publisher.send(b"verdict.right", bytes(10_000)) for _ in range(2000)]
        os.kill(process, signal.SIGCONT)
    # Five wait at each end, more in the kernel: 208 KiB (net.core.wmem_default).
    assert 5 <= sum(sent) < 100
    assert not all(sent)


def test_a_slow_subscriber_loses_messages_but_not_their_order(tmp_path: Path, peers: Peers) -> None:
    endpoint = f"ipc://{tmp_path}/v"
    with Publisher(endpoint, high_water_mark=10) as publisher:
        subscriber = peers.subscribe(endpoint, high_water_mark=10)
        first_message(publisher, subscriber)
        for number in range(20_000):
            publisher.send(b"verdict.right", b"%d" % number + b" " * 1000)
        received = []
        while subscriber.poll(200):
            received.append(subscriber.recv_multipart()[1])
    numbers = [int(payload) for payload in received if payload != b"first"]
    assert 0 < len(numbers) < 20_000
    assert numbers == sorted(set(numbers))


def test_closing_after_a_status_loses_no_message_sent_before(tmp_path: Path, peers: Peers) -> None:
    endpoint = f"ipc://{tmp_path}/v"
    with Publisher(endpoint) as publisher:
        subscriber = peers.subscribe(endpoint)
        first_message(publisher, subscriber)
        for number in range(500):
            publisher.send(b"verdict.right", b"%d" % number)
        publisher.send(b"status.right", b"stopping")
    heard = [subscriber.recv_multipart()]
    while heard[-1] != [b"status.right", b"stopping"]:
        heard.append(subscriber.recv_multipart())
    assert heard[-501:-1] == [[b"verdict.right", b"%d" % number] for number in range(500)]


def test_a_second_publisher_on_a_taken_port_is_refused(tmp_path: Path) -> None:
    endpoint = endpoint_of("tcp", tmp_path)
    with Publisher(endpoint), pytest.raises(PublishError, match="in use"):
        Publisher(endpoint)


def test_answers_reach_the_newest_connection_of_a_routing_id(
    asked: tuple[Door, str], peers: Peers
) -> None:
    door, endpoint = asked
    for kind, delimiter in ((zmq.REQ, [b""]), (zmq.DEALER, []), (zmq.DEALER, [])):
        asker = peers.connect(kind, endpoint, name=b"controller")
        asker.send(b"judge")
        assert receive(door, 1) == [[b"controller", ME, *delimiter, b"judge"]]
        assert door.answer([b"controller", *delimiter, b"{}"])
        assert asker.recv_multipart() == [b"{}"]


def test_only_the_first_frames_of_a_long_message_are_kept(
    asked: tuple[Door, str], peers: Peers
) -> None:
    door, endpoint = asked
    asker = peers.connect(zmq.DEALER, endpoint, name=b"controller")
    asker.send_multipart([b"x"] * 1000)
    asker.send(b"judge")
    long, question = receive(door, 2)
    assert long == [b"controller", ME, b"x", b"x", b"x"]
    assert question == [b"controller", ME, b"judge"]


def test_a_flood_of_questions_is_read_a_few_a_round(asked: tuple[Door, str], peers: Peers) -> None:
    door, endpoint = asked
    asker = peers.connect(zmq.DEALER, endpoint)
    for _ in range(100):
        asker.send(b"judge")
    rounds: list[int] = []
    while sum(rounds) < 100:
        rounds.append(len(door.receive()))
    assert max(rounds) <= QUESTIONS_MAX


def test_an_oversized_message_is_dropped_and_other_peers_are_served(
    asked: tuple[Door, str], peers: Peers
) -> None:
    door, endpoint = asked
    loud, polite = (peers.connect(zmq.DEALER, endpoint, name=name) for name in (b"loud", b"polite"))
    loud.send(b"x" * 100_000)
    polite.send(b"judge")
    assert receive(door, 1) == [[b"polite", ME, b"judge"]]


def test_peers_reconnect_after_the_socket_process_was_killed(
    asked: tuple[Door, str], tmp_path: Path, peers: Peers
) -> None:
    door, endpoint = asked
    subscriber = peers.subscribe(f"ipc://{tmp_path}/v")
    asker = peers.connect(zmq.DEALER, endpoint)
    for _ in range(2):
        while subscriber.poll(0):
            subscriber.recv_multipart()

        def is_served() -> bool:
            door.check()
            door.send(b"verdict.right", b"{}")
            asker.send(b"judge")
            return bool(door.receive()) and bool(subscriber.poll(10))

        wait_until(is_served)
        (process,) = processes()
        os.kill(process, signal.SIGKILL)


def test_a_killed_daemons_socket_process_ends_and_removes_its_folder(tmp_path: Path) -> None:
    code = (
        "import os, sys; from graspd.daemon.publish.sockets import Door;"
        "from graspd.daemon.publish.listener import Listener;"
        "door = Door([Listener(sys.argv[1])]);"
        "print(open(f'/proc/{os.getpid()}/task/{os.getpid()}/children').read(), flush=True);"
        "os.kill(os.getpid(), 9)"
    )
    command = [sys.executable, "-c", code, f"ipc://{tmp_path}/v"]
    killed = subprocess.run(
        command, env=os.environ | {"TMPDIR": str(tmp_path)}, stdout=subprocess.PIPE, check=False
    )
    wait_until(lambda: not Path(f"/proc/{int(killed.stdout)}").exists())
    assert {path.name for path in tmp_path.iterdir()} == {"v", "v.lock"}


def test_connections_take_no_descriptor_of_the_daemon(tmp_path: Path) -> None:
    with Publisher(f"ipc://{tmp_path}/v"), contextlib.ExitStack() as stack:
        before = len(os.listdir("/proc/self/fd"))
        (process,) = processes()
        for _ in range(50):
            peer = stack.enter_context(socket.socket(socket.AF_UNIX))
            peer.connect(f"{tmp_path}/v")
        wait_until(lambda: len(os.listdir(f"/proc/{process}/fd")) > 50)
        assert len(os.listdir("/proc/self/fd")) == before + 50  # the other ends


def test_the_socket_process_ends_when_one_of_its_threads_ends(tmp_path: Path) -> None:
    with contextlib.closing(Listener(f"ipc://{tmp_path}/v")) as listener:
        plan = Plan(str(tmp_path), [listener.endpoint], [listener.fileno()], 10, [0], None)
        code = "import zmq; from graspd.daemon.publish import porter;"
        code += "zmq.proxy = lambda front, back: None; porter.main()"
        with subprocess.Popen(
            [sys.executable, "-c", code],
            stdin=subprocess.PIPE,
            stderr=subprocess.PIPE,
            pass_fds=[listener.fileno()],
        ) as process:
            assert process.stdin is not None
            assert process.stderr is not None
            process.stdin.write(json.dumps(plan).encode() + b"\n")
            process.stdin.flush()
            assert b"has ended" in process.stderr.readline()
            assert process.wait() == 1
