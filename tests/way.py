"""The way of a reading: the source files that one reading enters, from a serial line to the socket.

    python -m tests.way

prints for the median judged and the median idle reading: calls of graspd's functions, files
entered, changes of file, and returns to a file that was left. The hand is a twin.
"""

from __future__ import annotations

import os
import signal
import sys
import tempfile
import time
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from types import FrameType
from typing import Final, cast

import zmq

from graspd.daemon import scene
from graspd.daemon.assembly import assembly
from graspd.daemon.assembly.parts import Assembly, Parts
from graspd.daemon.process.signals import StopSignal
from graspd.daemon.publish.sockets import Sockets
from graspd.daemon.run.loop import Loop, LoopTiming
from tests.conftest import ROOT
from tests.daemon.processes import start, wait_for

SOURCE: Final = f"{ROOT}/deploy/package/graspd/"
"""Where Python found graspd, with a slash."""
ROUND: Final = ("daemon/run/loop.py", "Loop._go_round")
"""Begins a round of the loop."""
READ: Final = ("daemon/judge/pipeline.py", "Pipeline.judge")
JUDGED: Final = ("models/runtime.py", "TactileModel.run")
JUDGED_ENOUGH: Final = 20
"""Judged readings after which the walk ends."""
SECONDS_MAX: Final = 60.0
"""When it ends at the latest, s."""
SCENE: Final = """
[hand]
name = "right"
fingers = ["ff", "mf", "th"]
[tactile]
driver = "spi"
sensors = ["ff", "mf", "th"]
port = "{folder}/twin"
[ask]
endpoint = "ipc://{folder}/ask.ipc"
[publish]
endpoint = "ipc://{folder}/right.ipc"
"""

Call = tuple[str, str]
"""File, relative to the package, and name of a function that was entered."""


@dataclass(slots=True)
class Walk:
    """Records the calls of each round of the loop, and stops the loop at the end."""

    ends_s: float
    judged: int = 0
    rounds: list[list[Call]] = field(default_factory=list)
    event: int = field(default_factory=lambda: os.eventfd(0))

    def note(self, frame: FrameType, event: str, _argument: object) -> None:
        """Take in one event of the interpreter; for `sys.setprofile`."""
        path = frame.f_code.co_filename
        if event != "call" or not path.startswith(SOURCE):
            return
        call = path.removeprefix(SOURCE), frame.f_code.co_qualname
        if call == ROUND:
            self.rounds.append([])
        self.judged += call == JUDGED
        if self.rounds:
            self.rounds[-1].append(call)

    @property
    def received(self) -> signal.Signals | None:
        """The signal that ends the loop, once there is enough or the time is over."""
        is_over = self.judged >= JUDGED_ENOUGH or time.monotonic() > self.ends_s
        return signal.SIGTERM if is_over else None

    def fileno(self) -> int:
        """A descriptor that never becomes readable."""
        return self.event

    def take_reload(self) -> bool:
        """False: the scene stays."""
        return False

    def readings(self, *, judged: bool) -> list[list[Call]]:
        """The rounds with one reading that the network judged, or did not, the shortest first."""
        rounds = [
            calls for calls in self.rounds if calls.count(READ) == 1 and (JUDGED in calls) is judged
        ]
        return sorted(rounds, key=len)


def walk() -> Walk:
    """Run the daemon's loop on a twin until some readings were judged, and record its calls."""
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        twin = stack.enter_context(start("twin", "spi", "--path", folder / "twin", "--loop"))
        stack.callback(twin.terminate)
        wait_for(folder / "twin")
        file = folder / "scene.toml"
        file.write_text(SCENE.format(folder=folder))
        wanted = scene.load(file)
        parts = Parts.of(wanted, assembly.load_model(wanted))
        around = Assembly(parts, stack)
        around.add_sockets(stack.enter_context(Sockets(wanted)))
        around.open_drivers()
        recorded = Walk(time.monotonic() + SECONDS_MAX)
        stack.callback(os.close, recorded.event)
        timing = LoopTiming(wanted.max_age_ns)
        outbox = around.build_outbox()
        stop = cast(StopSignal, recorded)  # whose calls are none of the reading's
        loop = Loop(parts.drivers, parts.pipeline, outbox, stop, around.companions, timing)
        context = stack.enter_context(zmq.Context())
        subscriber = stack.enter_context(context.socket(zmq.SUB))
        subscriber.connect(wanted.endpoint)
        subscriber.subscribe("verdict.right")
        sys.setprofile(recorded.note)
        try:
            loop.run()
        finally:
            sys.setprofile(None)
    return recorded


def files(calls: Sequence[Call]) -> list[str]:
    """The files that these calls enter, one for each change of file."""
    entered = [file for file, _ in calls]
    return [file for at, file in enumerate(entered) if at == 0 or entered[at - 1] != file]


def median(rounds: Sequence[list[Call]]) -> list[Call]:
    """The round in the middle."""
    return rounds[len(rounds) // 2]


def main() -> int:
    """Print the figures and the files."""
    recorded = walk()
    for name, judged in (("judged", True), ("idle", False)):
        rounds = recorded.readings(judged=judged)
        calls = median(rounds)
        changes, once = files(calls), list(dict.fromkeys(files(calls)))
        sys.stdout.write(
            f"{name}, median of {len(rounds)} readings: {len(calls)} calls, {len(once)} files, "
            f"{len(changes)} changes, {len(changes) - len(once)} returns\n"
        )
        sys.stdout.writelines(f"    {file}\n" for file in once)
    return 0


if __name__ == "__main__":
    sys.exit(main())
