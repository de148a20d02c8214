"""A daemon that is killed is back in a moment, and its subscribers say `unknown` until then."""

from __future__ import annotations

import re
import subprocess
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from deploy.clients.python.graspd_client import Client, Decision
from graspd.drivers.recordings.csv_player import DEMO_TABLE
from tests.daemon.processes import start
from tests.kit.waiting import PATIENCE_S
from tests.threads import at_work

UNIT = Path(__file__).parents[2] / "deploy" / "systemd" / "graspd@.service"
SILENCE_S = 0.1
"""`silence_ms` at 100 Hz: ten periods."""
STALL_S = 2.0
"""How long a busy computer may hold up a process."""


class Restarted:
    """Starts a daemon again whenever it has ended, as systemd does."""

    def __init__(self, scene: Path) -> None:
        self._scene = scene
        self.process: subprocess.Popen[str] | None = None

    def serve(self, stop: threading.Event) -> None:
        found = re.search(r"^RestartSec=(\d+)$", UNIT.read_text(), re.M)
        assert found is not None
        while not stop.is_set():
            self.process = start("run", self._scene)
            while self.process.poll() is None and not stop.wait(0.02):
                pass
            self.process.kill()
            self.process.communicate()
            stop.wait(float(found[1]))


@contextmanager
def restarted(folder: Path) -> Iterator[Restarted]:
    scene = folder / "scene.toml"
    scene.write_text(
        f'[tactile]\ndriver = "replay"\nrecordings = ["{DEMO_TABLE}"]\nloop = true\n'
        f'[gate]\nmode = "every"\n[publish]\nendpoint = "ipc://{folder}/graspd"\n'
    )
    daemon = Restarted(scene)
    with at_work(daemon.serve):
        yield daemon


def test_subscribers_of_a_killed_daemon_say_unknown_and_then_hear_it_again(tmp_path: Path) -> None:
    with (
        restarted(tmp_path) as daemon,
        Client(f"ipc://{tmp_path}/graspd", max_age_ms=1e6) as client,
    ):
        end_s = time.monotonic() + PATIENCE_S
        while (said := client.verdict(0.1)).decision == Decision.UNKNOWN:
            assert time.monotonic() < end_s
        former = said.boot_id
        assert daemon.process is not None
        daemon.process.kill()
        killed_s = time.monotonic()
        while (said := client.verdict()).reasons != ("silent",):
            assert said.boot_id == former
            time.sleep(0.001)
        unknown_s = time.monotonic() - killed_s
        assert said.decision == Decision.UNKNOWN
        while (said := client.verdict(0.1)).decision == Decision.UNKNOWN:
            assert time.monotonic() < end_s
        assert said.boot_id != former  # nothing of before has come back
    assert unknown_s < SILENCE_S + STALL_S
