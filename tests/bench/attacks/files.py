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
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from unittest.mock import patch

from graspd.drivers.recordings.csv_player import DEMO_RECORDING
from tests.bench.attacks.attack import Aim, Attack, Outcome, Plan
from tests.bench.live import PATIENCE_S, Child, Subscriber, start_daemon, usage
from tests.models.hostile import giant
from tests.threads import at_work

MIB = 1024
"""KiB."""
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
[publish]
endpoint = "ipc://{folder}/v"
"""


def scene(folder: Path, model: str = 'name = "small-session"') -> str:
    """A scene whose readings never end."""
    return SCENE.format(recording=DEMO_RECORDING, model=model, folder=folder)


def _peak_mib(pid: int) -> float:
    """Most memory that a process has had; 0 of one that has ended."""
    status = Path(f"/proc/{pid}/status").read_text()
    return int((status.partition("VmHWM:")[2].split() or ["0"])[0]) / MIB


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


class Running:
    """A daemon on `folder`'s scene, with a service manager and somebody who hears its verdicts."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.scene = folder / "scene.toml"
        self.log = folder / "log"
        self.scene.write_text(scene(folder))

    def __enter__(self) -> Running:
        with contextlib.ExitStack() as stack:
            self.manager = stack.enter_context(socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM))
            self.manager.bind(str(self.folder / "notify"))
            stack.callback((self.folder / "notify").unlink)
            self.manager.setblocking(False)
            with (  # in the folder, where weights of other files would be looked for
                contextlib.chdir(self.folder),
                patch.dict(os.environ, NOTIFY_SOCKET=str(self.folder / "notify")),
            ):
                self.daemon: Child = stack.enter_context(start_daemon(self.scene, self.log))
            self.ears = stack.enter_context(Subscriber(f"ipc://{self.folder}/v"))
            if self.ears.take(PATIENCE_S) is None:
                raise TimeoutError("no verdict at the start")
            self.hear(1.0)
            self._stack = stack.pop_all()
        return self

    def __exit__(self, *_details: object) -> None:
        self._stack.close()

    @property
    def alive(self) -> bool:
        return self.daemon.process.poll() is None

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

    def reload(self, text: str, patience_s: float = END_MAX_S) -> Reloaded:
        """Put a scene in the place of the former one and tell the daemon."""
        self.scene.write_text(text)
        said: list[str] = []

        def is_told() -> bool:
            said.extend(filter(None, [self.told()]))
            return bool(said)

        while self.told():
            pass  # of former reloads
        self.daemon.process.send_signal(signal.SIGHUP)
        gap_s = self.hear(patience_s, is_told)
        gap_s = max(gap_s, self.hear(0.3))
        return Reloaded(self.alive, "".join(said), gap_s)

    def rss_mib(self) -> float:
        return usage(self.daemon.pid).rss_kib / MIB if self.alive else 0.0

    def forget_peak(self) -> None:
        Path(f"/proc/{self.daemon.pid}/clear_refs").write_text("5")

    def peak_mib(self) -> float:
        """Most memory since `forget_peak`."""
        return _peak_mib(self.daemon.pid) if self.alive else 0.0

    def stops_in_s(self) -> float:
        """How long it takes from SIGTERM to its end, s; it is killed after five."""
        began_s = time.monotonic()
        with contextlib.suppress(subprocess.TimeoutExpired):
            self.daemon.terminate()
        return time.monotonic() - began_s


def _dotted(plan: Plan) -> Outcome:
    tried, gap_s, growth_mib, held = 0, 0.0, 0.0, True
    ways = [(way, size) for size in SIZES for way in DOTTED]
    with Running(plan.folder) as running:
        rest_mib = running.rss_mib()
        end_s = time.monotonic() + max(plan.seconds, 1.0)
        for way, size in itertools.cycle(ways):
            running.forget_peak()
            found = running.reload(DOTTED[way](size) + "\n" + scene(plan.folder))
            tried += 1
            gap_s = max(gap_s, found.gap_s)
            growth_mib = max(growth_mib, running.peak_mib() - rest_mib)
            fits = found.gap_s < GAP_MAX_S and growth_mib < GROWTH_MAX_MIB
            held = held and found.alive and found.told == REFUSED and fits
            if not found.alive:
                return Outcome(tried, f"the daemon is gone after {way}, {size} bytes", False)
            if tried >= len(ways) and time.monotonic() > end_s:
                break
        held = held and running.stops_in_s() < STOP_MAX_S
    happened = (
        f"longest gap in the verdicts {gap_s * 1e3:.0f} ms, memory at most +{growth_mib:.0f} MiB"
    )
    return Outcome(tried, happened, held)


def _storm(plan: Plan) -> Outcome:
    sent, gap_s = 0, 0.0
    with Running(plan.folder) as running:
        running.hear(3.0)  # all that it needs it has by then
        rest_mib = running.rss_mib()

        def hang_up(stop: threading.Event) -> None:
            nonlocal sent
            while not stop.wait(0.0005):
                with contextlib.suppress(ProcessLookupError):
                    os.kill(running.daemon.pid, signal.SIGHUP)
                sent += 1

        with at_work(hang_up):
            gap_s = running.hear(max(plan.seconds, 4.0))
        growth_mib = running.rss_mib() - rest_mib
        running.hear(2.0)  # the last one was late
        other = running.reload(scene(plan.folder, 'name = "mlp"'))
        stops_s = running.stops_in_s()
    taken = other.alive and other.told.endswith("mlp")
    held = taken and gap_s < SWAP_MAX_S and growth_mib < GROWTH_MAX_MIB
    happened = (
        f"memory {growth_mib:+.0f} MiB, longest gap in the verdicts {gap_s * 1e3:.0f} ms, "
        f"ends {stops_s:.1f} s after SIGTERM"
    )
    return Outcome(sent, happened, held and stops_s < STOP_MAX_S)


def _model(plan: Plan) -> Outcome:
    text = scene(plan.folder, f'path = "{giant(plan.folder)}"')
    tried, gap_s, stops_s, held = 0, 0.0, 0.0, True
    for _ in plan.rounds():
        tried += 1
        with Running(plan.folder) as running:
            reloaded = running.reload(text)
            gap_s = max(gap_s, reloaded.gap_s)
            held = held and reloaded.alive and reloaded.told == REFUSED
            running.scene.write_text(text)
            running.daemon.process.send_signal(signal.SIGHUP)
            running.hear(0.5)  # SIGTERM comes while it is read
            stops_s = max(stops_s, running.stops_in_s())
    happened = (
        f"the reload is {'refused' if held else 'not refused'}, longest gap in the verdicts "
        f"{gap_s * 1e3:.0f} ms, ends {stops_s:.1f} s after SIGTERM"
    )
    return Outcome(tried, happened, held and gap_s < GAP_MAX_S and stops_s < STOP_MAX_S)


ATTACKS = (
    Attack(
        "scene-nested",
        Aim.FALLS,
        "SIGHUP with scenes of 32 to 96 kB that nest: dotted keys, arrays, inline tables",
        "scenes",
        _dotted,
    ),
    Attack("sighup-storm", Aim.FALLS, "SIGHUP every half millisecond", "signals", _storm),
    Attack(
        "model-giant",
        Aim.FALLS,
        "a model that multiplies matrices for minutes, at SIGHUP",
        "models",
        _model,
    ),
)
