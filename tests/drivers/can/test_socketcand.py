"""A bus behind socketcand: its text protocol, a server that goes away, hangs or is not there."""

from __future__ import annotations

import queue
import socket
import threading
import time

import pytest

from graspd.drivers.base import TactileReading
from graspd.drivers.can.driver import CanBridgeDriver
from graspd.drivers.link import LinkState
from graspd.drivers.twins.can import SAMPLE_ID
from tests.drivers.can.can_standin import sweep_of_frames
from tests.drivers.one_sweep import counts_of, tactile
from tests.kit.clock import Clock
from tests.ports import free_port

LIMIT_S = 60.0
QUIET_NS = 2_000_000_000


def driver_of(port: int, clock: Clock) -> CanBridgeDriver:
    return CanBridgeDriver(
        "socketcand",
        "can0",
        arbitration_id=SAMPLE_ID,
        sequence="electrodes",
        options={"host": "127.0.0.1", "port": port},
        clock=clock,
    )


def sweep_text(sweep: int) -> str:
    """The frames of a sweep as the server sends them: id, its own time, data without spaces."""
    frames = sweep_of_frames(sweep)
    return "".join(f"< frame {SAMPLE_ID:03X} 23.424242 {each.data.hex()} >" for each in frames)


def serve(listener: socket.socket, texts: queue.Queue[str], clients: int) -> None:
    """Greet clients, send each a text, and end (doc/protocol.md of socketcand)."""
    for _ in range(clients):
        listener.accept()[0].close()  # the driver looks first if a server is there
        client, _ = listener.accept()
        client.settimeout(LIMIT_S)  # the driver's thread sets a default while it connects
        with client:
            client.sendall(b"< hi >")
            for asked in (b"< open can0 >", b"< rawmode >"):
                assert client.recv(256) == asked
                client.sendall(b"< ok >")
            client.sendall(texts.get(timeout=LIMIT_S).encode())


def next_reading(driver: CanBridgeDriver) -> TactileReading:
    """Read until a reading comes; the clock stands."""
    end_s = time.monotonic() + LIMIT_S
    while not (found := tactile(driver.read_ready())):
        assert time.monotonic() < end_s, "no reading came"
    (reading,) = found
    return reading


def test_a_server_is_read_and_connected_to_again() -> None:
    """python-can reads nothing for ever from a connection that was closed."""
    clock = Clock()
    with socket.create_server(("127.0.0.1", 0)) as listener:
        listener.settimeout(LIMIT_S)
        texts = queue.Queue[str]()
        thread = threading.Thread(target=serve, args=(listener, texts, 2))
        thread.start()
        with driver_of(listener.getsockname()[1], clock) as driver:
            texts.put("< error 004 23.4 >< frame 7FF 23.4  >" + sweep_text(0))
            reading = next_reading(driver)
            assert (reading.counts == counts_of(0)).all()
            assert not reading.faults.any()
            assert (driver.counters.error_frames, driver.counters.foreign_frames) == (1, 1)
            assert str(driver.stream.link.state) == "up"
            clock.now_ns += QUIET_NS
            driver.read_ready()
            assert driver.counters.bus_faults == 0
            clock.now_ns += 1
            driver.read_ready()
            assert driver.stream.link.state is LinkState.WAITING
            clock.now_ns = driver.due_ns() or 0
            driver.read_ready()
            texts.put(sweep_text(1))
            assert (next_reading(driver).counts == counts_of(1)).all()
            assert driver.counters.bus_faults == 1
        thread.join()


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
def test_a_server_that_is_absent_or_silent_is_waited_for() -> None:
    clock = Clock()
    with socket.create_server(("127.0.0.1", 0)) as silent:
        for port in (free_port(), silent.getsockname()[1]):
            with driver_of(port, clock) as driver:
                assert driver.stream.link.state is LinkState.WAITING
                due_ns = driver.due_ns()
                assert due_ns is not None
                assert due_ns > clock.now_ns
    assert socket.getdefaulttimeout() is None, "python-can's socket is closed when it is freed"
