"""A daemon at work, for soaks and benches: real processes and links, only the hardware is a twin.

`python -m tests.bench.live twin PLAN` is the process of a twin, `... listen ENDPOINT` that of a
subscriber that does nothing with what it hears.
"""

from __future__ import annotations

import argparse
import contextlib
import itertools
import os
import re
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, Self

import msgspec
import numpy as np
import zmq
from numpy.typing import NDArray

from graspd.daemon.publish.keys import load_pair
from graspd.daemon.publish.messages import Verdict
from graspd.drivers.base import FINGERS
from graspd.drivers.spi.messages import Message, Sweep
from graspd.drivers.twins.can import CanTwin
from graspd.drivers.twins.faults import LinkFaults
from graspd.drivers.twins.grasps.grasp_script import Durations
from graspd.drivers.twins.grasps.grasps import Counts
from graspd.drivers.twins.grasps.whole_grasps import synthetic_grasps
from graspd.drivers.twins.spi import SpiTwin
from tests.kit.messages import decode_verdict

PATIENCE_S = 30.0
"""Longest wait for what must come, s."""
STOP_S = 5.0
"""Longest wait for a process that was told to stop, s."""
CPUS = sorted(os.sched_getaffinity(0))
SEED = 1
"""A synthetic grasp that `cnn1` judges."""
HELD = Durations(first_rest_s=(1.5, 1.5), settle_s=(600.0, 600.0))
"""A grasp that is closed once and then held."""
HELD_SWEEPS = 300
"""Different sweeps of a held grasp, over and over: drawing them costs more than sending them."""
SETTLED_SWEEPS = 200
"""Sweeps after which skin and fluid have yielded."""
HEARING = "hearing"
DRAIN_S = 0.5
"""How long a twin that was told to stop stays there, s, so that all it sent is read."""

Kind = Literal["spi", "can"]
Tally = NDArray[np.int64]
"""What a twin's processes did so far, in the order of `TALLIED`, in shared memory."""
TALLIED = ("sweeps", "disconnect", "drop", "bit_flip", "duplicate", "reorder", "unsent")
"""Sweeps made, faults put in by name, and frames that the link did not take."""


class TwinPlan(msgspec.Struct, frozen=True, kw_only=True):
    """What a twin's process shall do."""

    kind: Kind
    where: str
    """Path of the pseudo-terminal, or multicast group."""
    tally: str
    """File of a `Tally`; each process goes on where the one before it ended."""
    rate_hz: float = 100.0
    faults: LinkFaults = LinkFaults()
    ends: str | None = None
    """File for the time of each sweep's end, monotonic ns, 64-bit integers, in its place by the
    tally (`spi` only)."""


def new_tally(path: Path) -> Tally:
    """A tally of nothing."""
    return np.memmap(path, dtype=np.int64, mode="w+", shape=len(TALLIED))


def held_grasp() -> Iterator[Counts]:
    """Counts of a grasp that is held for ten minutes."""
    return (moment.counts for moment in synthetic_grasps(1, durations=HELD, seed=SEED))


def judged_counts() -> Iterator[Counts]:
    """Counts of a hand that rests, and then holds a grasp for ever."""
    drawn: list[Counts] = []
    settled = 0
    grasp = synthetic_grasps(1, durations=HELD, seed=SEED)
    (timetable,) = grasp.timetables()
    for moment in grasp:
        yield moment.counts
        settled += moment.t_s >= timetable.closed_s
        if settled > SETTLED_SWEEPS:
            drawn.append(moment.counts)
        if len(drawn) == HELD_SWEEPS:
            break
    yield from itertools.cycle(drawn)


def _counts(plan: TwinPlan) -> Iterator[Counts]:
    return (moment.counts for moment in synthetic_grasps(rate_hz=plan.rate_hz, loop=True))


class TimedSpiTwin(SpiTwin):
    """Notes when each sweep ends."""

    def __init__(self, plan: TwinPlan) -> None:
        super().__init__(Path(plan.where), _counts(plan), rate_hz=plan.rate_hz, faults=plan.faults)
        self.ends_ns: list[int] = []

    def _send(self, message: Message, *, waits: bool = True) -> None:
        boot_ns = self._boot_ns
        super()._send(message, waits=waits)
        if isinstance(message, Sweep):
            self.ends_ns.append(boot_ns + message.tick_end * 1000)  # ticks of 1 us


def serve_twin(plan: TwinPlan) -> None:
    """Be a twin until SIGTERM."""
    stop = threading.Event()
    signal.signal(signal.SIGTERM, lambda _number, _frame: stop.set())
    tally: Tally = np.memmap(plan.tally, dtype=np.int64, mode="r+", shape=len(TALLIED))
    serve = _serve_spi if plan.kind == "spi" else _serve_can
    serve(plan, tally, stop)


def _serve_spi(plan: TwinPlan, tally: Tally, stop: threading.Event) -> None:
    before = tally.copy()
    twin = TimedSpiTwin(plan)
    ends_ns = None if plan.ends is None else np.memmap(plan.ends, dtype=np.int64, mode="r+")

    def is_over() -> bool:
        known = {**twin.injected, "sweeps": twin.sweeps_made, "unsent": twin.tx_dropped}
        tally[:] = before + [known.get(name, 0) for name in TALLIED]
        if ends_ns is not None:
            made = int(tally[0])
            ends_ns[made - len(twin.ends_ns) : made] = twin.ends_ns
        twin.ends_ns.clear()
        return stop.is_set()

    with twin:
        twin.serve(is_over)
        time.sleep(DRAIN_S)


def _serve_can(plan: TwinPlan, tally: Tally, stop: threading.Event) -> None:
    before = tally.copy()

    def counted() -> Iterator[Counts]:
        for sweeps, counts in enumerate(_counts(plan), 1):
            known = {**twin.injected, "sweeps": sweeps, "unsent": twin.unsent}
            tally[:] = before + [known.get(name, 0) for name in TALLIED]
            yield counts

    twin = CanTwin(
        "udp_multicast",
        plan.where,
        counted(),
        format="sweep_fd",
        arbitration_id=can_id(plan.where),
        rate_hz=plan.rate_hz,
        first_sweep=int(before[0]) % (1 << 16),
        faults=plan.faults,
    )
    with twin:
        twin.serve(stop)
        time.sleep(DRAIN_S)


def tactile_section(kind: Kind, where: str) -> str:
    """The scene's section for a twin there."""
    if kind == "spi":
        return f'[tactile]\ndriver = "spi"\nport = "{where}"\n'
    return (
        '[tactile]\ndriver = "can"\ninterface = "udp_multicast"\n'
        f'channel = "{where}"\nformat = "sweep_fd"\narbitration_id = {can_id(where)}\n'
    )


def can_id(where: str) -> int:
    """Of finger `ff`: python-can's sockets hear all groups that anybody on this computer joined."""
    _, _, third, fourth = map(int, where.split("."))
    return 0x10000 + (third << 8 | fourth) * len(FINGERS)


def where_of(kind: Kind, folder: Path) -> str:
    """A place for a twin that no other process uses."""
    if kind == "spi":
        return str(folder / "bridge")
    return f"239.74.{os.getpid() % 250}.{2 + time.monotonic_ns() // 1000 % 250}"


class Child:
    """A process that ends with the block."""

    def __init__(self, arguments: Sequence[str], log: Path | None = None) -> None:
        """`log` takes what it writes on stderr."""
        self._arguments = arguments
        self._log = log

    def __enter__(self) -> Self:
        with contextlib.ExitStack() as stack:
            log = stack.enter_context(self._log.open("a")) if self._log else subprocess.DEVNULL
            self.process = subprocess.Popen(
                [sys.executable, *self._arguments],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.PIPE,
                stderr=log,
            )
        return self

    def __exit__(self, *_details: object) -> None:
        self.kill()

    @property
    def pid(self) -> int:
        return self.process.pid

    def line(self) -> str:
        """The next line that it prints; waits for it."""
        return "" if self.process.stdout is None else self.process.stdout.readline().decode()

    def kill(self) -> None:
        """End it at once, stopped or not."""
        self.process.kill()
        self.process.wait()
        if self.process.stdout is not None:
            self.process.stdout.close()

    def terminate(self) -> tuple[int, str]:
        """Ask it to end; its exit code and what it printed. Raises `TimeoutExpired`."""
        self.process.terminate()
        printed, _ = self.process.communicate(timeout=STOP_S)
        return self.process.returncode, printed.decode()


def start_daemon(scene: Path, log: Path | None = None) -> Child:
    """The process of graspd, to be entered as a block."""
    return Child(["-m", "graspd", "run", str(scene)], log)


def start_twin(plan: TwinPlan) -> Child:
    """The process of a twin."""
    return Child(["-m", "tests.bench.live", "twin", msgspec.json.encode(plan).decode()])


def start_listener(endpoint: str) -> Child:
    """The process of a subscriber that does nothing with what it hears; see `listen`."""
    return Child(["-m", "tests.bench.live", "listen", endpoint])


class Subscriber:
    """Hears one daemon or several."""

    def __init__(
        self, *endpoints: str, topics: Sequence[str] = ("verdict.",), keys: Path | None = None
    ) -> None:
        """`keys`: folder of a daemon's key and of its client `friend`'s; None: without keys."""
        self._context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
        self._socket = self._context.socket(zmq.SUB)
        self._socket.rcvhwm = 0  # what is lost must be lost elsewhere
        if keys is not None:
            own = load_pair(keys / "clients" / "friend.key_secret")
            self._socket.curve_publickey, self._socket.curve_secretkey = own
            self._socket.curve_serverkey = load_pair(keys / "daemon.key_secret")[0]
        for topic in topics:
            self._socket.subscribe(topic)
        for endpoint in endpoints:
            self._socket.connect(endpoint)
        self.received_ns = 0
        """When the last message came, monotonic ns."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_details: object) -> None:
        self._socket.close(0)
        self._context.term()

    def take(self, timeout_s: float) -> tuple[bytes, bytes] | None:
        """Topic and payload of the next message; None if none comes in time."""
        if not self._socket.poll(max(round(timeout_s * 1e3), 0)):
            return None
        topic, payload = self._socket.recv_multipart()
        self.received_ns = time.monotonic_ns()
        return topic, payload

    def drain(self) -> None:
        """Drop what has come already."""
        while self.take(0.0) is not None:
            pass

    def verdict(self, timeout_s: float) -> Verdict | None:
        """Return the next verdict; None if none comes in time."""
        message = self.take(timeout_s)
        return None if message is None else decode_verdict(message[1])

    def wait_for(self, wanted: Callable[[Verdict], bool]) -> Verdict:
        """Return the first verdict like that. Raises `TimeoutError`."""
        deadline_s = time.monotonic() + PATIENCE_S
        while (verdict := self.verdict(deadline_s - time.monotonic())) is not None:
            if wanted(verdict):
                return verdict
        raise TimeoutError("the verdict that was waited for never came")


class Numbered(msgspec.Struct):
    """Of a message, its number."""

    seq: int


def listen(endpoint: str) -> None:
    """Hear until SIGTERM; print a line at the first message, and at the end the number missed."""
    stop = threading.Event()
    signal.signal(signal.SIGTERM, lambda _number, _frame: stop.set())
    heard: list[int] = []
    decoder = msgspec.json.Decoder(Numbered)
    with Subscriber(endpoint) as subscriber:
        while not stop.is_set():
            message = subscriber.take(0.1)
            if message is None:
                continue
            if not heard:
                print(HEARING, flush=True)  # noqa: T201
            heard.append(decoder.decode(message[1]).seq)
    print(int((np.diff(heard) - 1).sum()))  # noqa: T201


@dataclass(frozen=True, slots=True)
class Usage:
    """What a process has used and holds."""

    t_s: float
    """When, monotonic s."""
    cpu_s: float
    """Processor time of all its threads since its start."""
    rss_kib: int
    """Its memory, and what it has together with others."""
    descriptors: int
    threads: int


def usage(pid: int) -> Usage:
    """Of a process that runs (proc(5): stat fields 14, 15 and 20, smaps_rollup)."""
    about = Path(f"/proc/{pid}")
    fields = (about / "stat").read_text().rpartition(")")[2].split()
    memory = dict(re.findall(r"^(\w+):\s+(\d+) kB", (about / "smaps_rollup").read_text(), re.M))
    return Usage(
        t_s=time.monotonic(),
        cpu_s=(int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK"),
        rss_kib=int(memory["Rss"]),
        descriptors=len(os.listdir(about / "fd")),
        threads=int(fields[17]),
    )


def end_children_at_sigterm() -> None:
    """Have SIGTERM end the blocks of this process, and so the processes that it started."""
    signal.signal(signal.SIGTERM, lambda number, _frame: sys.exit(128 + number))


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m tests.bench.live", description=__doc__)
    kinds = parser.add_subparsers(dest="kind", required=True)
    kinds.add_parser("twin").add_argument("plan")
    kinds.add_parser("listen").add_argument("endpoint")
    given = parser.parse_args()
    if given.kind == "twin":
        serve_twin(msgspec.json.decode(given.plan, type=TwinPlan))
    else:
        listen(given.endpoint)


if __name__ == "__main__":
    main()
