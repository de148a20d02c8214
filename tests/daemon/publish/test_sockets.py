"""Who comes late, who may connect, and hostile peers at every door."""

from __future__ import annotations

import grp
import os
import random
import stat
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import zmq

from daemon import scene
from daemon.publish.binding import PublishError
from daemon.publish.publisher import REPEAT_NS, VERDICT_REPEATED_NS, Publisher
from daemon.publish.sockets import Sockets, plan
from tests.daemon.fakes import Clock
from tests.daemon.publish.test_publisher import Peers

PATIENCE_MS = 100_000
HOSTILE_MESSAGES = 10_000


@pytest.fixture
def peers() -> Iterator[Peers]:
    peers = Peers()
    yield peers
    peers.close()


def wanted(
    folder: Path, ask: dict[str, str | None] | None = None, **publish: object
) -> scene.Scene:
    text: dict[str, Any] = {
        "tactile": {"driver": "replay", "recordings": ["any.csv"]},
        "publish": {"endpoint": f"ipc://{folder}/v", **publish},
        "ask": {"endpoint": f"ipc://{folder}/ask", **(ask or {})},
    }
    return scene.parse(text, folder / "scene.toml")


def until(done: Callable[[], object], sockets: Sockets) -> None:
    deadline_s = time.monotonic() + PATIENCE_MS / 1e3
    while not done():
        assert time.monotonic() < deadline_s
        sockets.take()
        time.sleep(0.002)


def until_heard(publisher: Publisher, late: zmq.Socket[bytes], seconds: float = 10.0) -> bool:
    deadline_s = time.monotonic() + seconds
    while time.monotonic() < deadline_s:
        publisher.take()
        if late.poll(2):
            return True
    return False


def test_who_comes_late_gets_the_last_verdict_and_status_that_it_wants_at_once(
    tmp_path: Path, peers: Peers
) -> None:
    clock = Clock()
    endpoint = f"ipc://{tmp_path}/v"
    with Publisher(endpoint, clock=clock) as publisher:
        for number in range(3):
            publisher.send(b"verdict.right", b"%d" % number)
            publisher.send(b"status.right", b"s%d" % number)
        clock.now_ns += VERDICT_REPEATED_NS
        late = peers.subscribe(endpoint, "verdict.")
        assert until_heard(publisher, late)
        assert late.recv_multipart() == [b"verdict.right", b"2"]
        assert not late.poll(100)


def test_an_old_verdict_is_not_repeated_as_if_it_were_new(tmp_path: Path, peers: Peers) -> None:
    clock = Clock()
    endpoint = f"ipc://{tmp_path}/v"
    with Publisher(endpoint, clock=clock) as publisher:
        publisher.send(b"verdict.right", b"stable")
        publisher.send(b"status.right", b"s")
        clock.now_ns += VERDICT_REPEATED_NS + 1
        late = peers.subscribe(endpoint)
        assert until_heard(publisher, late)
        assert late.recv_multipart() == [b"status.right", b"s"]
        assert not until_heard(publisher, late, 0.2)


def test_nothing_is_repeated_of_a_run_that_has_ended(tmp_path: Path, peers: Peers) -> None:
    endpoint = f"ipc://{tmp_path}/v"
    with Publisher(endpoint, clock=Clock()) as publisher:
        publisher.send(b"verdict.right", b"stable")
        publisher.forget()
        assert not until_heard(publisher, peers.subscribe(endpoint), 0.3)


@pytest.mark.parametrize("topic", [b"tactile.right", b"gate.right", b"outcome.right"])
def test_what_happened_once_is_never_repeated(tmp_path: Path, peers: Peers, topic: bytes) -> None:
    endpoint = f"ipc://{tmp_path}/v"
    with Publisher(endpoint, clock=Clock()) as publisher:
        publisher.send(topic, b"old")
        assert not until_heard(publisher, peers.subscribe(endpoint), 0.3)


def test_nothing_is_repeated_before_anything_was_sent(tmp_path: Path, peers: Peers) -> None:
    with Sockets(wanted(tmp_path)) as sockets:
        early = peers.subscribe(f"ipc://{tmp_path}/v")
        until(lambda: sockets.publisher.counters["subscriptions"], sockets)
        assert not early.poll(100)
        assert sockets.publisher.counters["repeated"] == 0


def test_many_who_come_at_once_do_not_make_a_storm(tmp_path: Path, peers: Peers) -> None:
    with Sockets(wanted(tmp_path)) as sockets:
        sockets.send(b"status.right", b"1")
        start_s = time.monotonic()
        late = [peers.subscribe(f"ipc://{tmp_path}/v") for _ in range(30)]
        until(lambda: all(each.poll(0) for each in late), sockets)
        elapsed_ns = (time.monotonic() - start_s) * 1e9
        assert sockets.publisher.counters["repeated"] <= elapsed_ns / REPEAT_NS + 2


def test_files_of_sockets_have_the_mode_and_the_group_of_the_scene(tmp_path: Path) -> None:
    group = grp.getgrgid(os.getgroups()[0] if os.getgroups() else os.getgid()).gr_name
    with Sockets(wanted(tmp_path, file_mode="0620", group=group)):
        for name in ("v", "ask"):
            status = (tmp_path / name).stat()
            assert stat.S_IMODE(status.st_mode) == 0o620
            assert status.st_gid == grp.getgrnam(group).gr_gid


@pytest.mark.parametrize(
    ("publish", "ask", "mode"),
    [
        ("0666", None, 0o660),
        ("0666", "0600", 0o600),
        ("0640", "0666", 0o666),
        (None, "0620", 0o620),
    ],
)
def test_who_may_ask_is_for_the_scene_to_say_and_never_everybody_unless_it_says_so(
    tmp_path: Path, publish: str | None, ask: str | None, mode: int
) -> None:
    former = os.umask(0o022)
    try:
        with Sockets(wanted(tmp_path, ask={"file_mode": ask}, file_mode=publish)):
            assert stat.S_IMODE((tmp_path / "ask").stat().st_mode) == mode
            published = stat.S_IMODE((tmp_path / "v").stat().st_mode)
            assert published == (0o755 if publish is None else int(publish, 8))
    finally:
        os.umask(former)


@pytest.mark.skipif(os.geteuid() != 0, reason="only root may give a file to any group")
def test_the_socket_for_questions_has_a_group_of_its_own(tmp_path: Path) -> None:
    with Sockets(wanted(tmp_path, ask={"group": "daemon"}, group="nogroup")):
        assert (tmp_path / "ask").group() == "daemon"
        assert (tmp_path / "v").group() == "nogroup"


def test_an_unknown_group_is_said(tmp_path: Path) -> None:
    with pytest.raises(PublishError, match="no group no-such-group"):
        Sockets(wanted(tmp_path, group="no-such-group"))
    assert list(tmp_path.iterdir()) == []


def test_scenes_share_sockets_exactly_if_they_want_the_same(tmp_path: Path) -> None:
    same, other = wanted(tmp_path), wanted(tmp_path, high_water_mark=7)
    assert plan(same) == plan(wanted(tmp_path))
    assert plan(same) != plan(other)


def junk(rng: random.Random) -> list[bytes]:
    """Subscriptions, questions and what is neither; of any length, of up to five frames."""
    kind = rng.randrange(6)
    if kind == 0:
        return [bytes([rng.randrange(3)]) + rng.randbytes(rng.randrange(200))]
    if kind == 1:
        return [b"judge", b"judge"]
    if kind == 2:
        return [rng.randbytes(rng.choice((0, 1, 63, 64, 65, 127, 128, 129, 5000)))]
    if kind == 3:
        return [b""] * rng.randrange(1, 5)
    if kind == 4:
        return [b"", b"judge" + rng.randbytes(3)]
    return [rng.randbytes(rng.randrange(8)) for _ in range(rng.randrange(1, 5))]


@pytest.mark.parametrize(("door", "kind"), [("v", zmq.XSUB), ("ask", zmq.DEALER)])
def test_ten_thousand_hostile_messages_do_no_harm(
    tmp_path: Path, peers: Peers, door: str, kind: int
) -> None:
    rng = random.Random(1)
    with Sockets(wanted(tmp_path)) as sockets:
        questions = sockets.questions
        assert questions is not None
        hostile = peers.connect(kind, f"ipc://{tmp_path}/{door}")
        sent = 0
        while sent < HOSTILE_MESSAGES:
            try:
                hostile.send_multipart(junk(rng), zmq.NOBLOCK)
                sent += 1
            except zmq.Again:  # it is cut off for a moment, or not read so fast
                pass
            if sent % 20 == 0:
                sockets.take()
                questions.take(time.monotonic_ns())
                questions.answer(b"{}")
        friend = peers.subscribe(f"ipc://{tmp_path}/v", "verdict.")
        asker = peers.connect(zmq.REQ, f"ipc://{tmp_path}/ask")
        asker.send(b"judge")

        def served() -> bool:
            sockets.send(b"verdict.right", b"{}")
            questions.take(time.monotonic_ns())
            questions.answer(b"{}")
            return bool(friend.poll(0) and asker.poll(0))

        until(served, sockets)
        assert friend.recv_multipart() == [b"verdict.right", b"{}"]
        assert asker.recv() == b"{}"
        counted = sockets.counters
        if door == "ask":
            assert counted["ask"]["malformed"] > HOSTILE_MESSAGES / 100
        else:
            assert counted["publish"]["subscriptions"] > 1
