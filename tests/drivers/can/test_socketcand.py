"""A bus behind socketcand: its text protocol, a server that goes away, hangs or is not there."""

from __future__ import annotations

import contextlib
import socket
import threading
import time
from collections.abc import Iterator

import pytest

from graspd.drivers.base import TactileReading
from graspd.drivers.can.driver import CanBridgeDriver
from graspd.drivers.can.interfaces import Options
from graspd.drivers.link import LinkState
from graspd.drivers.twins.can import SAMPLE_ID
from tests.drivers.can.can_standin import sweep_of_frames
from tests.drivers.one_sweep import counts_of, tactile
from tests.kit.clock import Clock
from tests.ports import free_port

LIMIT_S = 60.0
QUIET_NS = 2_000_000_000
ANSWERS = {"< open can0 >": "< ok >", "< rawmode >": "< ok >"}
"""What a client asks and hears (doc/protocol.md of socketcand)."""


class Server:
    """A stand-in for socketcand that accepts any number of clients, one after the other."""

    def __init__(self, *, greets: bool = True) -> None:
        self._greets = greets
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.options: Options = {"host": "127.0.0.1", "port": self._listener.getsockname()[1]}
        self.ready = threading.Event()
        self.client: socket.socket | None = None
        self._thread = threading.Thread(target=self._serve)
        self._thread.start()

    def _serve(self) -> None:
        while True:
            try:
                client, _ = self._listener.accept()
            except OSError:
                return
            client.settimeout(None)  # the driver's thread sets a default while it connects
            self.client = client
            with client:
                if self._greets:
                    client.sendall(b"< hi >")
                self._answer(client)

    def _answer(self, client: socket.socket) -> None:
        try:
            while asked := client.recv(256).decode():
                client.sendall(ANSWERS[asked].encode())
                if asked == "< rawmode >":
                    self.ready.set()
        except OSError:
            pass

    def send(self, text: str) -> None:
        assert self.ready.wait(LIMIT_S)
        assert self.client is not None
        self.client.sendall(text.encode())

    def drop(self) -> None:
        """Close the client's connection as a server that ends."""
        assert self.client is not None
        self.ready.clear()
        self.client.shutdown(socket.SHUT_RDWR)

    def close(self) -> None:
        self._listener.shutdown(socket.SHUT_RDWR)
        self._listener.close()
        while self._thread.is_alive():
            with contextlib.suppress(OSError):
                if self.client is not None:
                    self.client.shutdown(socket.SHUT_RDWR)  # a driver that failed left it open
            self._thread.join(0.1)


@pytest.fixture
def server() -> Iterator[Server]:
    made = Server()
    yield made
    made.close()


def driver_of(options: Options, clock: Clock) -> CanBridgeDriver:
    return CanBridgeDriver(
        "socketcand",
        "can0",
        arbitration_id=SAMPLE_ID,
        sequence="interleaved",
        options=options,
        clock=clock,
    )


def sweep_text(sweep: int, t_s: float = 23.424242, step_s: float = 0.0) -> str:
    """The frames of a sweep as the server sends them: id, its own time, data without spaces."""
    return "".join(
        f"< frame {SAMPLE_ID:03X} {t_s + number * step_s:.6f} {each.data.hex()} >"
        for number, each in enumerate(sweep_of_frames(sweep))
    )


def readings_of(driver: CanBridgeDriver, clock: Clock) -> list[TactileReading]:
    """Read until a reading comes; the clock moves only to the next try to connect."""
    end_s = time.monotonic() + LIMIT_S
    while time.monotonic() < end_s:
        if driver.stream.link.state is LinkState.WAITING:
            clock.now_ns = driver.due_ns() or clock.now_ns
        if found := tactile(driver.read_ready()):
            return found
    raise AssertionError("no reading came")


def test_the_samples_and_errors_of_a_server_are_read(server: Server) -> None:
    clock = Clock()
    with driver_of(server.options, clock) as driver:
        server.send("< error 004 23.4 >< frame 7FF 23.4  >" + sweep_text(0))
        (reading,) = readings_of(driver, clock)
        assert (reading.counts == counts_of(0)).all()
        assert not reading.faults.any()
        assert (driver.counters.error_frames, driver.counters.foreign_frames) == (1, 1)
        assert driver.stream.link.state is LinkState.UP


def test_a_board_may_pause_between_sweeps(server: Server) -> None:
    clock = Clock()
    with driver_of(server.options, clock) as driver:
        for sweep in range(9):
            server.send(sweep_text(sweep, 5.0 + sweep / 100, 0.0002))
            (reading,) = readings_of(driver, clock)
            assert (reading.counts == counts_of(sweep)).all()
            assert not reading.faults.any()
            clock.now_ns += 10_000_000
        assert driver.period_ns == pytest.approx(10_000_000, abs=50_000)
        assert driver.counters.untimed_frames == 0


def test_a_server_that_ends_is_connected_to_again(server: Server) -> None:
    """python-can reads nothing for ever from a connection that was closed."""
    clock = Clock()
    with driver_of(server.options, clock) as driver:
        server.send(sweep_text(0))
        readings_of(driver, clock)
        server.drop()
        clock.now_ns += QUIET_NS + 1
        driver.read_ready()
        assert driver.stream.link.state is LinkState.WAITING
        clock.now_ns = driver.due_ns() or 0
        driver.read_ready()
        assert driver.counters.bus_faults == 1
        server.send(sweep_text(1))
        (reading,) = readings_of(driver, clock)
        assert (reading.counts == counts_of(1)).all()


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
def test_a_server_that_is_absent_or_silent_is_waited_for() -> None:
    clock, silent = Clock(), Server(greets=False)
    absent: Options = {"host": "127.0.0.1", "port": free_port()}
    for options in (absent, silent.options):
        with driver_of(options, clock) as driver:
            assert driver.stream.link.state is LinkState.WAITING
            due_ns = driver.due_ns()
            assert due_ns is not None
            assert due_ns > clock.now_ns
    assert socket.getdefaulttimeout() is None, "python-can's socket is closed when it is freed"
    silent.close()
