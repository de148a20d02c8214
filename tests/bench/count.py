"""Count what a reading costs: instructions, and lines (64 bytes) of memory that it touches.

    python -m tests.bench.count

judges idle readings and readings of a held grasp, from counts to judgement, in a program that
cachegrind simulates, and prints what each adds. A buffer that fills the cache is read before each,
so each line that a reading touches is a miss. Copied into an older commit, it counts that.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tomllib
from itertools import islice
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from numpy.typing import NDArray

from graspd.daemon.assembly import assembly
from graspd.daemon.assembly.plan import Plan
from graspd.daemon.scene.scene import Scene
from graspd.drivers.base import TactileReading
from graspd.drivers.recordings.csv_player import DEMO_RECORDING
from graspd.drivers.twins.grasps.grasps import recorded_counts

READINGS = 1000
"""Readings of each kind that are counted: many, as start-up's cost varies by that of 20."""
IDLE, HELD = slice(100, 150), slice(255, 285)
"""Rows of the demo in which nothing touches, and in which its first grasp is judged."""
NOISE_COUNTS = 3.0
"""Standard deviation of the noise added to counts: without any, readings would repeat."""
PERIOD_NS = 10_000_000
CACHE_BYTES = 1 << 21
"""Size of the simulated cache whose misses count: larger than what a reading touches."""
SCENE = """
[tactile]
driver = "spi"
port = "/dev/none"
sensors = ["ff", "mf", "th"]
"""


def judge(kind: str) -> None:
    """Judge the demo's first grasp, and `READINGS` more readings of a kind: of an open hand
    (`idle`) or a held grasp (`judged`); for another `kind` none. Runs within cachegrind."""
    now_ns = 0
    scene = Scene.model_validate(tomllib.loads(SCENE))
    pipeline = assembly.build_pipeline(Plan.of(scene), assembly.load_model(scene), lambda: now_ns)
    demo = np.array(list(islice(recorded_counts(DEMO_RECORDING), HELD.stop)))
    faults = np.zeros(demo[0].shape, dtype=np.uint8)
    noise = np.random.default_rng(1).normal(0.0, NOISE_COUNTS, (READINGS, *faults.shape))
    filling = np.zeros(2 * CACHE_BYTES, dtype=np.uint8)

    def feed(counts: NDArray[np.uint16]) -> None:
        nonlocal now_ns
        now_ns += PERIOD_NS
        pipeline.judge(TactileReading(now_ns, now_ns // PERIOD_NS, counts, faults))

    def feed_more(place: slice, *, is_counted: bool) -> None:
        for counts in (demo[place].mean(axis=0) + noise).astype(np.uint16):
            filling.max()
            if is_counted:
                pipeline.ask()
                feed(counts)

    for counts in demo[: IDLE.stop]:
        feed(counts)
    feed_more(IDLE, is_counted=kind == "idle")
    for counts in demo[IDLE.stop :]:
        feed(counts)
    feed_more(HELD, is_counted=kind == "judged")


def count(kind: str) -> dict[str, int]:
    """Run `judge(kind)` in cachegrind, and return its counts by the names of its events."""
    with TemporaryDirectory() as folder:
        path = Path(folder, "counts")
        options = "--cache-sim=yes", f"--LL={CACHE_BYTES},16,64", f"--cachegrind-out-file={path}"
        subprocess.run(
            ["valgrind", "--tool=cachegrind", *options, sys.executable, "-m", __spec__.name, kind],
            env=os.environ | {"PYTHONHASHSEED": "0"},
            check=True,
        )
        lines = dict(line.split(": ", 1) for line in path.read_text().splitlines() if ": " in line)
    return dict(zip(lines["events"].split(), map(int, lines["summary"].split()), strict=True))


if __name__ == "__main__":
    if len(sys.argv) == 2:
        judge(sys.argv[1])
        sys.exit()
    none = count("none")
    for kind in ("judged", "idle"):
        counts = count(kind)
        added = {event: (counts[event] - none[event]) / READINGS for event in none}
        lines = added["ILmr"] + added["DLmr"] + added["DLmw"]
        sys.stdout.write(f"{kind}: {added['Ir']:,.0f} instructions, {lines:,.0f} lines\n")
