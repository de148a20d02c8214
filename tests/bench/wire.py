"""From the last byte on the wire to the verdict in another process, readings paced at 100 Hz.

`python -m tests.bench.wire` prints a Markdown table. The twin, the daemon and the subscriber are
processes of their own, and CLOCK_MONOTONIC is the same to all. In the same run, in turns of some
seconds: a bare onnxruntime session of the same model, in a process of its own, and an empty echo
over the same path. With `[realtime]` echo and session run at the same priority. The last byte
counts from just before the system call that writes it: it may return late, after the daemon has
begun. Needs stress-ng for the loaded half. What must be told to 5 %: `tests.bench.count`.
"""

from __future__ import annotations

import argparse
import json
import os
import select
import subprocess
import sys
import tempfile
import termios
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

import numpy as np
import zmq
from numpy.typing import NDArray

from drivers.spi.messages import DELIMITER, Start, encode
from models import zoo
from models.runtime import TactileModel
from tests.bench.hands import (
    ECHO,
    PERIOD_S,
    PRIORITY,
    WARM_UP_S,
    Hand,
    Micros,
    Record,
    matched,
    measure,
    percentiles,
    promote,
)
from tests.bench.live import (
    PATIENCE_S,
    Child,
    end_children_at_sigterm,
    table,
)

MODELS = ("cnn1", "small-session")
SESSION_SHARE = 1.3
"""The aim: p50 within the echo plus so many times the session."""
VERDICT_BYTES = 400
"""What the echo sends: as long as a verdict."""
SWEEP_MIN_BYTES = 100
"""A SWEEP has 170 bytes, a STATUS 40."""
GREETING_S = 0.2
"""A bridge that was just plugged in has said HELLO by then, and sends no more before START."""
AS_ECHO = ("-m", "tests.bench.wire", "--echo")
LOADS = ("idle", "loaded")
STRESS = ("stress-ng", "--cpu", "2", "--quiet")


@dataclass(slots=True)
class Times:
    """What was measured of one candidate, us, each array one value per reading."""

    whole: list[Micros] = field(default_factory=list)
    """From just before the system call that wrote the last byte to the subscriber."""
    published: list[Micros] = field(default_factory=list)
    """From just before that call until the daemon passed the verdict to ZeroMQ."""
    cpu_percent: list[float] = field(default_factory=list)

    def add(self, record: Record, stamps_ns: NDArray[np.int64], cpu_percent: float) -> None:
        """Take in a turn. Raises `RuntimeError` if messages and sweeps do not fit."""
        known, sweeps = matched(record, stamps_ns)
        written = stamps_ns[sweeps, 1]
        self.whole.append((np.array(record.received_ns)[known] - written) / 1e3)
        self.published.append((np.array(record.published_ns)[known] - written) / 1e3)
        self.cpu_percent.append(cpu_percent)


@dataclass(frozen=True, slots=True)
class Options:
    """How to measure."""

    seconds: float
    settled: bool


def daemon_turn(options: Options, model: str, times: Times, realtime: bool) -> None:
    """One turn of the daemon."""
    with (
        tempfile.TemporaryDirectory() as folder,
        Hand(Path(folder), settled=options.settled) as hand,
    ):
        hand.start_daemon(model, realtime=realtime)
        cpu = measure(hand, options.seconds)
        times.add(hand.record, hand.stop(), cpu)


def echo_turn(options: Options, times: Times, realtime: bool) -> None:
    """One turn of the empty echo."""
    with (
        tempfile.TemporaryDirectory() as folder,
        Hand(Path(folder)) as hand,
    ):
        hand.publish(Child([*AS_ECHO, hand.where, hand.endpoint], hand.log))
        if realtime:
            promote(hand.publisher.pid, PRIORITY)
        cpu = measure(hand, options.seconds, echo=True)
        times.add(hand.record, hand.stop(), cpu)


def session_turn(options: Options, model: str, times: Times, realtime: bool) -> None:
    """One turn of the bare session."""
    arguments = ["-m", "tests.bench.wire", "--session", model, str(options.seconds)]
    with Child(arguments) as child:
        if realtime:
            promote(child.pid, PRIORITY)
        printed, _ = child.process.communicate(timeout=options.seconds + PATIENCE_S)
    times.whole.append(np.array(json.loads(printed), dtype=np.float64))


def run_session(model: str, seconds: float) -> None:
    """The process of the bare session: print what each run took, us."""
    bare = TactileModel(zoo.find(model))
    bare.input[...] = np.random.default_rng(0).normal(size=bare.input.shape)
    took_us = []
    due_s = time.monotonic() + WARM_UP_S
    for _ in range(round(seconds / PERIOD_S)):
        due_s += PERIOD_S
        time.sleep(max(due_s - time.monotonic(), 0.0))
        began_ns = time.perf_counter_ns()
        bare.run()
        took_us.append((time.perf_counter_ns() - began_ns) / 1e3)
    sys.stdout.write(json.dumps(took_us))


def run_echo(where: str, endpoint: str) -> None:
    """The process of the echo: for each sweep as many bytes as a verdict, without looking at it."""
    with zmq.Context() as context, context.socket(zmq.PUB) as out:
        out.bind(endpoint)
        padding = bytes(VERDICT_BYTES - ECHO.size)
        for number, _ in enumerate(whole_sweeps(where)):
            head = ECHO.pack(number, time.monotonic_ns())
            out.send_multipart((b"verdict.right", head + padding))


def whole_sweeps(where: str) -> Iterator[None]:
    """Once for each sweep that has come."""
    while not Path(where).exists():
        time.sleep(PERIOD_S)
    time.sleep(GREETING_S)
    line = os.open(where, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
    termios.tcflush(line, termios.TCIFLUSH)
    os.write(line, encode(Start()))
    held = b""
    while True:
        select.select([line], [], [])
        *frames, held = (held + os.read(line, 4096)).split(DELIMITER)
        for frame in frames:
            if len(frame) >= SWEEP_MIN_BYTES:
                yield


@contextmanager
def load(name: str) -> Iterator[None]:
    """Both cores loaded, or not."""
    if name == "idle":
        yield
        return
    with subprocess.Popen(STRESS, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as stress:
        try:
            time.sleep(WARM_UP_S)
            yield
        finally:
            stress.terminate()


Case = tuple[str, bool, str]
"""Load, whether in realtime, and what by the names of `turns`."""
Turn = Callable[[Times, bool], None]
"""Adds what it measured to the times, in realtime or not."""


def turns(models: Sequence[str], options: Options) -> dict[str, Turn]:
    """What takes its turn, by name: `echo`, `session MODEL` and `daemon MODEL`."""
    found: dict[str, Turn] = {"echo": partial(echo_turn, options)}
    for model in models:
        found[f"session {model}"] = partial(session_turn, options, model)
        found[f"daemon {model}"] = partial(daemon_turn, options, model)
    return found


def run_all(given: argparse.Namespace) -> dict[Case, Times]:
    """Every case in every round."""
    options = Options(given.seconds, given.settled)
    found: dict[Case, Times] = {}
    for number in range(given.rounds):
        for load_name in given.loads:
            with load(load_name):
                for realtime in (False, True)[: 1 + given.realtime]:
                    for name, turn in turns(given.models, options).items():
                        sys.stderr.write(f"{number + 1}: {load_name} {realtime} {name}\n")
                        turn(found.setdefault((load_name, realtime, name), Times()), realtime)
    return found


HEAD = (
    "scene, load",
    "to the subscriber p50",
    "p99",
    "p99.9",
    "max, us",
    "to publishing p50",
    "echo p50",
    "session p50",
    f"of echo + {SESSION_SHARE:g} session",
    "CPU, %",
)


def rows(times: Mapping[Case, Times]) -> Iterator[list[str]]:
    """A row of the table for each case of the daemon, beside echo and session."""
    for (load_name, realtime, name), daemon in times.items():
        what, _, model = name.partition(" ")
        if what != "daemon":
            continue
        whole = percentiles(daemon.whole)
        echo = percentiles(times[load_name, realtime, "echo"].whole)["p50"]
        session = percentiles(times[load_name, realtime, f"session {model}"].whole)["p50"]
        micros = (*whole.values(), percentiles(daemon.published)["p50"], echo, session)
        yield [
            f"`{model}`, {load_name}{', `[realtime]`' if realtime else ''}",
            *(f"{us:.0f}" for us in micros),
            f"{whole['p50'] / (echo + SESSION_SHARE * session):.2f}",
            f"{np.mean(daemon.cpu_percent):.1f}",
        ]


def main() -> None:
    """Measure and print, or be one of the processes."""
    parser = argparse.ArgumentParser(prog="python -m tests.bench.wire", description=__doc__)
    parser.add_argument("--seconds", type=float, default=20.0, help="of each turn")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--models", nargs="+", default=MODELS, choices=zoo.names())
    parser.add_argument("--loads", nargs="+", default=LOADS, choices=LOADS)
    parser.add_argument("--no-realtime", dest="realtime", action="store_false")
    parser.add_argument(
        "--settled",
        action="store_true",
        help="whole grasps, each of which is judged once it has settled, as by default, instead of "
        "each reading of one that lasts",
    )
    parser.add_argument("--echo", nargs=2, help=argparse.SUPPRESS)
    parser.add_argument("--session", nargs=2, help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.echo:
        run_echo(*given.echo)
    elif given.session:
        run_session(given.session[0], float(given.session[1]))
    else:
        end_children_at_sigterm()
        sys.stdout.write(table(HEAD, list(rows(run_all(given)))))


if __name__ == "__main__":
    main()
