"""How soon the grasp controller knows that something is gone: a sensor, the link, joints, graspd.

`python -m tests.bench.outages --rounds 20` prints, for each outage, the times from the deed to the
first `unknown` at a subscriber in another process than the daemon: real processes, a real serial
line and real sockets; only the hardware is a twin.
"""

from __future__ import annotations

import argparse
import contextlib
import queue
import socket
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Self

import numpy as np

from graspd.daemon.judge.reasons import Decision, Reason
from graspd.daemon.publish.messages import Verdict
from graspd.drivers.joints import JointMessage
from graspd.drivers.twins.spi import SpiTwin
from tests.bench.live import (
    PATIENCE_S,
    Child,
    Subscriber,
    held_grasp,
    start_daemon,
    tactile_section,
)
from tests.ports import free_port
from tests.threads import at_work

JOINTS = ("FFJ3", "MFJ3", "THJ5")
JOINT_PERIOD_S = 0.01
JOINT_NOISE_RAD = 0.0003


class Bench:
    """Daemon, twin, joints and subscriber, with a grasp held and judged."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._deeds: queue.SimpleQueue[tuple[Callable[[], object], threading.Event]] = (
            queue.SimpleQueue()
        )
        self.joints_flow = threading.Event()
        self.joints_flow.set()
        self.twin = SpiTwin(folder / "bridge", held_grasp())
        self._subscriber = Subscriber(f"ipc://{folder}/graspd")

    def __enter__(self) -> Self:
        with contextlib.ExitStack() as stack:
            stack.enter_context(self._subscriber)
            stack.enter_context(self.twin)
            joint_socket = stack.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
            port = free_port(socket.SOCK_DGRAM)
            joint_socket.connect(("127.0.0.1", port))
            send_joints = partial(self._send_joints, joint_socket)
            stack.enter_context(at_work(self._serve_twin, send_joints))
            self.daemon: Child = stack.enter_context(start_daemon(self._scene(port)))
            self._stack = stack.pop_all()
        return self

    def __exit__(self, *_details: object) -> None:
        self._stack.close()

    def on_twin(self, deed: Callable[[], object]) -> Callable[[], None]:
        """The deed, done by the twin's own thread; returns when it is done."""

        def ask() -> None:
            done = threading.Event()
            self._deeds.put((deed, done))
            done.wait(PATIENCE_S)

        return ask

    def _serve_twin(self, stop: threading.Event) -> None:
        def is_over() -> bool:
            while not self._deeds.empty():
                deed, done = self._deeds.get()
                deed()
                done.set()
            return stop.is_set()

        self.twin.serve(is_over)

    def _scene(self, port: int) -> Path:
        path = self._folder / "scene.toml"
        path.write_text(
            f"{tactile_section('spi', str(self._folder / 'bridge'))}"
            f'[joints]\ndriver = "stream"\nsource = "udp://127.0.0.1:{port}"\n'
            f'[model]\nname = "cnn1"\n[publish]\nendpoint = "ipc://{self._folder}/graspd"\n'
        )
        return path

    def _send_joints(self, joint_socket: socket.socket, stop: threading.Event) -> None:
        seq, random = 0, np.random.default_rng(1)
        while not stop.wait(JOINT_PERIOD_S):
            if self.joints_flow.is_set():
                angles = 0.8 + JOINT_NOISE_RAD * random.standard_normal(len(JOINTS))
                message = JointMessage(seq, None, JOINTS, angles)
                with contextlib.suppress(OSError):  # the daemon is not there
                    joint_socket.send(message.to_bytes())
                seq += 1

    def wait_for(self, wanted: Callable[[Verdict], bool]) -> float:
        """Return when the first verdict like that came from now on, s. Raises `TimeoutError`."""
        self._subscriber.drain()
        self._subscriber.wait_for(wanted)
        return self._subscriber.received_ns / 1e9

    def until_unknown_s(self, deed: Callable[[], object], reason: Reason) -> float:
        """Do it while a verdict stands; s until one came that is unknown for this reason.

        A busy computer that stands still makes verdicts unknown for another one.
        """
        self.wait_for(is_valid)
        began_s = time.monotonic()
        deed()
        return (
            self.wait_for(lambda said: said.verdict is Decision.UNKNOWN and reason in said.reasons)
            - began_s
        )

    def until_silence_s(self, deed: Callable[[], object]) -> float:
        """Do it while a verdict stands; s until a subscriber knows by silence alone."""
        self._subscriber.drain()
        verdict: Verdict | None = self._subscriber.wait_for(is_valid)
        began_s = time.monotonic()
        deed()
        while verdict is not None:
            verdict = self._subscriber.verdict(verdict.silence_ms / 1e3)
        return time.monotonic() - began_s


def is_valid(verdict: Verdict) -> bool:
    """Whether the verdict says anything."""
    return verdict.valid


def outages(bench: Bench) -> Iterator[tuple[str, float]]:
    """Cause each outage once: its name, and s until unknown for the right reason."""
    twin = bench.twin
    pull = bench.on_twin(lambda: twin.pull_fingers(1))
    yield "sensor", bench.until_unknown_s(pull, Reason.SENSOR_MISSING)
    bench.on_twin(twin.pull_fingers)()
    yield "link", bench.until_unknown_s(bench.on_twin(twin.unplug), Reason.STALE)
    bench.on_twin(twin.plug)()
    took_s = bench.until_unknown_s(bench.joints_flow.clear, Reason.JOINTS_LATE)
    yield "joints", took_s
    began_s = time.monotonic()
    yield "joints, and judged without them", took_s + bench.wait_for(is_valid) - began_s
    bench.joints_flow.set()
    yield "daemon", bench.until_silence_s(bench.daemon.process.kill)


def main() -> None:
    """Print the times."""
    parser = argparse.ArgumentParser(prog="python -m tests.bench.outages", description=__doc__)
    parser.add_argument("--rounds", type=int, default=20)
    rounds = parser.parse_args().rounds
    times: dict[str, list[float]] = {}
    for _ in range(rounds):
        with tempfile.TemporaryDirectory() as folder, Bench(Path(folder)) as bench:
            for name, took_s in outages(bench):
                times.setdefault(name, []).append(1e3 * took_s)
    for name, found in times.items():
        middle, low, high = np.median(found), min(found), max(found)
        print(f"{name:32} {middle:6.0f} ms ({low:.0f} to {high:.0f})")  # noqa: T201


if __name__ == "__main__":
    main()
