"""A scene runs until a signal, the end of its recording, or a sleep of the computer."""

from __future__ import annotations

import logging
import re
import signal
import socket
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from graspd.daemon.judge.reasons import Decision, Reason
from graspd.daemon.process.signals import StopSignal
from graspd.daemon.publish.messages import State
from graspd.daemon.run.loop import Ended, Loop
from graspd.daemon.run.runner import run_scene
from graspd.daemon.scene import SceneError
from graspd.drivers.base import DriverError
from graspd.drivers.recordings.csv_player import DEMO_RECORDING, DEMO_TABLE
from tests.bench.live import Subscriber
from tests.clients.building import sleep_at_will
from tests.daemon.processes import put_first, start
from tests.kit.messages import decode_status
from tests.kit.scenes import demo_scene
from tests.kit.waiting import PATIENCE_S


class Running:
    """A daemon, the service manager that it reports to, and a subscriber."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.scene = demo_scene(folder, "loop = true", recording=DEMO_RECORDING)

    @contextmanager
    def started(self) -> Iterator[Running]:
        with (
            socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as self.ears,
            Subscriber(f"ipc://{self.folder}/v") as self.verdicts,
            Subscriber(f"ipc://{self.folder}/v", topics=("status.",)) as self.statuses,
        ):
            self.ears.bind(str(self.folder / "notify"))
            self.ears.settimeout(PATIENCE_S)
            manager = f"NOTIFY_SOCKET={self.folder}/notify", "WATCHDOG_USEC=400000"
            with start("run", self.scene, before=("env", *manager)) as self.process:
                put_first(self.process.pid)
                try:
                    yield self
                finally:
                    self.process.kill()

    def told(self, line: str) -> list[str]:
        """Return the lines of the next message to the manager in which one begins with `line`."""
        while True:
            message = self.ears.recv(4096).decode().split("\n")
            if any(text.startswith(line) for text in message):
                return message

    def stops(self) -> bool:
        """Wait for a status of the state `stopping`; return False if none comes."""
        while (message := self.statuses.take(PATIENCE_S)) is not None:
            if decode_status(message[1]).state is State.STOPPING:
                return True
        return False

    def end(self) -> tuple[int, str]:
        said = self.process.communicate(timeout=PATIENCE_S)[1]
        return self.process.returncode, said


@pytest.fixture
def running(tmp_path: Path) -> Iterator[Running]:
    with Running(tmp_path).started() as running:
        assert running.told("READY=1")[0] == "READY=1"
        yield running


def test_ready_comes_first_and_then_the_watchdog_is_fed(running: Running) -> None:
    assert running.verdicts.wait_for(lambda _verdict: True).model == "small-session"
    for _ in range(3):
        assert running.told("WATCHDOG=1") == ["WATCHDOG=1"]
    assert "readings/s" in running.told("STATUS=running")[0]


@pytest.mark.parametrize("number", [signal.SIGHUP, signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_the_daemon_and_is_logged(running: Running, number: signal.Signals) -> None:
    seen = running.verdicts.wait_for(lambda verdict: verdict.seq >= 20)
    running.process.send_signal(number)
    code, said = running.end()
    *_, last = said.splitlines()
    ended = re.fullmatch(rf"graspd: INFO: ended by {number.name} after \S+ s: (\d+) read.*", last)
    assert ended is not None, last
    assert code == 0
    assert int(ended[1]) > seen.seq
    assert running.told("STOPPING=1")
    assert running.stops()


def test_the_log_counts_one_judgement_per_row_of_a_table(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    rows = len(DEMO_TABLE.read_text().splitlines()) - 1
    scene = demo_scene(tmp_path, 'pace = "fast"')
    with caplog.at_level(logging.INFO, logger="graspd"), StopSignal() as stop:
        assert run_scene(scene, stop) is Ended.EXHAUSTED
    *_, last = caplog.messages
    assert re.match(rf"ended by the end of the recording .*: {rows} readings, {rows} judge", last)
    counts = re.findall(r"(\d+) (?:stable|slip|unknown)", last)
    assert sum(map(int, counts)) == rows


def test_only_a_scene_that_ran_logs_its_failure(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def fail(_loop: object) -> None:
        raise DriverError("broken")

    monkeypatch.setattr(Loop, "run", fail)
    scene = demo_scene(tmp_path)
    with caplog.at_level(logging.INFO, logger="graspd"), StopSignal() as stop:
        with pytest.raises(DriverError):
            run_scene(scene, stop)
        assert caplog.messages[-1].startswith("ended by an error after ")
        caplog.clear()
        with pytest.raises(SceneError):
            run_scene(tmp_path / "absent.toml", stop)
    assert not caplog.messages


def test_a_sleep_ends_the_daemon_with_an_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    slept = sleep_at_will(tmp_path, monkeypatch)
    with Running(tmp_path).started() as running:
        running.told("READY=1")
        running.verdicts.wait_for(lambda verdict: verdict.verdict is not Decision.UNKNOWN)
        slept.touch()
        last = running.verdicts.wait_for(lambda verdict: verdict.reasons[:1] == [Reason.STALE])
        code, said = running.end()
        assert running.stops()
    assert last.verdict is Decision.UNKNOWN
    assert code == 1  # systemd starts it again: Restart=on-failure
    assert "ended by a sleep of the computer" in said
