"""Peers with keys: what bounds their number and their memory, which libzmq does not."""

from __future__ import annotations

import contextlib
import ctypes
import mmap
import socket
import time
from collections.abc import Iterator

import pytest
import zmq

from daemon.publish import access
from daemon.publish.binding import Peer, PublishError
from daemon.publish.curve import FREED_NS, GROWTH_MAX_BYTES, LOOK_NS, CurvePeer, Guard
from tests.daemon.publish.test_keys import PATIENCE_S, Door, door

__all__ = ["door"]


@pytest.fixture
def guarded() -> Iterator[tuple[Guard, list[str]]]:
    ctypes.CDLL(None).malloc_trim(0)  # what other tests left is not given back in the middle
    cut_off: list[str] = []
    guard = Guard(lambda: cut_off.append("all"))
    yield guard, cut_off
    guard.close()


def memory() -> mmap.mmap:
    """More than peers may hold, from the kernel and given back to it when it is closed.

    Much more: meanwhile the kernel may take back pages of files that this process had in memory.
    """
    made = mmap.mmap(-1, GROWTH_MAX_BYTES + (64 << 20))
    for at in range(0, len(made), mmap.PAGESIZE):
        made[at] = 1
    return made


def test_what_peers_hold_is_bounded_and_let_go_is_no_reason(
    guarded: tuple[Guard, list[str]],
) -> None:
    guard, cut_off = guarded
    now_ns = 0
    for times in (1, 2):
        guard.look(now_ns := now_ns + LOOK_NS)
        assert len(cut_off) == times - 1
        held = memory()
        guard.look(now_ns + LOOK_NS - 1)  # too early to look again
        assert len(cut_off) == times - 1
        guard.look(now_ns := now_ns + LOOK_NS)
        assert len(cut_off) == times
        held.close()
        guard.look(now_ns := now_ns + FREED_NS)
        guard.look(now_ns := now_ns + LOOK_NS)
        assert len(cut_off) == times


def test_memory_that_is_not_the_peers_cuts_them_off_once(guarded: tuple[Guard, list[str]]) -> None:
    guard, cut_off = guarded
    held = memory()
    now_ns = 0
    for _ in range(10):
        guard.look(now_ns := now_ns + FREED_NS)
    assert cut_off == ["all"]
    held.close()


def test_all_who_were_cut_off_connect_again(door: Door, caplog: pytest.LogCaptureFixture) -> None:
    friend = door.connect(door.known)
    assert door.hears(friend, PATIENCE_S)
    held = memory()
    time.sleep(LOOK_NS / 1e9)
    door.sockets.take()
    assert "hold too much memory" in caplog.text
    assert door.sockets.counters["publish"]["all_cut_off"] == 1
    while friend.poll(100):
        friend.recv_multipart()
    assert door.hears(friend, PATIENCE_S)
    held.close()


def test_strangers_make_place_and_friends_stay(door: Door, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(access, "STRANGERS_MAX", 5)
    friend = door.connect(door.known)
    assert door.hears(friend, PATIENCE_S)
    with contextlib.ExitStack() as stack:
        for _ in range(25):
            stack.enter_context(socket.create_connection(("127.0.0.1", door.port), PATIENCE_S))
        door.until(lambda: door.counted("crowded_out") == 20)
        assert door.hears(friend, PATIENCE_S)
        assert door.hears(door.connect(door.known), PATIENCE_S)
        assert door.counted("admitted") == 2


def test_a_key_stands_for_itself_whatever_the_connection(door: Door) -> None:
    questions = door.sockets.questions
    assert questions is not None
    peers: list[Peer] = []
    for number in (1, 2):
        door.connect(door.known, zmq.DEALER).send(b"judge")

        def has_asked(number: int = number) -> bool:
            peers.extend(peer for peer, _ in questions.door.receive())
            return len(peers) == number

        door.until(has_asked)
    assert peers[0] != peers[1]
    assert peers[0].stands_for(peers[1])
    assert [peer.user for peer in peers if isinstance(peer, CurvePeer)] == ["controller"] * 2


def test_a_door_that_is_closed_says_so(door: Door) -> None:
    made = door.sockets.publisher.door
    made.close()
    assert not made.is_open
    assert made.publish(b"verdict.right", b"{}")
    assert not made.receive()
    with pytest.raises(PublishError):
        made.fileno()
