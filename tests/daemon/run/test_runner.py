"""A scene is taken anew: what wants the same stays, and a wrong one changes nothing."""

from __future__ import annotations

import logging
import os
import re
import signal
import socket
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
import zmq

from graspd.daemon.judge.reasons import Reason
from graspd.daemon.process.signals import StopSignal
from graspd.daemon.publish.messages import State, Status, Verdict
from graspd.daemon.run import runner
from graspd.daemon.run.loop import Loop
from graspd.daemon.scene import Scene, SceneError
from graspd.drivers.base import DriverError
from graspd.drivers.recordings.csv_player import DEMO_TABLE
from tests.clients.building import sleep_at_will
from tests.daemon.processes import put_first, start
from tests.kit.messages import decode_status, decode_verdict
from tests.kit.scenes import demo_scene
from tests.kit.waiting import PATIENCE_S

DEMO = Path(__file__).parents[3] / "drivers" / "recordings" / "demo" / "synthetic_stream.csv"

SCENE = """
[hand]
name = "{hand}"
[tactile]
driver = "replay"
recordings = ["{recording}"]
loop = true
[model]
name = "{model}"
[publish]
endpoint = "ipc://{folder}/{socket}"
"""


class Running:
    """A daemon, who it tells how it goes, and a subscriber."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.scene = folder / "scene.toml"
        self.write()

    def write(self, **changes: object) -> None:
        wanted = {"hand": "right", "recording": DEMO, "model": "small-session", "socket": "v"}
        self.scene.write_text(SCENE.format(**{**wanted, "folder": self.folder, **changes}))

    @contextmanager
    def started(self) -> Iterator[Running]:
        with (
            socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as self.ears,
            zmq.Context() as self.context,
            self.context.socket(zmq.SUB) as self.subscriber,
        ):
            self.ears.bind(str(self.folder / "notify"))
            self.ears.settimeout(PATIENCE_S)
            self.subscriber.connect(f"ipc://{self.folder}/v")
            self.subscriber.subscribe("")
            manager = f"NOTIFY_SOCKET={self.folder}/notify", "WATCHDOG_USEC=400000"
            with start("run", self.scene, before=("env", *manager)) as self.process:
                put_first(self.process.pid)
                try:
                    yield self
                finally:
                    self.process.kill()

    def told(self, line: str) -> list[str]:
        """The message to the manager that has a line that begins so; others are passed over."""
        while True:
            message = self.ears.recv(4096).decode().split("\n")
            if any(text.startswith(line) for text in message):
                return message

    def verdict(
        self, hand: str = "right", like: Callable[[Verdict], bool] = lambda _verdict: True
    ) -> Verdict:
        """Wait for a verdict of this hand for which `like` is true."""
        deadline_s = time.monotonic() + PATIENCE_S
        while time.monotonic() < deadline_s and self.subscriber.poll(int(PATIENCE_S * 1e3)):
            topic, payload = self.subscriber.recv_multipart()
            if topic.decode() == f"verdict.{hand}" and like(verdict := decode_verdict(payload)):
                return verdict
        pytest.fail("no such verdict")

    def last_status(self) -> Status:
        """The newest status, after all messages that are there."""
        statuses = []
        while self.subscriber.poll(500):
            topic, payload = self.subscriber.recv_multipart()
            if topic.startswith(b"status."):
                statuses.append(decode_status(payload))
        return statuses[-1]

    def hang_up(self) -> None:
        self.process.send_signal(signal.SIGHUP)
        self.told("RELOADING=1")

    def stop(self) -> tuple[int, str]:
        self.process.terminate()
        said = self.process.communicate(timeout=PATIENCE_S)[1]
        return self.process.returncode, said


@pytest.fixture
def running(tmp_path: Path) -> Iterator[Running]:
    with Running(tmp_path).started() as running:
        assert running.told("READY=1")[0] == "READY=1"
        yield running


def test_ready_comes_when_it_runs_and_the_watchdog_is_fed_from_then_on(running: Running) -> None:
    assert running.verdict().model == "small-session"
    for _ in range(3):
        assert running.told("WATCHDOG=1") == ["WATCHDOG=1"]
    assert "readings/s" in running.told("STATUS=running")[0]
    code, said = running.stop()
    assert code == 0, said
    assert running.told("STOPPING=1")
    assert running.last_status().state is State.STOPPING


def test_the_end_is_logged_with_its_cause_and_the_counts_of_all_reloads(running: Running) -> None:
    before = running.verdict()
    for _ in range(8):  # seconds: two grasps
        running.told("STATUS=running")
    running.write(model="cnn1")
    running.hang_up()
    running.told("READY=1")
    after = running.verdict(like=lambda verdict: verdict.model == "cnn1" and verdict.seq >= 20)
    *said, last = running.stop()[1].splitlines()
    ended = re.fullmatch(r"graspd: INFO: ended by SIGTERM after (\S+) s: (\d+) readings, .*", last)
    assert ended is not None, last
    assert sum("0 told outcomes and a session of" in line for line in said) == 1
    assert float(ended[1]) >= (after.t_mono_ns - before.t_mono_ns) / 1e9
    assert int(ended[2]) >= before.seq + after.seq


def test_a_table_that_ends_is_logged_with_a_judgement_a_row(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    rows = len(DEMO_TABLE.read_text().splitlines()) - 1
    scene = demo_scene(tmp_path, 'pace = "fast"')
    with caplog.at_level(logging.INFO, logger="graspd"), StopSignal() as stop:
        runner.Runner(scene, stop).run()
    *_, last = caplog.messages
    assert re.match(rf"ended by the end of the recording .*: {rows} readings, {rows} judge", last)
    counts = re.findall(r"(\d+) (?:stable|slip|unknown)", last)
    assert sum(map(int, counts)) == rows


def test_a_run_that_fails_is_logged_and_a_scene_that_never_ran_is_not(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def fail(_loop: object) -> None:
        raise DriverError("broken")

    monkeypatch.setattr(Loop, "run", fail)
    scene = demo_scene(tmp_path)
    with caplog.at_level(logging.INFO, logger="graspd"), StopSignal() as stop:
        with pytest.raises(DriverError):
            runner.Runner(scene, stop).run()
        assert caplog.messages[-1].startswith("ended by an error after ")
        caplog.clear()
        with pytest.raises(SceneError):
            runner.Runner(tmp_path / "absent.toml", stop).run()
    assert not caplog.messages


def test_another_model_takes_over_and_another_hand_gets_a_new_socket(running: Running) -> None:
    before = running.verdict()
    running.write(model="cnn1")
    running.hang_up()
    running.told("READY=1")
    after = running.verdict(like=lambda verdict: verdict.model == "cnn1")
    assert after.boot_id != before.boot_id
    assert after.seq < before.seq + 1000
    running.write(hand="left", socket="w")
    running.subscriber.connect(f"ipc://{running.folder}/w")
    running.hang_up()
    running.told("READY=1")
    running.verdict("left")
    assert not (running.folder / "v").exists()
    assert running.stop()[0] == 0


@pytest.mark.parametrize(
    ("changes", "word"),
    [
        ({"model": "no-such"}, "no-such"),
        ({"socket": "no/such/folder"}, "cannot publish"),
    ],
)
def test_a_wrong_scene_changes_nothing_and_is_told(
    running: Running, changes: dict[str, object], word: str
) -> None:
    before = running.verdict()
    running.write(**changes)
    running.hang_up()
    running.told("READY=1")
    later_ns = before.t_mono_ns + 1_000_000_000
    after = running.verdict(like=lambda verdict: verdict.t_mono_ns >= later_ns)
    assert (after.model, after.model_sha) == (before.model, before.model_sha)
    code, said = running.stop()
    assert code == 0
    assert word in said
    assert "the former scene goes on" in said


def test_after_a_sleep_everything_starts_again_once_it_is_back(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    recording, away = tmp_path / "demo.csv", tmp_path / "away"
    slept = sleep_at_will(tmp_path, monkeypatch)
    recording.write_bytes(DEMO.read_bytes())
    waiting = Running(tmp_path)
    waiting.write(recording=recording)
    with waiting.started() as running:
        running.told("READY=1")
        before = running.verdict()
        recording.rename(away)
        slept.touch()
        last = running.verdict(like=lambda verdict: verdict.reasons[:1] == [Reason.STALE])
        time.sleep(1.5)  # two tries
        assert running.process.poll() is None
        away.rename(recording)
        running.told("READY=1")
        after = running.verdict()
        code, said = running.stop()
    assert last.boot_id == before.boot_id != after.boot_id
    assert (after.seq, after.grasp) < (before.seq + 1000, before.grasp + 1)
    assert code == 0
    assert said.count("the computer has slept") == 1
    assert said.count("another try in 1 s") >= 1


def test_what_fails_while_it_takes_over_leaves_the_scene_to_the_former_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    wanted = Running(tmp_path)
    entered: list[Scene] = []

    def enter(scene: Scene, _stack: object) -> None:
        entered.append(scene)
        if len(entered) == 2:
            raise MemoryError("no more")
        if len(entered) == 3:
            os.kill(os.getpid(), signal.SIGTERM)

    monkeypatch.setattr(runner, "enter_realtime", enter)
    with StopSignal(reloads=True) as stop:
        os.kill(os.getpid(), signal.SIGHUP)
        runner.Runner(wanted.scene, stop).run()
    first, second, third = entered
    assert third is first
    assert second is not first
    assert "MemoryError: no more" in caplog.text
    assert "the former scene goes on" in caplog.text
