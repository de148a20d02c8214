"""What the CAN bridge costs: `python -m tests.bench.can stream|standin|drain`. Not a test.

`stream`: the real format at 4400 frames/s from a twin in another process (udp_multicast) or thread
(virtual) into the driver, waited on as the service does. `standin`: the same over a Unix datagram
socket with the kernel's CAN structs, in place of a socketcan bus. `drain`: the cost per frame of
reading a socket in bulk and through python-can's own `recv`.
"""

from __future__ import annotations

import argparse
import itertools
import json
import multiprocessing
import resource
import selectors
import socket
import sys
import threading
import time
from collections.abc import Callable, Iterator
from multiprocessing.synchronize import Event as ProcessEvent
from typing import Any
from unittest import mock

import numpy as np
from can.interfaces.socketcan import SocketcanBus

from drivers.base import TactileReading
from drivers.biotac import SEQUENCES
from drivers.can.bus import FRAMES_PER_DRAIN, CanBus
from drivers.can.driver import CanBridgeDriver
from drivers.can.frames import CanFrame
from drivers.twins.can import CanTwin
from drivers.twins.grasps.grasps import Counts
from tests.drivers.can.can_standin import LOOPBACK, SocketBus, bus_options
from tests.drivers.can.can_words import pack_frame
from tests.drivers.twins.signals import GeneratedContact

Result = dict[str, object]
SAMPLE_ID = 0x100
GROUP, PORT = "239.74.163.2", 43117


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("what", choices=("stream", "standin", "drain"))
    parser.add_argument("--interface", default="virtual", choices=("virtual", "udp_multicast"))
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--frames-per-s", type=float, default=4400.0)
    parser.add_argument("--format", default="syntouch", choices=("syntouch", "sweep_fd"))
    given = parser.parse_args()
    if given.what == "drain":
        result = drain_cost()
    elif given.what == "standin":
        result = over_standin(given.frames_per_s, given.seconds)
    else:
        result = over_bus(given.interface, given.format, given.frames_per_s, given.seconds)
    sys.stdout.write(json.dumps(result, indent=2) + "\n")


def frames_per_sweep(frame_format: str) -> int:
    return len(SEQUENCES["interleaved"]) if frame_format == "syntouch" else 3


def options_of(interface: str) -> dict[str, Any]:
    return {"port": PORT} if interface == "udp_multicast" else {}


def limited(counts: Iterator[Counts], sweeps: int) -> Iterator[Counts]:
    """Drawing the counts costs more than sending them: a hundred, over and over."""
    drawn = list(itertools.islice(counts, 100))
    return itertools.islice(itertools.cycle(drawn), sweeps)


def serve(interface: str, frame_format: str, rate_hz: float, sweeps: int, go: ProcessEvent) -> None:
    counts = limited(GeneratedContact(rate_hz=rate_hz), sweeps)
    with (
        bus_options(**options_of(interface)),
        CanTwin(
            interface,
            GROUP,
            counts,
            format=frame_format,
            rate_hz=rate_hz,
        ) as twin,
    ):
        go.wait()
        twin.serve(threading.Event())


def over_bus(interface: str, frame_format: str, frames_per_s: float, seconds: float) -> Result:
    rate_hz = frames_per_s / frames_per_sweep(frame_format)
    sweeps = round(rate_hz * seconds)
    driver = CanBridgeDriver(
        interface,
        GROUP,
        format=frame_format,
        arbitration_id=SAMPLE_ID if frame_format == "syntouch" else None,
    )
    go = multiprocessing.Event()
    arguments = (interface, frame_format, rate_hz, sweeps, go)
    sender: Any
    if interface == "virtual":
        sender = threading.Thread(target=serve, args=arguments)
    else:
        sender = multiprocessing.Process(target=serve, args=arguments)
    with bus_options(**options_of(interface)), driver:
        sender.start()
        try:
            result = consume(driver, sweeps, seconds + 2.0, go.set)
        finally:
            sender.join()
    return result


def over_standin(frames_per_s: float, seconds: float) -> Result:
    sweeps = round(frames_per_s / frames_per_sweep("syntouch") * seconds)
    go = multiprocessing.Event()
    with SocketBus() as bus:
        sender = multiprocessing.Process(target=feed, args=(bus, frames_per_s, sweeps, go))
        with mock.patch("drivers.can.bus.can.Bus", return_value=bus):
            driver = CanBridgeDriver("socketcan", LOOPBACK, arbitration_id=SAMPLE_ID)
            with driver:
                sender.start()
                try:
                    return consume(driver, sweeps, seconds + 2.0, go.set)
                finally:
                    sender.join()


def feed(bus: SocketBus, frames_per_s: float, sweeps: int, go: ProcessEvent) -> None:
    """A sender that costs little: the frames are packed beforehand."""
    twin = CanTwin("virtual", "unused", limited(GeneratedContact(), 100))
    drawn = [twin.next_frames() for _ in range(100)]
    records = [[pack_frame(CanFrame(*frame)) for frame in frames] for frames in drawn]
    bus.far_end.setblocking(True)
    go.wait()
    due = time.monotonic()
    for sweep in range(sweeps):
        for record in records[sweep % len(records)]:
            time.sleep(max(due - time.monotonic(), 0.0))
            bus.far_end.send(record)
            due += 1.0 / frames_per_s


def consume(driver: CanBridgeDriver, sweeps: int, limit_s: float, go: Callable[[], None]) -> Result:
    """Wait and read as the service does; measure this thread only."""
    readings: list[TactileReading] = []
    per_sweep_us: list[float] = []
    ages_us: list[float] = []
    own_us: list[float] = []
    spent_ns, own_ns, wakes = 0, 0, 0
    go()
    cpu_s, switches = time.thread_time(), resource.getrusage(resource.RUSAGE_THREAD)
    start = time.monotonic()
    with selectors.SelectSelector() as selector:
        while len(readings) < sweeps and time.monotonic() - start < limit_s:
            wait(selector, driver)
            wakes += 1
            before_ns, own_before_ns = time.perf_counter_ns(), time.thread_time_ns()
            new = driver.read_ready()
            own_ns += time.thread_time_ns() - own_before_ns
            spent_ns += time.perf_counter_ns() - before_ns
            for reading in new:
                if isinstance(reading, TactileReading):
                    readings.append(reading)
                    ages_us.append((time.monotonic_ns() - reading.t_ns) / 1e3)
                    per_sweep_us.append(spent_ns / 1e3)
                    own_us.append(own_ns / 1e3)
                    spent_ns = own_ns = 0
    elapsed_s = time.monotonic() - start
    cpu_s = time.thread_time() - cpu_s
    after = resource.getrusage(resource.RUSAGE_THREAD)
    return {
        "sweeps sent": sweeps,
        "readings": len(readings),
        "readings with a fault": sum(bool(reading.faults.any()) for reading in readings),
        "seconds": round(elapsed_s, 2),
        "cpu share of the loop, %": round(100 * cpu_s / elapsed_s, 2),
        "wakes per second": round(wakes / elapsed_s),
        "involuntary switches": after.ru_nivcsw - switches.ru_nivcsw,
        "read_ready per sweep, us of this thread": percentiles(own_us),
        "read_ready per sweep, us with preemption": percentiles(per_sweep_us),
        "age at hand-over, us": percentiles(ages_us),
        "link": str(driver.link_state),
        "counters": {name: count for name, count in driver.counters.as_dict().items() if count},
    }


def wait(selector: selectors.SelectSelector, driver: CanBridgeDriver) -> None:
    descriptor, due_ns = driver.fileno(), driver.due_ns()
    for key in list(selector.get_map().values()):
        if key.fd != descriptor:
            selector.unregister(key.fd)
    if descriptor is not None and descriptor not in selector.get_map():
        selector.register(descriptor, selectors.EVENT_READ)
    timeout_s = 0.1 if due_ns is None else max(due_ns - time.monotonic_ns(), 0) / 1e9
    selector.select(timeout_s)


def percentiles(values: list[float]) -> dict[str, float]:
    if not values:
        return {}
    p50, p99 = np.percentile(values, (50, 99))
    return {"p50": round(p50, 1), "p99": round(p99, 1), "max": round(max(values), 1)}


def drain_cost(rounds: int = 200, frames: int = 100) -> Result:
    """CPU time per frame, us, over a Unix datagram socket pair in place of PF_CAN."""
    record = pack_frame(CanFrame(SAMPLE_ID, bytes.fromhex("A2A251A8C894B9")))
    result: Result = {"pf_can": hasattr(socket, "AF_CAN") and has_pf_can()}
    with SocketBus() as standin:
        python_can = object.__new__(SocketcanBus)
        python_can.socket, python_can.channel = standin.socket, LOOPBACK
        python_can._is_filtered, python_can._filters = False, None
        bulk = CanBus("socketcan", LOOPBACK, {}, time.monotonic_ns, time.time_ns)
        with mock.patch("drivers.can.bus.open_bus", return_value=standin):
            bulk.open()

        def plainly() -> None:
            while python_can.recv(timeout=0) is not None:
                pass

        def in_bulk() -> None:
            while len(bulk.drain()) == FRAMES_PER_DRAIN:
                pass

        for name, read in (("python-can recv", plainly), ("bulk", in_bulk)):
            costs = []
            for _ in range(rounds):
                for _ in range(frames):
                    standin.far_end.send(record)
                before = time.thread_time_ns()
                read()
                costs.append((time.thread_time_ns() - before) / frames / 1e3)
            result[f"{name}, us per frame"] = percentiles(costs)
        bulk.close()
    return result


def has_pf_can() -> bool:
    try:
        socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW).close()
    except OSError:
        return False
    return True


if __name__ == "__main__":
    main()
