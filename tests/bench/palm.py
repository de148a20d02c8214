"""What the palm stream costs: `python -m tests.bench.palm --seconds 60`. Not a test.

A twin in another process sends packets at 1 kHz over the loopback interface; the driver is waited
on as the service does. `own_us_per_sweep` is the time inside the driver's methods for one sweep of
14 packets, `cpu_percent` all of this process, the waiting included; `handed_over_after_us` is from
the last packet's arrival in the kernel to the reading's return.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import select
import sys
import threading
import time
from pathlib import Path

import numpy as np

from drivers.base import TactileReading
from drivers.palm.driver import PalmDriver
from drivers.twins.palm import PalmTwin
from tests.drivers.twins.signals import GeneratedContact

EXAMPLE = Path(__file__).parents[2] / "deploy" / "calibration" / "example_hand.toml"
PACKETS_PER_S = 1000
ROUND = 14
WAIT_MAX_S = 0.05


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--no-joints", action="store_true")
    given = parser.parse_args()
    result = measure(given.seconds, joints=not given.no_joints)
    sys.stdout.write(json.dumps(result, indent=2) + "\n")


def send(target: str, rounds: int) -> None:
    """The twin's process."""
    counts = (row for row, _ in zip(GeneratedContact(rate_hz=1000 / 14), range(rounds)))  # noqa: B905
    PalmTwin(counts).serve(target, threading.Event())


def measure(seconds: float, *, joints: bool) -> dict[str, object]:
    rounds = round(seconds * PACKETS_PER_S / ROUND)
    calibration = EXAMPLE if joints else None
    with PalmDriver("udp://127.0.0.1:0", calibration=calibration) as driver:
        context = multiprocessing.get_context("spawn")
        target = f"udp://127.0.0.1:{driver.port}"
        sender = context.Process(target=send, args=(target, rounds))
        sender.start()
        while driver.counters.packets == 0:
            driver.read_ready()
        result = listen(driver, sender)
        sender.join()
    return {"rounds_sent": rounds, "joints": joints, **result}


def listen(driver: PalmDriver, sender: multiprocessing.process.BaseProcess) -> dict[str, object]:
    """Until the sender has ended and nothing more comes."""
    began_s, cpu_began_s = time.perf_counter(), time.process_time()
    own_ns, wakes, delays_us, times_ns = 0, 0, [], []
    while True:
        start_ns = time.perf_counter_ns()
        descriptor, due_ns = driver.fileno(), driver.due_ns()
        own_ns += time.perf_counter_ns() - start_ns
        wait_s = WAIT_MAX_S
        if due_ns is not None:
            wait_s = min(wait_s, max(0.0, (due_ns - time.monotonic_ns()) / 1e9))
        watched = [] if descriptor is None else [descriptor]
        select.select(watched, [], [], wait_s)
        wakes += 1
        start_ns = time.perf_counter_ns()
        readings = driver.read_ready()
        own_ns += time.perf_counter_ns() - start_ns
        for reading in readings:
            if isinstance(reading, TactileReading):
                delays_us.append((time.monotonic_ns() - reading.t_ns) / 1e3)
                times_ns.append(reading.t_ns)
        if not readings and not sender.is_alive():
            break
    took_s, cpu_s = time.perf_counter() - began_s, time.process_time() - cpu_began_s
    counters = {name: value for name, value in driver.counters.as_dict().items() if value}
    return {
        "seconds": round(took_s, 1),
        "sweeps_per_s": round((len(times_ns) - 1) / ((times_ns[-1] - times_ns[0]) / 1e9), 2),
        "cpu_percent": round(100 * cpu_s / took_s, 2),
        "wakes_per_s": round(wakes / took_s, 1),
        "own_us_per_sweep": round(own_ns / len(times_ns) / 1e3, 1),
        "handed_over_after_us": {
            f"p{q}": round(float(np.percentile(delays_us, q)), 1) for q in (50, 99, 100)
        },
        "counters": counters,
    }


if __name__ == "__main__":
    main()
