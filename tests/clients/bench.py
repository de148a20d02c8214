"""A real daemon for the clients' tests, which plays a recording again and again."""

from __future__ import annotations

import os
import signal
from pathlib import Path
from typing import Self

from graspd.drivers.recordings.csv_player import DEMO_RECORDING, DEMO_TABLE
from tests.daemon.processes import TIMEOUT_S, start, wait_for
from tests.ports import free_port

REST, GRASP = slice(0, 160), slice(1484, 1770)
"""Rows of the demo recording: the open hand, and a whole grasp that is stable."""
RATE_HZ = 100


class Daemon:
    """Process of `graspd run`, with its scene and sockets in a folder; killed after the block."""

    def __init__(
        self,
        folder: Path,
        more: str = "",
        *,
        whole_grasps: bool = False,
        recording: Path | None = None,
        endpoint: str | None = None,
    ) -> None:
        """Start a daemon on a `recording`; None: the demo table, whose rows are grasps, or with
        `whole_grasps` one stable grasp from touch to lift.

        `more`: the scene's lines after those of `[tactile]`. `endpoint` None: `out` in `folder`.
        """
        self.endpoint = endpoint or f"ipc://{folder}/out"
        self.ask_endpoint = f"ipc://{folder}/ask"
        self._folder = folder
        self._scene = folder / "scene.toml"
        if recording is None:
            recording = _one_grasp(folder / "grasp.csv") if whole_grasps else DEMO_TABLE
        self._scene.write_text(
            f'[publish]\nendpoint = "{self.endpoint}"\n'
            f'[ask]\nendpoint = "{self.ask_endpoint}"\n'
            f'[tactile]\ndriver = "replay"\nrecordings = ["{recording}"]\nloop = true\n{more}'
        )
        self.start()

    def start(self) -> None:
        """Start the process, and wait until its ask socket exists."""
        bound = self._folder / "ask"
        bound.unlink(missing_ok=True)
        self._process = start("run", self._scene)
        wait_for(bound)

    def send(self, number: signal.Signals) -> None:
        """Send the process a signal."""
        os.kill(self._process.pid, number)

    def kill(self) -> None:
        """Kill the process, and wait for its end."""
        self._process.kill()
        self._process.communicate(timeout=TIMEOUT_S)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_details: object) -> None:
        self.kill()


def _one_grasp(path: Path) -> Path:
    """Write a recording of only one grasp, which is stable, so that no test waits for one; return
    `path`."""
    head, *rows = DEMO_RECORDING.read_text().splitlines()
    kept = [row.partition(",")[2] for row in rows[REST] + rows[GRASP]]
    lines = [f"{number / RATE_HZ},{row}" for number, row in enumerate(kept)]
    path.write_text("\n".join([head, *lines, ""]))
    return path


def free_endpoint() -> str:
    """Return a TCP endpoint on the loopback address whose port is free now."""
    return f"tcp://127.0.0.1:{free_port()}"
