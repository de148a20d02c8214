"""A daemon at work, for soaks and attacks: real processes, only the hardware is a twin."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Self

import zmq

from graspd.daemon.publish.keys import load_pair
from graspd.daemon.publish.messages import Verdict
from graspd.drivers.twins.grasps.grasp_script import Durations
from graspd.drivers.twins.grasps.grasps import Counts
from graspd.drivers.twins.grasps.whole_grasps import RATE_HZ, synthetic_grasps
from tests.daemon.processes import GRASPD, graspd_with
from tests.kit.messages import decode_verdict

PATIENCE_S = 100.0
"""Longest wait for a message or verdict that must come, s."""
STOP_S = 5.0
"""Longest wait for a process that was told to stop, s."""
SEED = 1
"""Seed of a synthetic grasp that `cnn1` judges."""
HELD = Durations(first_rest_s=(1.5, 1.5), settle_s=(600.0, 600.0))
"""Durations of a grasp that closes once and is then held."""


def held_grasp() -> Iterator[Counts]:
    """Return the counts of a synthetic grasp that is held for ten minutes, sweep by sweep."""
    moments = synthetic_grasps(1, rate_hz=RATE_HZ, durations=HELD, seed=SEED)
    return (moment.counts for moment in moments)


def spi_section(folder: Path) -> str:
    """Return the scene's `[tactile]` section for an SPI twin at `bridge` in a folder."""
    return f'[tactile]\ndriver = "spi"\nport = "{folder}/bridge"\n'


class Child(subprocess.Popen[bytes]):
    """A process that is killed at the end of the block."""

    def __exit__(self, *details: object) -> None:
        self.kill()
        super().__exit__(*details)  # type: ignore[arg-type]


class Subscriber:
    """Subscribes to a daemon's messages, without losing any itself."""

    def __init__(
        self,
        endpoint: str,
        *,
        topics: Sequence[str] = ("verdict.",),
        keys: Path | None = None,
    ) -> None:
        """`topics`: beginnings of topics. `keys`: folder with `daemon.key_secret` and
        `clients/friend.key_secret`; None: without keys."""
        self._context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
        self._socket = self._context.socket(zmq.SUB)
        self._socket.rcvhwm = 0  # what is lost must be lost elsewhere
        if keys is not None:
            own = load_pair(keys / "clients" / "friend.key_secret")
            self._socket.curve_publickey, self._socket.curve_secretkey = own
            self._socket.curve_serverkey = load_pair(keys / "daemon.key_secret")[0]
        for topic in topics:
            self._socket.subscribe(topic)
        self._socket.connect(endpoint)
        self.received_ns = 0
        """When the last message came, monotonic ns."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_details: object) -> None:
        self._socket.close(0)
        self._context.term()

    def take(self, timeout_s: float) -> tuple[bytes, bytes] | None:
        """Return topic and payload of the next message; None if none comes in time."""
        if not self._socket.poll(max(round(timeout_s * 1e3), 0)):
            return None
        topic, payload = self._socket.recv_multipart()
        self.received_ns = time.monotonic_ns()
        return topic, payload

    def drain(self) -> None:
        """Drop all messages that have come already."""
        while self.take(0.0) is not None:
            pass

    def verdict(self, timeout_s: float) -> Verdict | None:
        """Return the next verdict; None if none comes in time."""
        message = self.take(timeout_s)
        return None if message is None else decode_verdict(message[1])

    def wait_for(self, wanted: Callable[[Verdict], bool]) -> Verdict:
        """Return the first verdict for which `wanted` is True. Raises `TimeoutError`."""
        deadline_s = time.monotonic() + PATIENCE_S
        while (verdict := self.verdict(deadline_s - time.monotonic())) is not None:
            if wanted(verdict):
                return verdict
        raise TimeoutError("the verdict that was waited for never came")


@contextlib.contextmanager
def running(
    folder: Path,
    sections: str,
    *,
    publish: str = "",
    high_water_mark: int | None = None,
    topics: Sequence[str] = ("verdict.",),
    endpoint: str | None = None,
    keys: Path | None = None,
) -> Iterator[tuple[Child, Subscriber]]:
    """Run a daemon on `scene.toml` in `folder`, and subscribe to it; its log is `log` there.

    The scene has `sections`, and a last one `[publish]` with the lines of `publish`. The `endpoint`
    is `v` in `folder` unless given. `high_water_mark`: most messages that wait for a subscriber;
    None: the daemon's own limit. `topics`: beginnings of those that the subscriber gets. `keys`:
    folder with the daemon's and the subscriber's keys; None: without.
    """
    endpoint = endpoint or f"ipc://{folder}/v"
    scene = folder / "scene.toml"
    scene.write_text(f'{sections}[publish]\nendpoint = "{endpoint}"\n{publish}')
    program: Sequence[str] = GRASPD
    if high_water_mark is not None:
        program = graspd_with("graspd.daemon.publish.sockets", HIGH_WATER_MARK=high_water_mark)
    command = [*program, "run", str(scene)]
    nothing = subprocess.DEVNULL
    with (
        (folder / "log").open("a") as log,
        Subscriber(endpoint, topics=topics, keys=keys) as subscriber,
        Child(command, stdin=nothing, stdout=nothing, stderr=log) as process,
    ):
        yield process, subscriber


@dataclass(frozen=True, slots=True)
class Usage:
    """Memory, descriptors and threads of a process at a time."""

    t_s: float
    """Time of the measurement, monotonic s."""
    rss_kib: int
    """Resident memory, including what is shared with other processes."""
    descriptors: int
    threads: int


def usage(pid: int) -> Usage:
    """Return the usage of a running process (proc(5): smaps_rollup)."""
    about = Path(f"/proc/{pid}")
    memory = (about / "smaps_rollup").read_text().partition("\nRss:")[2]
    return Usage(
        t_s=time.monotonic(),
        rss_kib=int(memory.split()[0]),
        descriptors=len(os.listdir(about / "fd")),
        threads=len(os.listdir(about / "task")),
    )


def memory_mib(pid: int) -> float:
    """Reset the peak of a process that `peak_mib` returns; return its resident memory now, MiB."""
    Path(f"/proc/{pid}/clear_refs").write_text("5")
    return peak_mib(pid)


def peak_mib(pid: int) -> float:
    """Return the most resident memory of a process since `memory_mib`, MiB; 0 after its end."""
    status = Path(f"/proc/{pid}/status").read_text()
    return int((status.partition("VmHWM:")[2].split() or ["0"])[0]) / 1024


def end_children_at_sigterm() -> None:
    """Have SIGTERM exit this process through its `with` blocks, which end its children."""
    signal.signal(signal.SIGTERM, lambda number, _frame: sys.exit(128 + number))
