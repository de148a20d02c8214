"""The way of a reading through the source is the one that the page on the architecture tells."""

from __future__ import annotations

import os
import re
import signal
import sys
import time
from contextlib import ExitStack
from pathlib import Path
from types import FrameType

import pytest

from graspd.daemon import scene
from graspd.daemon.assembly import assembly
from graspd.daemon.assembly.parts import Assembly, Parts
from graspd.daemon.assembly.plan import Plan
from graspd.daemon.process.signals import StopSignal
from graspd.daemon.run.loop import Loop, LoopTiming
from tests.conftest import ROOT
from tests.daemon.processes import start, wait_for

SOURCE = f"{ROOT}/deploy/package/graspd/"
"""Where Python found graspd, with a slash."""
Call = tuple[str, str]
"""File, relative to the package, and name of a function that was entered."""
ROUND: Call = ("daemon/run/loop.py", "Loop._go_round")
"""Begins a round of the loop."""
READ: Call = ("daemon/judge/pipeline.py", "Pipeline.judge")
JUDGED: Call = ("models/runtime.py", "TactileModel.run")
SIGNALS = "daemon/process/signals.py"
"""Entered in each round, for no reading."""
JUDGED_ENOUGH = 20
"""Judged readings after which the daemon is stopped."""
SECONDS_MAX = 200.0
"""When it is stopped at the latest, s."""
SCENE = """
[tactile]
driver = "spi"
port = "{folder}/twin"
[ask]
endpoint = "ipc://{folder}/ask.ipc"
[publish]
endpoint = "ipc://{folder}/right.ipc"
"""


def told() -> list[str]:
    """The files that the page names, in its order."""
    page = (ROOT / "deploy" / "ARCHITECTURE.md").read_text()
    section = page.split("## The way of a reading")[1].split("\n## ")[0]
    return re.findall(r"^- `([a-z0-9_/]+\.py)`: ", section, re.MULTILINE)


def rounds_of(file: Path) -> list[list[Call]]:
    """Run a scene's loop until some readings were judged; return the calls of each round."""
    rounds: list[list[Call]] = []
    judged, ends_s = 0, time.monotonic() + SECONDS_MAX

    def note(frame: FrameType, event: str, _argument: object) -> None:
        nonlocal judged
        path = frame.f_code.co_filename
        if event != "call" or not path.startswith(SOURCE):
            return
        call = path.removeprefix(SOURCE), frame.f_code.co_qualname
        if call[0] == SIGNALS:
            return
        if call == ROUND:
            rounds.append([])
            if judged >= JUDGED_ENOUGH or time.monotonic() > ends_s:
                os.kill(os.getpid(), signal.SIGTERM)
        if rounds:
            judged += call == JUDGED
            rounds[-1].append(call)

    wanted = scene.load(file)
    with ExitStack() as stack:
        parts = Parts.of(Plan.of(wanted), assembly.load_model(wanted))
        around = Assembly(parts, stack)
        around.open_sockets()
        around.open_drivers()
        stop, timing = stack.enter_context(StopSignal()), LoopTiming(wanted.max_age_ns)
        outbox = around.build_outbox()
        loop = Loop(parts.drivers, parts.pipeline, outbox, stop, around.companions, timing)
        sys.setprofile(note)
        try:
            loop.run()
        finally:
            sys.setprofile(None)
    return rounds


@pytest.mark.slow
@pytest.mark.usefixtures("comes_first")
def test_the_page_has_a_judged_readings_files_in_order(
    tmp_path: Path,
) -> None:
    file = tmp_path / "scene.toml"
    file.write_text(SCENE.format(folder=tmp_path))
    with start("twin", "spi", "--path", tmp_path / "twin", "--loop") as twin:
        wait_for(tmp_path / "twin")
        rounds = rounds_of(file)
        twin.terminate()
        twin.communicate()
    judged = [calls for calls in rounds if calls.count(READ) == 1 and JUDGED in calls]
    median = sorted(judged, key=len)[len(judged) // 2]
    assert list(dict.fromkeys(file for file, _ in median)) == told()
