"""`graspd doctor` and `graspd run` as they are, in real time, on the emulated board's port."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from graspd.daemon.publish.messages import Status, Tactile
from graspd.drivers.recordings.csv_player import DEMO_RECORDING
from graspd.drivers.twins.grasps.grasps import recorded_counts
from tests.bench.live import Subscriber
from tests.daemon.processes import TIMEOUT_S, graspd, put_first, start, wait_for
from tests.emulated.board import BOARD_ID
from tests.emulated.conftest import Image
from tests.emulated.live import main
from tests.emulated.test_driver import grasps, write_counts
from tests.kit.messages import decode_status, decode_tactile

READINGS = 500
READY_S = 200.0
"""Real time for the board to be there, on a computer with other things to do."""
ON_TIME_MS = 50.0
"""Half the silence after which the driver gives a link up: an emulation that was further behind is
a board that was silent, and the driver is right to say so."""


@dataclass
class Live:
    process: subprocess.Popen[str]
    scene: Path

    def behind_ms(self) -> float:
        """End the board and ask how far it was behind its time at worst."""
        self.process.send_signal(signal.SIGTERM)
        output, _ = self.process.communicate(timeout=TIMEOUT_S)
        assert self.process.returncode == 0
        return float(output.split()[0])


def test_a_board_that_cannot_be_built_says_what_it_needs(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("PATH", "")
    monkeypatch.setattr(sys, "argv", ["live", "--link", "/tmp/any"])
    with pytest.raises(SystemExit) as ended:
        main()
    assert ended.value.code == 2
    said = capsys.readouterr().err
    assert "error: no node, npm, cc for the emulated chip. It needs node, npm, cc, cmake," in said


@pytest.fixture
def live(image: Image, tmp_path: Path) -> Iterator[Live]:
    image()
    link, scene = tmp_path / "port", tmp_path / "scene.toml"
    scene.write_text(
        f'[tactile]\ndriver = "spi"\nport = "{link}"\n[model]\nname = "cnn1"\n'
        f'[publish]\nendpoint = "ipc://{tmp_path}/graspd"\ntactile_hz = 10000\n'
    )
    counts = write_counts(tmp_path / "counts", grasps())
    command = [sys.executable, "-m", "tests.emulated.live", "--link", link, "--counts", counts]
    with subprocess.Popen(
        [*map(str, command)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as process:
        put_first(process.pid)
        end_s = time.monotonic() + READY_S
        while not link.is_symlink():
            assert process.poll() is None
            assert time.monotonic() < end_s
            time.sleep(0.05)
        yield Live(process, scene)
        process.terminate()


def readings(endpoint: str) -> tuple[list[Tactile], Status]:
    """Readings in a row, and a status after them."""
    found: list[Tactile] = []
    with Subscriber(endpoint, topics=("tactile.", "status.")) as subscriber:
        while (message := subscriber.take(20.0)) is not None:
            if message[0].startswith(b"tactile."):
                found.append(decode_tactile(message[1]))
            elif len(found) >= READINGS:
                return found[:READINGS], decode_status(message[1])
    raise TimeoutError("the daemon fell silent")


def test_the_doctor_and_the_daemon_take_it_for_a_board(live: Live, tmp_path: Path) -> None:
    end_s = time.monotonic() + READY_S
    said: list[str] = []
    while f"spi: board {BOARD_ID}" not in said:  # not while the emulation stalls
        assert time.monotonic() < end_s, said
        report = json.loads(graspd("doctor", live.scene, "--listen", 3, "--json").stdout)
        said = [finding["what"] for finding in report["findings"]]
    assert "spi: sensors BTSP000000000001, BTSP000000000002, BTSP000000000003" in said

    with start("run", live.scene) as daemon:
        wait_for(tmp_path / "graspd")
        found, status = readings(f"ipc://{tmp_path}/graspd")
        daemon.send_signal(signal.SIGTERM)
        assert daemon.wait(TIMEOUT_S) == 0
    behind_ms = live.behind_ms()
    assert len(found) == READINGS
    once = list(recorded_counts(DEMO_RECORDING))  # the board plays it over and over
    rows = {row.tobytes(): at for at, row in enumerate(once)}
    at = [rows[np.array(reading.counts, dtype=np.uint16).tobytes()] for reading in found]
    steps = np.diff(at) % len(once)
    assert not any(any(map(any, reading.faults)) for reading in found)
    # The chip's clock is right however far its emulation is behind.
    assert status.drivers["spi"]["clock_faults"] == 0
    intervals_ns = np.diff([reading.t_mono_ns for reading in found])
    assert (intervals_ns > 0).all()
    if behind_ms < ON_TIME_MS:
        assert (steps >= 1).all()
        # A daemon that was held up says how many readings it left out.
        assert (steps - 1).sum() <= status.skipped_readings
        assert report["readings"] > 250
        assert float(np.median(intervals_ns)) == pytest.approx(10e6, rel=0.01)
