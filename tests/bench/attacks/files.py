"""Scenes and models made to break a daemon that reads them at SIGHUP."""

from __future__ import annotations

import contextlib
import itertools
import os
import signal
import socket
import subprocess
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from unittest.mock import patch

from graspd.drivers.recordings.csv_player import DEMO_RECORDING
from tests.bench.attacks.attack import Outcome, Plan
from tests.bench.live import (
    PATIENCE_S,
    STOP_S,
    Child,
    Subscriber,
    memory_mib,
    peak_mib,
    running,
)
from tests.models.hostile import giant
from tests.threads import at_work

GROWTH_MAX_MIB = 32
"""Memory that no file may cost a running daemon for good, or a refused scene ever, MiB."""
GAP_MAX_S = 0.5
"""Between two verdicts while a scene is read, s: readings come every 10 ms, shared computers
stall."""
SWAP_MAX_S = 1.5
"""Between two verdicts where another scene has taken over, s: its driver begins anew."""
END_MAX_S = 15.0
"""Until a command must have refused a file, s: a model is tried for ten."""
STOP_MAX_S = 2.0
"""Until a daemon that was told to stop is gone, s."""
REFUSED = "the new scene is wrong, the former one goes on"

SCENE = """
[tactile]
driver = "replay"
recordings = ["{recording}"]
loop = true
[model]
{model}
"""


def scene(model: str = 'name = "small-session"') -> str:
    """The sections of a scene whose readings never end."""
    return SCENE.format(recording=DEMO_RECORDING, model=model)


DOTTED: dict[str, Callable[[int], str]] = {
    "a key of dots": lambda size: ".".join(["a"] * (size // 2)) + " = 1",
    "a header of dots": lambda size: "[" + ".".join(["a"] * (size // 2)) + "]",
    "quoted dots": lambda size: " . ".join(['"a"'] * (size // 6)) + " = 1",
    "many keys of dots": lambda size: "\n".join(
        ".".join([f"k{number}", *["a"] * 240]) + " = 1" for number in range(size // 490)
    ),
    "arrays": lambda size: "a = " + "[" * (size // 2) + "]" * (size // 2),
    "inline tables": lambda size: "a = " + "{a=" * (size // 4) + "1" + "}" * (size // 4),
    "dots in an inline table": lambda size: "a = {" + ".".join(["a"] * (size // 2)) + " = 1}",
}
"""Ways to nest, by name: TOML of about so many bytes."""
SIZES = (32_000, 48_000, 96_000)


@dataclass(slots=True)
class Reloaded:
    """What happened at a SIGHUP."""

    alive: bool
    told: str
    """What the daemon told the service manager became of it; nothing if it did not in time."""
    gap_s: float
    """Longest time without a verdict."""


@dataclass(slots=True)
class Running:
    """A daemon, its service manager, and a subscriber of its verdicts."""

    folder: Path
    manager: socket.socket
    process: Child
    ears: Subscriber

    @property
    def alive(self) -> bool:
        return self.process.poll() is None

    def hear(self, seconds: float, until: Callable[[], bool] = lambda: False) -> float:
        """The longest time without a verdict, s, from now until so long or `until`."""
        began_ns = last_ns = time.monotonic_ns()
        longest_ns = 0
        while self.alive and (now_ns := time.monotonic_ns()) < began_ns + seconds * 1e9:
            if until():
                break
            if self.ears.take(0.05) is not None:
                now_ns = self.ears.received_ns
                longest_ns, last_ns = max(longest_ns, now_ns - last_ns), now_ns
        return max(longest_ns, time.monotonic_ns() - last_ns) / 1e9

    def told(self) -> str:
        """What the manager was told to be the end of a reload, since the last call."""
        with contextlib.suppress(BlockingIOError):
            while True:
                ready, _, status = self.manager.recv(4096).decode().partition("\nSTATUS=")
                if ready == "READY=1":
                    return status.partition("\n")[0]
        return ""

    def put(self, sections: str) -> None:
        """Put a scene in the place of the former one, and tell the daemon."""
        text = f'{sections}[publish]\nendpoint = "ipc://{self.folder}/v"\n'
        (self.folder / "scene.toml").write_text(text)
        self.process.send_signal(signal.SIGHUP)

    def reload(self, sections: str) -> Reloaded:
        """Put a scene in the place of the former one, and wait for what becomes of it."""
        said: list[str] = []

        def is_told() -> bool:
            said.extend(filter(None, [self.told()]))
            return bool(said)

        while self.told():
            pass  # of former reloads
        self.put(sections)
        gap_s = self.hear(END_MAX_S, is_told)
        gap_s = max(gap_s, self.hear(0.3))
        return Reloaded(self.alive, "".join(said), gap_s)

    def stops_in_s(self) -> float:
        """How long it takes from SIGTERM to its end, s; at most five."""
        began_s = time.monotonic()
        self.process.terminate()
        with contextlib.suppress(subprocess.TimeoutExpired):
            self.process.wait(STOP_S)
        return time.monotonic() - began_s


@contextlib.contextmanager
def start(folder: Path) -> Iterator[Running]:
    """Run a daemon on the scene, in a folder where weights of other files would be looked for."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as manager, contextlib.ExitStack() as on:
        address = folder / "notify"
        manager.bind(str(address))
        on.callback(address.unlink)
        manager.setblocking(False)
        with contextlib.chdir(folder), patch.dict(os.environ, NOTIFY_SOCKET=str(address)):
            process, ears = on.enter_context(running(folder, scene()))
        if ears.take(PATIENCE_S) is None:
            raise TimeoutError("no verdict at the start")
        made = Running(folder, manager, process, ears)
        made.hear(1.0)
        yield made


def nested_scenes(plan: Plan) -> Outcome:
    """SIGHUP with scenes of 32 to 96 kB that nest: dotted keys, arrays, inline tables."""
    tried, gap_s, growth_mib, held = 0, 0.0, 0.0, True
    ways = [(way, size) for size in SIZES for way in DOTTED]
    with start(plan.folder) as daemon:
        rest_mib = memory_mib(daemon.process.pid)
        end_s = time.monotonic() + max(plan.seconds, 1.0)
        for way, size in itertools.cycle(ways):
            found = daemon.reload(DOTTED[way](size) + "\n" + scene())
            tried += 1
            gap_s = max(gap_s, found.gap_s)
            if not found.alive:
                return Outcome(tried, f"the daemon is gone after {way}, {size} bytes", False)
            growth_mib = peak_mib(daemon.process.pid) - rest_mib
            fits = found.gap_s < GAP_MAX_S and growth_mib < GROWTH_MAX_MIB
            held = held and found.told == REFUSED and fits
            if tried >= len(ways) and time.monotonic() > end_s:
                break
        held = held and daemon.stops_in_s() < STOP_MAX_S
    happened = (
        f"longest gap in the verdicts {gap_s * 1e3:.0f} ms, memory at most +{growth_mib:.0f} MiB"
    )
    return Outcome(tried, happened, held)


def sighup_storm(plan: Plan) -> Outcome:
    """SIGHUP every half millisecond."""
    sent, gap_s = 0, 0.0
    with start(plan.folder) as daemon:
        daemon.hear(3.0)  # all that it needs it has by then
        rest_mib = memory_mib(daemon.process.pid)

        def hang_up(stop: threading.Event) -> None:
            nonlocal sent
            while not stop.wait(0.0005):
                with contextlib.suppress(ProcessLookupError):
                    os.kill(daemon.process.pid, signal.SIGHUP)
                sent += 1

        with at_work(hang_up):
            gap_s = daemon.hear(max(plan.seconds, 4.0))
        growth_mib = memory_mib(daemon.process.pid) - rest_mib
        daemon.hear(2.0)  # the last one was late
        other = daemon.reload(scene('name = "mlp"'))
        stops_s = daemon.stops_in_s()
    taken = other.alive and other.told.endswith("mlp")
    held = taken and gap_s < SWAP_MAX_S and growth_mib < GROWTH_MAX_MIB
    happened = (
        f"memory {growth_mib:+.0f} MiB, longest gap in the verdicts {gap_s * 1e3:.0f} ms, "
        f"ends {stops_s:.1f} s after SIGTERM"
    )
    return Outcome(sent, happened, held and stops_s < STOP_MAX_S)


def giant_model(plan: Plan) -> Outcome:
    """A model that multiplies matrices for minutes, at SIGHUP."""
    text = scene(f'path = "{giant(plan.folder)}"')
    tried, gap_s, stops_s, held = 0, 0.0, 0.0, True
    for _ in plan.rounds():
        tried += 1
        with start(plan.folder) as daemon:
            reloaded = daemon.reload(text)
            gap_s = max(gap_s, reloaded.gap_s)
            held = held and reloaded.alive and reloaded.told == REFUSED
            daemon.put(text)
            daemon.hear(0.5)  # SIGTERM comes while it is read
            stops_s = max(stops_s, daemon.stops_in_s())
    happened = (
        f"the reload is {'refused' if held else 'not refused'}, longest gap in the verdicts "
        f"{gap_s * 1e3:.0f} ms, ends {stops_s:.1f} s after SIGTERM"
    )
    return Outcome(tried, happened, held and gap_s < GAP_MAX_S and stops_s < STOP_MAX_S)
