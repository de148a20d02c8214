"""Sockets, loop and keeper together: an outcome is answered when it is kept, and nothing waits."""

from __future__ import annotations

import json
import threading
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest
import zmq

from graspd.daemon.process.signals import StopSignal
from graspd.daemon.publish.companion import Companion, PublishedVerdict
from graspd.daemon.publish.outbox import Outbox
from graspd.daemon.publish.sockets import Sockets
from graspd.daemon.run.loop import Ended, Loop, LoopTiming
from graspd.daemon.scene import parse
from graspd.daemon.session.file import SessionFile, load
from graspd.daemon.session.keeper import WAIT_S, SessionKeeper
from graspd.daemon.trust.trust import Trust, decode
from tests.daemon.fakes import FINGERS, MS, Clock, FakeDriver, FakeModel, pipeline, reading
from tests.daemon.session.learning import BOOT, sensors
from tests.daemon.session.test_keeping import Disk

READINGS = 400


@pytest.fixture
def disk(monkeypatch: pytest.MonkeyPatch) -> Disk:
    return Disk(monkeypatch)


class Controller(Companion):
    """Tells the outcome of the third grasp when it hears of it, and lets the disk go on later."""

    def __init__(self, endpoint: str, disk: Disk, goes_on_at: int | None) -> None:
        self.context = zmq.Context()
        self.socket = self.context.socket(zmq.DEALER)
        self.socket.linger = 0
        self.socket.connect(endpoint)
        self.disk = disk
        self.goes_on_at = goes_on_at
        self.verdicts = 0
        self.answered_at: int | None = None
        self.answer: dict[str, Any] | None = None

    def on_verdict(self, published: PublishedVerdict) -> None:
        self.verdicts += 1
        if self.verdicts == 3:
            self.socket.send(f"outcome {BOOT} {published.verdict.grasp} slip".encode())
        if self.verdicts == self.goes_on_at:
            assert self.answer is None
            self.disk.goes_on.set()
        if self.socket.poll(1):
            self.hear(0)

    def hear(self, wait_ms: int) -> None:
        if self.socket.poll(wait_ms):
            self.answered_at, self.answer = self.verdicts, json.loads(self.socket.recv())

    def close(self) -> None:
        self.context.destroy(0)


class Lab:
    """A run of the daemon, as `Runner` puts it together and ends it."""

    def __init__(self, folder: Path, disk: Disk, goes_on_at: int | None, stop: StopSignal) -> None:
        self.trust, self.path = Trust("fake", 0), folder / "right.json"
        clock = Clock()
        sections = {
            "tactile": {"driver": "spi", "port": "/nowhere"},
            "publish": {"endpoint": f"ipc://{folder}/p"},
            "ask": {"endpoint": f"ipc://{folder}/ask"},
        }
        scene = parse(sections, folder / "scene.toml")
        judge = pipeline(FakeModel(0.2), clock, trust=self.trust)
        judge.boot_id = BOOT
        with closing(Sockets(scene, clock)) as sockets:
            self.controller = Controller(f"ipc://{folder}/ask", disk, goes_on_at)
            with SessionFile(self.path) as file:
                keeper = SessionKeeper(
                    None,
                    FINGERS,
                    sensors(),
                    file,
                    judge.sensors_exchanged,
                    trust=self.trust,
                    clock=clock,
                )
                driver = FakeDriver([reading(clock(), seed) for seed in range(READINGS)], clock)
                outbox = Outbox("right", FINGERS, "fake", "0" * 64, [sockets], clock, boot_id=BOOT)
                companions = [sockets, keeper, self.controller]
                timing = LoopTiming(100 * MS, clock)
                loop = Loop([driver], judge, outbox, stop, companions, timing, keeper.keep)
                with closing(loop):
                    self.ended = loop.run()
                self.at_the_end = self.controller.answer
                if goes_on_at is None:
                    threading.Timer(WAIT_S / 2, disk.goes_on.set).start()
                keeper.save()
        self.controller.hear(5000)

    def close(self) -> None:
        self.controller.close()


@pytest.fixture
def stop() -> Iterator[StopSignal]:
    with StopSignal() as stop:
        yield stop


def test_verdicts_go_on_while_the_disk_hangs_and_the_answer_comes_when_it_does_not(
    tmp_path: Path, disk: Disk, stop: StopSignal
) -> None:
    disk.goes_on.clear()
    with closing(Lab(tmp_path, disk, READINGS // 2, stop)) as lab:
        assert (lab.ended, lab.controller.verdicts) == (Ended.EXHAUSTED, READINGS)
        assert lab.at_the_end == {"v": 1, "ok": True}
        assert READINGS // 2 <= (lab.controller.answered_at or 0) < READINGS
    kept = load(lab.path)
    assert kept is not None
    assert kept.trust is not None
    assert decode(kept.trust).learner == lab.trust.state().learner
    assert lab.trust.learner.outcomes == 1


def test_what_was_told_last_is_answered_before_the_socket_closes(
    tmp_path: Path, disk: Disk, stop: StopSignal
) -> None:
    disk.goes_on.clear()
    with closing(Lab(tmp_path, disk, None, stop)) as lab:
        assert lab.at_the_end is None
        assert lab.controller.answer == {"v": 1, "ok": True}
    assert load(lab.path) is not None
