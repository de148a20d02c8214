"""What the serial bridge's driver costs, with the twin in a process of its own.

`python -m tests.bench.spi` listens to 100 Hz for a minute, waiting as the daemon does, and prints
losses, the driver's own time per sweep and its share of a core; with `--replugs N` it also plugs
the twin out and in and prints how long the driver takes to be back.
"""

from __future__ import annotations

import argparse
import random
import select
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from drivers.spi.driver import SpiBridgeDriver
from drivers.twins.spi import SpiTwin
from tests.drivers.spi.bridge_bench import FINGERS, replug_times_s
from tests.drivers.twins.signals import GeneratedContact


def serve(path: Path, rate_hz: float) -> None:
    """The twin's process: runs until its input is closed."""
    with SpiTwin(path, GeneratedContact(len(FINGERS), rate_hz), rate_hz=rate_hz) as twin:
        twin.serve(lambda: bool(select.select([sys.stdin], [], [], 0)[0]))


def listen(driver: SpiBridgeDriver, seconds: float) -> tuple[list[float], list[float], float]:
    """Time in `read_ready` per reading, us, age of each reading, ms, and CPU time used, s."""
    spent_us, ages_ms = [], []
    end_s = time.monotonic() + seconds
    cpu_s = time.process_time()
    while time.monotonic() < end_s:
        descriptor, due_ns = driver.fileno(), driver.due_ns()
        wait_s = 0.1 if due_ns is None else max(due_ns - time.monotonic_ns(), 0) / 1e9
        select.select([] if descriptor is None else [descriptor], [], [], min(wait_s, 0.1))
        began_ns = time.perf_counter_ns()
        readings = driver.read_ready()
        took_us = (time.perf_counter_ns() - began_ns) / 1e3
        now_ns = time.monotonic_ns()
        for reading in readings:
            spent_us.append(took_us / len(readings))
            ages_ms.append((now_ns - reading.t_ns) / 1e6)
    return spent_us, ages_ms, time.process_time() - cpu_s


def measure(folder: Path, seconds: float, rate_hz: float) -> None:
    path = folder / "bridge"
    command = [sys.executable, "-m", "tests.bench.spi", "--serve", str(path)]
    twin = subprocess.Popen([*command, "--rate-hz", str(rate_hz)], stdin=subprocess.PIPE)
    try:
        while not path.is_symlink():
            time.sleep(0.01)
        with SpiBridgeDriver(str(path), FINGERS) as driver:
            listen(driver, 1.0)  # warm
            before = driver.counters.readings
            spent_us, ages_ms, cpu_s = listen(driver, seconds)
            counters = driver.counters
            described = {name: fact.text for name, fact in driver.describe().items()}
    finally:
        twin.communicate(b"stop\n")
    p50, p99 = np.percentile(spent_us, [50, 99])
    age50, age99 = np.percentile(ages_ms, [50, 99])
    dropped = counters.bad_cobs + counters.bad_crc + counters.too_long + counters.bad_frames
    sys.stdout.write(
        f"{counters.readings - before} sweeps in {seconds:.0f} s at {rate_hz:g} Hz: "
        f"{counters.missed_readings} missed, {dropped} damaged, {counters.link_losses} losses\n"
        f"read_ready per sweep: p50 {p50:.0f} us, p99 {p99:.0f} us, max {max(spent_us):.0f} us\n"
        f"age of a reading when it is handed over: p50 {age50:.2f} ms, p99 {age99:.2f} ms\n"
        f"CPU with waiting: {100.0 * cpu_s / seconds:.2f} % of a core\n"
        f"{described}\n"
    )


def replug(folder: Path, times: int) -> None:
    twin = SpiTwin(folder / "bridge", GeneratedContact(len(FINGERS)))
    with twin, SpiBridgeDriver(str(folder / "bridge"), FINGERS) as driver:
        times_s = replug_times_s(twin, driver, times, random.Random(0))
    sys.stdout.write(
        f"back after being plugged in again, {times} times: median {np.median(times_s):.3f} s, "
        f"max {max(times_s):.3f} s\n"
    )


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m tests.bench.spi", description=__doc__)
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--rate-hz", type=float, default=100.0)
    parser.add_argument("--replugs", type=int, default=0)
    parser.add_argument("--serve", type=Path, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.serve is not None:
        serve(options.serve, options.rate_hz)
        return
    with tempfile.TemporaryDirectory() as folder:
        measure(Path(folder), options.seconds, options.rate_hz)
        if options.replugs:
            replug(Path(folder), options.replugs)


if __name__ == "__main__":
    main()
