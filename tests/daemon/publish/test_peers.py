"""Peers without keys: what libzmq's own sockets get, and that who breaks a bound goes alone."""

from __future__ import annotations

import contextlib
import errno
import re
import select
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
import zmq

from daemon.publish import peers
from daemon.publish.peer import SUBSCRIPTIONS_MAX
from daemon.publish.peers import PEERS_MAX, PlainDoor
from daemon.publish.publisher import Publisher
from daemon.publish.questions import Questions
from tests.daemon.publish.test_publisher import WAIT_MS, Peers, endpoint_of, first_message
from tests.daemon.publish.test_zmtp import GREETING_31, READY_REQ, READY_SUB, octets

SUBSCRIBE_ALL = octets("00 01 01")
ENDLESS = octets("01 00") * 64


@pytest.fixture
def friends() -> Iterator[Peers]:
    made = Peers()
    yield made
    made.close()


@pytest.fixture
def raw() -> Iterator[Callable[[Path, bytes], socket.socket]]:
    with contextlib.ExitStack() as stack:

        def connect(path: Path, says: bytes) -> socket.socket:
            made = stack.enter_context(socket.socket(socket.AF_UNIX))
            made.settimeout(WAIT_MS / 1e3)
            made.connect(str(path))
            made.sendall(says)
            return made

        yield connect


Raw = Callable[[Path, bytes], socket.socket]


def until(done: Callable[[], object], look: Callable[[], object]) -> None:
    deadline_s = time.monotonic() + WAIT_MS / 1e3
    while not done():
        assert time.monotonic() < deadline_s
        look()


def hears(publisher: Publisher, subscriber: zmq.Socket[bytes]) -> bool:
    return first_message(publisher, subscriber) == [b"verdict.right", b"{}"]


def is_cut_off(connection: socket.socket) -> bool:
    """Whether the other side has closed; reads all that it sent."""
    connection.setblocking(False)
    try:
        while connection.recv(4096):
            pass
    except BlockingIOError:
        return False
    except ConnectionError:
        pass
    return True


@pytest.mark.parametrize("kind", [zmq.SUB, zmq.XSUB])
@pytest.mark.parametrize("scheme", ["ipc", "tcp"])
def test_every_kind_of_subscriber_hears(
    tmp_path: Path, friends: Peers, scheme: str, kind: int
) -> None:
    endpoint = endpoint_of(scheme, tmp_path)
    with Publisher(endpoint) as publisher:
        subscriber = friends.connect(kind, endpoint)
        if kind == zmq.XSUB:
            subscriber.send(b"\x01verdict.")
        else:
            subscriber.subscribe("verdict.")
        assert hears(publisher, subscriber)
        payload = b"x" * 70_000  # far more than the kernel is given at once
        publisher.send(b"verdict.right", payload)
        until(lambda: subscriber.poll(1), publisher.take)
        while (got := subscriber.recv_multipart()[1]) == b"{}":
            until(lambda: subscriber.poll(1), publisher.take)
        assert got == payload
        if kind == zmq.XSUB:
            subscriber.send(b"\x00verdict.")
        else:
            subscriber.unsubscribe("verdict.")
        until(lambda: not publisher.wanted(b"verdict.right"), publisher.take)


@pytest.mark.parametrize("kind", [zmq.REQ, zmq.DEALER])
@pytest.mark.parametrize("identity", [b"", b"controller", b"i" * 255])
@pytest.mark.parametrize("scheme", ["ipc", "tcp"])
def test_every_kind_of_asker_is_answered(
    tmp_path: Path, friends: Peers, scheme: str, identity: bytes, kind: int
) -> None:
    endpoint = endpoint_of(scheme, tmp_path)
    with Questions(endpoint, 10**9) as questions:
        asker = friends.context.socket(kind)
        asker.linger = 0
        if identity:
            asker.setsockopt(zmq.ROUTING_ID, identity)
        with asker:
            asker.connect(endpoint)
            for number in range(3):
                asker.send(b"judge")
                until(lambda: questions.waiting, lambda: questions.take(0))
                questions.answer(b"%d" % number)
                assert asker.poll(WAIT_MS)
                assert asker.recv() == b"%d" % number


def test_another_kind_of_socket_is_cut_off(tmp_path: Path, raw: Raw) -> None:
    with Publisher(f"ipc://{tmp_path}/v") as publisher:
        asker = raw(tmp_path / "v", GREETING_31 + READY_REQ)
        until(lambda: is_cut_off(asker), publisher.take)
        assert publisher.counters["cut_off"] == 1


def test_a_peer_that_wants_signs_of_life_gets_them(tmp_path: Path, friends: Peers) -> None:
    endpoint = f"ipc://{tmp_path}/v"
    with (
        Publisher(endpoint) as publisher,
        friends.context.socket(zmq.SUB) as subscriber,
        subscriber.get_monitor_socket(zmq.EVENT_DISCONNECTED) as monitor,
    ):
        subscriber.linger = 0
        subscriber.heartbeat_ivl, subscriber.heartbeat_timeout = 20, 100
        subscriber.subscribe("")
        subscriber.connect(endpoint)
        assert hears(publisher, subscriber)
        for _ in range(100):
            publisher.take()
            time.sleep(0.005)
        assert not monitor.poll(0)
        assert monitor.poll(WAIT_MS)  # nobody looks after the publisher any more
        subscriber.disable_monitor()


def test_a_subscriber_connects_again_after_a_restart(tmp_path: Path, friends: Peers) -> None:
    endpoint = f"ipc://{tmp_path}/v"
    with Publisher(endpoint) as publisher:
        subscriber = friends.subscribe(endpoint)
        assert hears(publisher, subscriber)
    while subscriber.poll(50):
        subscriber.recv_multipart()
    with Publisher(endpoint) as publisher:
        assert hears(publisher, subscriber)


def test_what_is_queued_is_sent_before_the_end(tmp_path: Path, friends: Peers) -> None:
    endpoint = f"ipc://{tmp_path}/v"
    with Publisher(endpoint) as publisher:
        subscriber = friends.subscribe(endpoint, high_water_mark=0)
        assert hears(publisher, subscriber)
        for number in range(500):
            publisher.send(b"status.right", b"%d" % number + b" " * 2000)
    received = []
    while subscriber.poll(500):
        topic, payload = subscriber.recv_multipart()
        if topic == b"status.right":
            received.append(int(payload))
    assert received == list(range(500))


def test_the_end_waits_for_nobody_for_long(tmp_path: Path, raw: Raw) -> None:
    publisher = Publisher(f"ipc://{tmp_path}/v", high_water_mark=10)
    deaf = raw(tmp_path / "v", GREETING_31 + READY_SUB + SUBSCRIBE_ALL)
    until(lambda: publisher.wanted(b"v"), publisher.take)
    for _ in range(1000):
        publisher.send(b"verdict.right", bytes(1000))
    assert publisher.counters["queues_full"] > 500
    began_s = time.monotonic()
    publisher.close()
    assert 0.4 < time.monotonic() - began_s < 2.0
    assert is_cut_off(deaf)


def test_who_comes_between_two_messages_hears_none_twice(tmp_path: Path, raw: Raw) -> None:
    with Publisher(f"ipc://{tmp_path}/v") as publisher:
        publisher.send(b"verdict.right", b"<1>")
        newcomer = raw(tmp_path / "v", GREETING_31 + READY_SUB + SUBSCRIBE_ALL)
        for number in range(2, 12):
            publisher.send(b"verdict.right", b"<%d>" % number)
        publisher.take()
        heard = b""
        while b"<11>" not in heard:
            heard += newcomer.recv(65536)
        publisher.take()
        newcomer.setblocking(False)
        with contextlib.suppress(BlockingIOError):
            heard += newcomer.recv(65536)
    numbers = [int(number) for number in re.findall(rb"<(\d+)>", heard)]
    assert numbers == sorted(set(numbers))


def test_who_reads_too_slowly_misses_the_oldest_messages(tmp_path: Path, raw: Raw) -> None:
    """Else messages of all times would be held for those who never read."""
    with Publisher(f"ipc://{tmp_path}/v", high_water_mark=10) as publisher:
        slow = raw(tmp_path / "v", GREETING_31 + READY_SUB + SUBSCRIBE_ALL)
        until(lambda: publisher.wanted(b"v"), publisher.take)
        for number in range(1000):
            publisher.send(b"verdict.right", b"<%d>" % number + bytes(1000))
        slow.setblocking(False)
        heard = b""
        with contextlib.suppress(BlockingIOError):
            while b"<999>" not in heard:
                heard += slow.recv(65536)
                publisher.take()
    numbers = [int(number) for number in re.findall(rb"<(\d+)>", heard)]
    assert numbers[:10] == list(range(10))
    assert numbers[-10:] == list(range(990, 1000))
    assert len(numbers) < 500


@pytest.mark.parametrize(
    "says", [b"", octets("ff 00 00"), GREETING_31], ids=["", "half", "no READY"]
)
def test_strangers_make_place_for_who_comes_after_them(
    tmp_path: Path, friends: Peers, raw: Raw, says: bytes
) -> None:
    endpoint = f"ipc://{tmp_path}/v"
    with Publisher(endpoint) as publisher:
        for _ in range(PEERS_MAX + 50):
            raw(tmp_path / "v", says)
            publisher.take()
        assert hears(publisher, friends.subscribe(endpoint))
        assert publisher.counters["crowded_out"] > 50


def test_who_is_there_stays_when_there_is_no_place_for_more(
    tmp_path: Path, friends: Peers, raw: Raw
) -> None:
    endpoint = f"ipc://{tmp_path}/v"
    with Publisher(endpoint) as publisher:
        subscriber = friends.subscribe(endpoint)
        assert hears(publisher, subscriber)
        crowd = []
        for _ in range(PEERS_MAX - 1):
            crowd.append(raw(tmp_path / "v", GREETING_31 + READY_SUB + SUBSCRIBE_ALL))
            publisher.take()
        until(lambda: publisher.counters["subscriptions"] == PEERS_MAX, publisher.take)
        late = raw(tmp_path / "v", b"")
        until(lambda: is_cut_off(late), publisher.take)
        assert publisher.counters["crowded_out"] == 1
        assert hears(publisher, subscriber)
        crowd[0].close()
        assert hears(publisher, friends.subscribe(endpoint))


CROWD = """
import socket, sys, time
held = []
for _ in range(int(sys.argv[2])):
    held.append(socket.socket(socket.AF_UNIX))
    held[-1].connect(sys.argv[1])
    held[-1].sendall(bytes.fromhex(sys.argv[3]))
print("there", flush=True)
time.sleep(60)
"""


def test_a_process_that_has_taken_all_places_leaves_some_to_others(
    tmp_path: Path, friends: Peers
) -> None:
    endpoint = f"ipc://{tmp_path}/v"
    says = (GREETING_31 + READY_SUB + SUBSCRIBE_ALL).hex()
    arguments = [sys.executable, "-c", CROWD, str(tmp_path / "v"), str(PEERS_MAX), says]
    with (
        Publisher(endpoint) as publisher,
        subprocess.Popen(arguments, stdout=subprocess.DEVNULL) as crowd,
    ):
        try:
            until(lambda: publisher.counters["subscriptions"] == PEERS_MAX, publisher.take)
            subscribers = [friends.subscribe(endpoint) for _ in range(3)]
            assert all(hears(publisher, subscriber) for subscriber in subscribers)
            assert publisher.counters["crowded_out"] == 3
        finally:
            crowd.kill()


def test_who_does_not_say_what_it_is_goes_after_a_while(
    tmp_path: Path, raw: Raw, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(peers, "HANDSHAKE_NS", 50_000_000)
    with Publisher(f"ipc://{tmp_path}/v") as publisher:
        silent, talking = (raw(tmp_path / "v", says) for says in (b"\xff", GREETING_31 + READY_SUB))
        until(lambda: is_cut_off(silent), publisher.take)
        assert publisher.counters["cut_off"] == 1
        assert not is_cut_off(talking)


@pytest.mark.parametrize("role", ["publish", "ask"])
def test_a_message_without_an_end_cuts_off_its_sender_alone(
    tmp_path: Path, raw: Raw, role: str
) -> None:
    type_ = READY_SUB if role == "publish" else READY_REQ
    made: Publisher | Questions
    made = (
        Publisher(f"ipc://{tmp_path}/v")
        if role == "publish"
        else Questions(f"ipc://{tmp_path}/v", 10**9)
    )
    with made:
        friend = raw(tmp_path / "v", GREETING_31 + type_)
        hostile = raw(tmp_path / "v", GREETING_31 + type_ + ENDLESS)
        until(lambda: is_cut_off(hostile), made.door.receive)
        assert made.counters["cut_off"] == 1
        assert not is_cut_off(friend)


def test_a_peer_has_so_many_subscriptions_and_no_more(tmp_path: Path, raw: Raw) -> None:
    with Publisher(f"ipc://{tmp_path}/v") as publisher:
        said = GREETING_31 + READY_SUB
        for number in range(SUBSCRIPTIONS_MAX):
            said += octets("00 03 01") + number.to_bytes(2, "big")
        well = raw(tmp_path / "v", said * 1)
        hostile = raw(tmp_path / "v", said + SUBSCRIBE_ALL)
        until(lambda: is_cut_off(hostile), publisher.take)
        assert not is_cut_off(well)
        assert publisher.counters["cut_off"] == 1


@pytest.mark.parametrize("number", [errno.EMFILE, errno.ENFILE, errno.ENOBUFS, errno.ENOMEM])
def test_without_descriptors_it_rests_and_goes_on(
    tmp_path: Path, friends: Peers, monkeypatch: pytest.MonkeyPatch, number: int
) -> None:
    class Exhausted:
        """A listener for whose connections there is no descriptor."""

        asked = 0

        def accept(self) -> None:
            self.asked += 1
            raise OSError(number, "none left")

    endpoint = f"ipc://{tmp_path}/v"
    with Publisher(endpoint) as publisher:
        assert isinstance(publisher.door, PlainDoor)
        subscriber = friends.subscribe(endpoint)
        exhausted = Exhausted()
        with monkeypatch.context() as patch:
            patch.setattr(publisher.door, "_listener", exhausted)
            until(lambda: exhausted.asked, publisher.take)
            assert not select.select([publisher], [], [], 0.0)[0]  # it does not spin
            publisher.take()
            assert exhausted.asked == 1
        assert hears(publisher, subscriber)


def test_a_flood_leaves_the_others_their_share(tmp_path: Path, raw: Raw) -> None:
    with Questions(f"ipc://{tmp_path}/v", 10**9) as questions:
        loud = raw(tmp_path / "v", GREETING_31 + READY_REQ)
        loud.setblocking(False)
        began_s = time.monotonic()
        while time.monotonic() - began_s < 1.0:
            with contextlib.suppress(BlockingIOError):
                loud.send(octets("00 05 6a 75 64 67 65") * 500)
            questions.take(0)
        # 4096 bytes in a tenth of a second, of seven each
        assert 500 < questions.counters["asked"] < 12 * (4096 + 512) / 7
