"""The subscriber of `graspd watch`: nothing old after a pause, and why it is turned away."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path

import pytest

from graspd.daemon.judge.reasons import Decision
from graspd.daemon.publish.keys import KeysError, make
from graspd.daemon.watch.feed import Feed, load_keys
from graspd.daemon.watch.view import View
from tests.daemon.fakes import Clock
from tests.daemon.publish.doors import Asked, KeyedDoor, Peers, Publisher, first_message
from tests.daemon.watch.watch_fakes import MS, verdict
from tests.kit.messages import decode_verdict
from tests.kit.waiting import wait_until
from tests.ports import free_ipv6_endpoint

Keys = tuple[bytes, bytes, bytes]


def first_of(publisher: Publisher, feed: Feed, seq: int, decision: Decision) -> list[bytes]:
    """Publish a verdict until messages come to `feed`; return their payloads."""
    found: list[bytes] = []

    def has_come() -> bool:
        publisher.send(b"verdict.right", verdict(seq, decision))
        found.extend(payload for _, payload in feed.take())
        return bool(found)

    wait_until(has_come, 0.01)
    return found


def test_messages_unread_for_over_a_second_are_not_shown(endpoint: str) -> None:
    clock = Clock()
    with (
        closing(Peers()) as peers,
        Publisher(endpoint) as publisher,
        Feed(endpoint, clock=clock) as feed,
    ):
        first_of(publisher, feed, 0, Decision.STABLE)
        other = peers.subscribe(endpoint)
        first_message(publisher, other)
        last = verdict(49, Decision.STABLE)
        for seq in range(1, 50):
            publisher.send(b"verdict.right", verdict(seq, Decision.STABLE))
        while other.recv_multipart()[1] != last:  # the daemon has sent them to all
            pass
        clock.now_ns += 1001 * MS
        assert list(feed.take()) == []
        for payload in first_of(publisher, feed, 50, Decision.SLIP):
            assert decode_verdict(payload).seq == 50


def test_an_unread_messages_age_counts_from_the_last_empty_queue(endpoint: str) -> None:
    clock, view = Clock(), View(endpoint)
    found: list[bytes] = []
    with Publisher(endpoint) as publisher, Feed(endpoint, clock=clock) as feed:

        def has_come() -> bool:
            """Look 900 ms after the queue was last seen empty."""
            publisher.send(b"verdict.right", verdict(1, Decision.STABLE))
            clock.now_ns += 900 * MS
            for topic, payload in feed.take():
                view.take(topic, payload, feed.empty_ns)
                found.append(payload)
            return bool(found)

        wait_until(has_come, 0.01)
    assert view.snapshot(clock.now_ns).headline == "unknown"
    assert view.snapshot(clock.now_ns - 900 * MS).headline == "stable"


def test_a_viewer_reaches_a_daemon_on_an_ipv6_address() -> None:
    endpoint = free_ipv6_endpoint()
    with Publisher(endpoint) as publisher, Feed(endpoint) as feed:
        (message, *_) = first_of(publisher, feed, 0, Decision.STABLE)
    assert decode_verdict(message).verdict == "stable"


@pytest.fixture
def door(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[KeyedDoor]:
    """A daemon's sockets that accept the key of `controller` and refuse that of `stranger`."""
    made = KeyedDoor(tmp_path, monkeypatch)
    made.client("stranger", tmp_path / "theirs")
    yield made
    made.close()


def keys_of(folder: Path, own: str = "controller", daemon: str = "daemon.key") -> Keys:
    return load_keys(folder / "theirs" / f"{own}.key_secret", folder / daemon)


def hears(door: KeyedDoor, feed: Feed, until: Callable[[bool], bool]) -> bool:
    heard: set[bytes] = set()

    def is_over() -> bool:
        door.sockets.before_wait(Asked())
        door.sockets.send(b"verdict.right", verdict(0))
        heard.update(topic for topic, _ in feed.take())
        return until(b"verdict.right" in heard)

    wait_until(is_over, 0.01, says=feed.link)
    return b"verdict.right" in heard


@pytest.mark.parametrize(
    ("own", "server", "said"),
    [
        ("stranger", "daemon.key", "the daemon does not know this key"),
        ("controller", "theirs/stranger.key", "is the daemon's key right?"),
        (None, "", "the daemon wants a key"),
    ],
)
def test_a_refused_viewers_link_says_the_likely_cause(
    tmp_path: Path, door: KeyedDoor, own: str | None, server: str, said: str
) -> None:
    keys = None if own is None else keys_of(tmp_path, own, server)
    with Feed(door.endpoint, keys) as feed:
        assert not hears(door, feed, lambda heard: heard or feed.link.is_turned_away)
        assert said in feed.link
        rounds = itertools.count()  # what is tried again says the same
        assert not hears(door, feed, lambda heard: heard or next(rounds) > 50)
        assert said in feed.link


def test_a_refused_viewer_connects_once_its_key_is_known(tmp_path: Path, door: KeyedDoor) -> None:
    clock = Clock()
    with Feed(door.endpoint, keys_of(tmp_path, "stranger"), clock) as feed:
        hears(door, feed, lambda _: feed.link.is_turned_away)
        (tmp_path / "theirs" / "stranger.key").rename(door.clients / "stranger.key")
        door.knows(2)
        for _ in range(6):  # looks, and is not paused
            clock.now_ns += 900 * MS
            list(feed.take())
        hears(door, feed, lambda heard: heard)
        assert feed.link == "connected"


def test_wrong_key_files_are_refused_with_the_cause(tmp_path: Path) -> None:
    make(tmp_path, "own")
    own = tmp_path / "own.key_secret"
    empty = tmp_path / "empty.key"
    empty.write_text("")
    with pytest.raises(KeysError, match=r"no\.key: cannot read the daemon's key"):
        load_keys(own, tmp_path / "no.key")
    with pytest.raises(KeysError, match="has no public key"):
        load_keys(own, empty)
    own.chmod(0o644)
    with pytest.raises(KeysError, match="chmod 600"):
        load_keys(own, tmp_path / "own.key")
