"""Whether graspd can run for months: a daemon under faults and outages, watched for leaks.

`python -m tests.bench.soak --seconds 120` prints what was found beside its limits, and exits 1 if
one is broken. The daemon, the SPI twin and a second subscriber are processes of their own. With
`--rate 1000` an hour's worth of readings takes six minutes. What is said when, and what is lost,
is checked in simulated time: `tests/daemon/run/days.py`.
"""

from __future__ import annotations

import argparse
import itertools
import random
import signal
import subprocess
import sys
import tempfile
import time
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from scipy.stats import theilslopes

from graspd.daemon.publish.messages import Verdict
from graspd.models.training.evaluating.files import markdown_table
from tests.bench.live import (
    PATIENCE_S,
    STOP_S,
    Child,
    Usage,
    end_children_at_sigterm,
    running,
    spi_section,
    usage,
)
from tests.daemon.processes import GRASPD, before_others

SLOPE_MAX_KIB_PER_H = 1024.0
"""Largest growth of memory, KiB/h: 3 bytes per reading at 100 Hz, less than any object kept."""
GRAIN_KIB = 512
"""Growth below this is not a leak yet: an allocator takes pages as it likes. In the second minute
of two at 100 Hz it is 87 bytes per reading; the smallest array has 112."""
SPAN_MIN_S = 45.0
"""Shortest span after the warm-up, s, whose memory and descriptors are judged, not only shown."""
MOST_SHARE = 0.9
WARM_UP_S, WARM_UP_SHARE = 60.0, 0.5
"""Memory and descriptors are not judged in the first minute: caches fill, the first outages come.
They grew 1.8 MiB in the first 20 s, 0.4 MiB in the next 40 s, and 0.2 MiB in the minute after.
A run of less than two minutes warms up for this share of it."""
SLOPE_SAMPLES = 500
"""Most samples that the slope uses, of 7200 an hour, as it uses all pairs of them."""


@dataclass(slots=True)
class Heard:
    """Counts of the messages that a subscriber received."""

    messages: int = 0
    readings: int = 0
    """Verdicts with another reading time than the one before; others say that no reading came."""
    gaps: int = 0
    boots: set[str] = field(default_factory=set)
    _last: Verdict | None = None

    def add(self, verdict: Verdict) -> None:
        """Count a verdict."""
        former, self._last = self._last, verdict
        self.messages += 1
        if verdict.boot_id not in self.boots:
            self.boots.add(verdict.boot_id)
        elif former is not None:
            self.gaps += abs(verdict.seq - former.seq - 1)
            self.readings += verdict.t_mono_ns != former.t_mono_ns


@dataclass(frozen=True, slots=True)
class Found:
    """Results of a soak."""

    samples: Sequence[Usage]
    """Memory, descriptors and threads of the daemon, one sample each `SAMPLE_S`."""
    heard: Heard
    outages: int
    """Number of times that a twin was killed or a subscriber stopped."""
    exit_code: int
    planned: float = 0.0
    """Readings that would have come without faults and outages."""
    ended_early: bool = False
    """True if the daemon ended before it was told to stop."""


@dataclass(frozen=True, slots=True)
class Row:
    """One line of the result."""

    name: str
    value: float
    limit: float | None = None
    unit: str = ""

    @property
    def broken(self) -> bool:
        """True if the value is above its limit; False without a limit."""
        return self.limit is not None and self.value > self.limit

    def cells(self) -> tuple[str, str, str]:
        """Return name, value and limit as text for the table; a broken value has a `!`."""
        limit = "" if self.limit is None else f"{self.limit:g}"
        value = f"{self.value:,.2f}".rstrip("0").rstrip(".")
        return self.name, f"{value} {self.unit}{' !' if self.broken else ''}".strip(), limit


FEW = 0.2
"""Smallest share of the planned readings that must come: with fewer the soak tried too little."""


def judge(found: Found) -> list[Row]:
    """Return the rows of the table, each with a value and its limit."""
    heard = found.heard
    return [
        Row("readings", heard.readings),
        Row("missing of a fifth of the plan's", max(FEW * found.planned - heard.readings, 0), 0),
        Row("ended before it was told to", found.ended_early, 0),
        Row("outages", found.outages),
        *(_resources(found.samples) if found.samples else ()),
        Row("gaps in seq", heard.gaps, 0),
        Row("restarts", max(len(heard.boots) - 1, 0) + (not heard.boots), 0),
        Row("exit code", abs(found.exit_code), 0),
    ]


def _resources(samples: Sequence[Usage]) -> list[Row]:
    """Return the rows of memory, descriptors and threads, from the end of the warm-up on."""
    began_s, ended_s = samples[0].t_s, samples[-1].t_s
    warm_s = began_s + min(WARM_UP_SHARE * (ended_s - began_s), WARM_UP_S)
    judged = [sample for sample in samples if sample.t_s >= warm_s]
    few = judged[:: -(-len(judged) // SLOPE_SAMPLES)]
    hours = np.array([sample.t_s for sample in few]) / 3600
    # The median of the slopes between all pairs of points: one jump does not count.
    per_h = float(theilslopes([sample.rss_kib for sample in few], hours).slope)
    span_h = float(hours[-1] - hours[0])
    long_enough = span_h >= SPAN_MIN_S / 3600
    third = max(len(judged) // 3, 1)
    slope_max = max(SLOPE_MAX_KIB_PER_H, GRAIN_KIB / max(span_h, 1e-6)) if long_enough else None
    rows = [
        Row("memory", judged[-1].rss_kib / 1024, None, "MiB"),
        Row("memory slope", per_h, slope_max, "KiB/h"),
    ]
    for name in ("descriptors", "threads"):
        first, last = (most(name, part) for part in (judged[:third], judged[-third:]))
        rows.append(Row(f"{name} more at the end", last - first, 0 if long_enough else None))
    return rows


def most(name: str, samples: Sequence[Usage]) -> float:
    """Return the number of `descriptors` or `threads` (`name`) that nine samples in ten do not
    exceed, as a link or a file may be open for a moment."""
    held = [getattr(sample, name) for sample in samples]
    return float(np.quantile(held, MOST_SHARE, method="lower"))


SAMPLE_S = 0.5
IDLE_S = 0.05
"""Longest wait before outages and samples that are due, s."""
BETWEEN_S = (1.0, 8.0)
"""Range of the time between two outages, s."""
HURRY_S = 60.0
"""Run length, s, below which outages are shorter, so that each kind occurs."""
AWAY_S = (0.1, 2.0)
"""Range of the time until a killed twin is replaced, s."""
STOPPED_S = (1.0, 5.0)
"""Range of the time for which a subscriber is stopped, s: less than its queue holds at 100 Hz."""
FAULTS = (
    *("--bit-flip", "0.002", "--drop", "0.002", "--duplicate", "0.002"),
    *("--disconnect-every", "500", "--dead", "ff_3", "--dead", "th_17"),
)
QUEUE = 1000
"""Most messages that wait for a subscriber: enough that a slow one loses none."""
LISTENER = """
import sys, zmq
socket = zmq.Context().socket(zmq.SUB)
socket.connect(sys.argv[1])
socket.subscribe("verdict.")
socket.recv_multipart()
print("hears", flush=True)
while True:
    socket.recv_multipart()
"""
"""Program of a subscriber that drops what it receives, and prints a line at the first message."""


@dataclass(frozen=True, slots=True)
class Plan:
    """Length, rate and seed of a soak."""

    seconds: float
    rate_hz: float = 100.0
    seed: int = 0


class Soak:
    """A daemon, a twin that is killed now and then, and subscribers, one of which is stopped."""

    def __init__(self, folder: Path, plan: Plan) -> None:
        self._plan = plan
        self._folder = folder
        self._random = random.Random(plan.seed)
        self._heard = Heard()
        self._samples: list[Usage] = []
        self._sample_s = time.monotonic()
        self._deeds: deque[tuple[float, Callable[[], None]]] = deque()
        self._outages = 0

    def run(self) -> Found:
        """Run the soak. Raises `RuntimeError` with the daemon's log if that does not start."""
        sections = f'{spi_section(self._folder)}[session]\nfolder = "{self._folder}/session"\n'
        listener = [sys.executable, "-c", LISTENER, f"ipc://{self._folder}/v"]
        with (
            running(self._folder, sections, high_water_mark=QUEUE) as (
                self._daemon,
                self._subscriber,
            ),
            Child(listener, stdout=subprocess.PIPE) as self._other,
            ExitStack() as self._twins,
        ):
            self._hear(lambda: self._heard.messages > 1 or self._has_ended(), PATIENCE_S)
            if self._heard.messages < 2:
                said = (self._folder / "log").read_text()
                raise RuntimeError(f"no word of the daemon: {said}")
            if self._other.stdout is not None:
                self._other.stdout.readline()
            self._add_twin()
            self._hear(lambda: self._heard.readings > 0 or self._has_ended(), PATIENCE_S)
            self._samples.clear()
            self._plan_deeds()
            self._hear(self._has_ended, self._plan.seconds)
            ended_early = self._has_ended()
            self._daemon.terminate()
            return Found(
                samples=self._samples,
                heard=self._heard,
                outages=self._outages,
                exit_code=self._daemon.wait(STOP_S),
                planned=self._plan.rate_hz * self._plan.seconds,
                ended_early=ended_early,
            )

    def _has_ended(self) -> bool:
        return self._daemon.poll() is not None

    def _hear(self, done: Callable[[], bool], seconds: float) -> None:
        """Receive verdicts, run outages that are due and sample the daemon, for `seconds` or until
        `done`."""
        until_s = time.monotonic() + seconds
        while (now_s := time.monotonic()) < until_s and not done():
            verdict = self._subscriber.verdict(min(until_s - now_s, IDLE_S))
            if verdict is not None:
                self._heard.add(verdict)
            while self._deeds and self._deeds[0][0] <= now_s:
                self._deeds.popleft()[1]()
            if now_s >= self._sample_s and not self._has_ended():
                self._samples.append(usage(self._daemon.pid))
                self._sample_s = now_s + SAMPLE_S

    def _plan_deeds(self) -> None:
        """Draw begin and end of each outage, in the order of time, both kinds in turn."""
        at_s = time.monotonic()
        end_s = at_s + self._plan.seconds
        pace = min(self._plan.seconds / HURRY_S, 1.0)
        kinds = itertools.cycle(
            [
                (self._kill_twin, self._add_twin, AWAY_S),
                (self._stop_other, self._wake_other, STOPPED_S),
            ]
        )
        for begin, end, lasts_s in kinds:
            at_s += pace * self._random.uniform(*BETWEEN_S)
            back_s = at_s + pace * self._random.uniform(*lasts_s)
            if back_s >= end_s:
                return
            self._deeds += [(at_s, begin), (back_s, end)]
            at_s = back_s

    def _kill_twin(self) -> None:
        # As with a real adapter its path goes with it: else it leads to the next terminal that gets
        # this number, and that may be anybody's.
        self._twin.send_signal(signal.SIGSTOP)
        (self._folder / "bridge").unlink(missing_ok=True)
        self._twin.kill()
        self._twin.wait()
        self._outages += 1

    def _add_twin(self) -> None:
        path, rate_hz = self._folder / "bridge", self._plan.rate_hz
        seed = self._plan.seed + self._outages
        command = [*GRASPD, "twin", "spi", "--path", path, "--rate", rate_hz, "--seed", seed]
        quiet = subprocess.DEVNULL
        child = Child([*map(str, command), *FAULTS], stdout=quiet, stderr=quiet)
        self._twin = self._twins.enter_context(child)

    def _stop_other(self) -> None:
        self._other.send_signal(signal.SIGSTOP)
        self._outages += 1

    def _wake_other(self) -> None:
        self._other.send_signal(signal.SIGCONT)


def main() -> int:
    """Run a soak and print its table; return 1 if a limit is broken."""
    parser = argparse.ArgumentParser(prog="python -m tests.bench.soak", description=__doc__)
    parser.add_argument("--seconds", type=float, default=120.0)
    parser.add_argument("--rate", type=float, default=100.0, metavar="HZ")
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    end_children_at_sigterm()
    with before_others(), tempfile.TemporaryDirectory() as folder:
        rows = judge(Soak(Path(folder), Plan(given.seconds, given.rate, given.seed)).run())
    head = ("", "found", "at most")
    lines = markdown_table(head, [row.cells() for row in rows], right=head[1:])
    sys.stdout.write("\n".join(lines) + "\n")
    return int(any(row.broken for row in rows))


if __name__ == "__main__":
    sys.exit(main())
