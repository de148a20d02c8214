"""Rates, rights of socket files, questions for the loop, and hostile peers."""

from __future__ import annotations

import grp
import os
import random
import select
import signal
import stat
from pathlib import Path

import pytest
import zmq

from graspd.daemon.judge.reasons import Reason
from graspd.daemon.publish import PublishError
from graspd.daemon.publish.sockets import Sockets
from graspd.daemon.trust.lift_book import GraspId
from tests.daemon.fakes import Clock
from tests.daemon.publish.doors import USER, Asked, Peers, halt, processes, published, scene_of
from tests.kit.waiting import PATIENCE_S, wait_until

HOSTILE_MESSAGES = 2_000


@pytest.mark.parametrize(
    ("sensor_hz", "tactile_hz", "published"),
    [(100, 25.0, 25), (100, 100.0, 100), (100, 400.0, 100), (100, 10.0, 10), (100, 0.0, 0)],
)
def test_readings_are_published_at_the_rate_of_the_scene(
    tmp_path: Path, sensor_hz: int, tactile_hz: float, published: int
) -> None:
    clock = Clock()
    jitter = random.Random(3)
    with Sockets(scene_of(tmp_path, publish={"tactile_hz": tactile_hz}), clock) as sockets:
        times = 0
        for number in range(10 * sensor_hz):
            clock.now_ns = number * 10**9 // sensor_hz + jitter.randrange(1_000_000)
            times += sockets.wanted(b"tactile.right")
    assert times == pytest.approx(10 * published, abs=1)


def test_after_a_pause_only_one_reading_is_due(tmp_path: Path) -> None:
    clock = Clock()
    with Sockets(scene_of(tmp_path, publish={"tactile_hz": 10.0}), clock) as sockets:
        assert sockets.wanted(b"tactile.right")
        clock.now_ns += 10 * 10**9
        assert [sockets.wanted(b"tactile.right") for _ in range(3)] == [True, False, False]


def test_questions_and_outcomes_reach_the_loop_and_are_answered(
    tmp_path: Path, peers: Peers
) -> None:
    requests = Asked()
    with Sockets(scene_of(tmp_path)) as sockets:
        asker = peers.connect(zmq.DEALER, f"ipc://{tmp_path}/ask")
        asker.send(b"judge")
        asker.send(b"outcome " + b"0" * 32 + b" 7 slip")

        def has_come() -> bool:
            sockets.before_wait(requests)
            return bool(requests.times and requests.outcomes)

        wait_until(has_come)
        (report,) = requests.outcomes
        assert report[:3] == (GraspId("0" * 32, 7), "slip", None)
        assert asker.recv() == b'{"v":1,"ok":true}'
        assert sockets.questions is not None
        sockets.questions.answer(published())
        assert asker.recv() == b"{}"
        counters = sockets.counters
    assert counters["publish"] == {"dropped": 0}
    assert (counters["ask"]["asked"], counters["ask"]["outcomes"]) == (1, 1)


def test_waiting_for_the_descriptor_misses_no_question(tmp_path: Path, peers: Peers) -> None:
    with Sockets(scene_of(tmp_path)) as sockets:
        questions, due_ns = sockets.questions, sockets.before_wait(Asked())
        assert questions is not None
        asker = peers.connect(zmq.DEALER, f"ipc://{tmp_path}/ask")
        for _ in range(100):
            asker.send(b"clock")
        while questions.counters["clocks"] < 100:
            if due_ns is None:  # it may be ready for less
                assert select.select(sockets.filenos, [], [], PATIENCE_S)[0]
            due_ns = sockets.before_wait(Asked())


def test_the_health_says_when_subscribers_get_messages_late(tmp_path: Path) -> None:
    with Sockets(scene_of(tmp_path)) as sockets:
        assert sockets.health == {}
        (process,) = processes()
        halt(process)
        sockets.send(b"status.right", b"{}")

        def is_late() -> bool:
            sockets.before_wait(Asked())
            return sockets.health == {"publish": Reason.HEARD_LATE}

        wait_until(is_late)
        os.kill(process, signal.SIGCONT)
        sockets.send(b"status.right", b"{}")
        assert sockets.health == {}


def test_closed_sockets_count_messages_and_answers_as_dropped(tmp_path: Path) -> None:
    sockets = Sockets(scene_of(tmp_path))
    assert sockets.questions is not None
    sockets.questions.take([[b"asker", USER, b"judge"]], 0, Asked())
    sockets.close()
    sockets.close()
    sockets.send(b"verdict.right", b"{}")
    sockets.questions.answer(published())
    counters = sockets.counters
    assert (counters["publish"]["dropped"], counters["ask"]["dropped"]) == (1, 1)
    assert list(tmp_path.iterdir()) == []


def test_socket_files_have_the_scenes_mode_and_group(tmp_path: Path) -> None:
    group = grp.getgrgid(os.getgroups()[0] if os.getgroups() else os.getgid()).gr_name
    with Sockets(scene_of(tmp_path, publish={"file_mode": "0620", "group": group})):
        for name in ("v", "ask"):
            status = (tmp_path / name).stat()
            assert stat.S_IMODE(status.st_mode) == 0o620
            assert status.st_gid == grp.getgrnam(group).gr_gid


@pytest.mark.parametrize(("publish", "mode"), [("0666", 0o660), ("0640", 0o640), (None, 0o755)])
def test_users_outside_owner_and_group_may_not_ask(
    tmp_path: Path, publish: str | None, mode: int
) -> None:
    former = os.umask(0o022)
    try:
        with Sockets(scene_of(tmp_path, publish={"file_mode": publish})):
            assert stat.S_IMODE((tmp_path / "ask").stat().st_mode) == mode
            published = stat.S_IMODE((tmp_path / "v").stat().st_mode)
            assert published == (0o755 if publish is None else int(publish, 8))
    finally:
        os.umask(former)


def test_an_unknown_group_is_refused_and_leaves_no_file(tmp_path: Path) -> None:
    with pytest.raises(PublishError, match="no group no-such-group"):
        Sockets(scene_of(tmp_path, publish={"group": "no-such-group"}))
    assert list(tmp_path.iterdir()) == []


def test_a_long_temporary_path_is_refused_and_left_empty(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / ("x" * 90)  # unix(7): a socket's path has at most 107 bytes
    folder.mkdir()
    monkeypatch.setattr("tempfile.tempdir", str(folder))
    with pytest.raises(PublishError, match="no sockets below TMPDIR: File name too long"):
        Sockets(scene_of(tmp_path))
    assert [*tmp_path.rglob("*")] == [folder]


def junk(rng: random.Random) -> list[bytes]:
    """Return a message of up to four random frames: a subscription, a question, or neither."""
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
def test_after_hostile_messages_other_peers_are_still_served(
    tmp_path: Path, peers: Peers, door: str, kind: int
) -> None:
    rng, requests = random.Random(1), Asked()
    with Sockets(scene_of(tmp_path)) as sockets:
        questions = sockets.questions
        assert questions is not None
        hostile = peers.connect(kind, f"ipc://{tmp_path}/{door}")
        sent = 0
        while sent < HOSTILE_MESSAGES:
            try:
                hostile.send_multipart(junk(rng), zmq.NOBLOCK)
                sent += 1
            except zmq.Again:  # it is disconnected for a moment, or not read so fast
                pass
            if sent % 20 == 0:
                sockets.before_wait(requests)
                questions.answer(published())
        friend = peers.subscribe(f"ipc://{tmp_path}/v", "verdict.")
        asker = peers.connect(zmq.REQ, f"ipc://{tmp_path}/ask")
        asker.send(b"judge")

        def served() -> bool:
            sockets.send(b"verdict.right", b"{}")
            sockets.before_wait(requests)
            questions.answer(published())
            return bool(friend.poll(0) and asker.poll(0))

        wait_until(served)
        assert friend.recv_multipart() == [b"verdict.right", b"{}"]
        assert asker.recv() == b"{}"
        if door == "ask":
            assert questions.counters["malformed"] > HOSTILE_MESSAGES / 100
