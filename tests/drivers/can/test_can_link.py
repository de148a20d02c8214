"""The CAN driver's link: buses that fail, fall silent or come back, stamps, a socketcand server."""

from __future__ import annotations

import errno
import logging
import queue
import socket
import threading
import time

import can
import numpy as np
import pytest

from graspd.drivers.base import DriverError, TactileReading
from graspd.drivers.can.bus import CanBus
from graspd.drivers.can.driver import CanBridgeDriver
from graspd.drivers.link import LinkState
from graspd.drivers.twins.can import SAMPLE_ID
from tests.drivers.can.can_standin import (
    ScriptedBus,
    message,
    stand_in,
    sweep_messages,
    sweep_of_frames,
)
from tests.drivers.one_sweep import counts_of, tactile
from tests.kit.clock import Clock
from tests.ports import free_port

FRAMES_PER_DRAIN = 512
POLL_NS = 1_000_000

MS = 1_000_000


def test_an_absent_socketcan_interface_is_waited_for(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.DEBUG)
    clock = Clock()
    with CanBridgeDriver("socketcan", "no-such-can-bus", clock=clock) as driver:
        for _ in range(20):
            assert driver.stream.link.state is LinkState.WAITING
            due_ns = driver.due_ns()
            assert due_ns is not None
            assert 0 < due_ns - clock.now_ns <= 1000 * MS
            clock.now_ns = due_ns
            assert driver.read_ready() == ()
        assert driver.counters.bus_faults == 21
        assert driver.stream.last_error is not None
        assert "no-such-can-bus" in driver.stream.last_error
    noisy = [record for record in caplog.records if record.levelno >= logging.WARNING]
    assert len(noisy) == 1, "one warning per outage, and none of python-can's"


FAILURES = [
    can.CanOperationError("adapter says no"),
    OSError(errno.ENETDOWN, "Network is down"),
    AssertionError("only requested a single extra field"),
]


@pytest.mark.parametrize(
    ("failure", "shutdown_fails"), [(FAILURES[0], True), *((each, False) for each in FAILURES)]
)
def test_the_link_recovers_from_any_error_of_python_can(
    monkeypatch: pytest.MonkeyPatch, failure: Exception, shutdown_fails: bool
) -> None:
    first = ScriptedBus([*sweep_messages(0), *sweep_messages(1)[:10], failure])
    second = ScriptedBus([*sweep_messages(2)[10:], *sweep_messages(3)])
    first.shutdown_error = can.CanOperationError("cannot close") if shutdown_fails else None
    buses = [first, failure, second]

    def open_bus() -> object:
        bus = buses.pop(0)
        if isinstance(bus, Exception):
            raise bus
        return bus

    stand_in(monkeypatch, open_bus)
    clock = Clock()
    driver = CanBridgeDriver("robotell", "x", arbitration_id=SAMPLE_ID, clock=clock)
    with driver:
        (reading,) = tactile(driver.read_ready())
        assert (reading.counts == counts_of(0)).all()
        assert not reading.interrupted
        assert driver.describe()["link"].text == "waiting"
        assert str(failure) in driver.describe()["why"].text
        assert driver.fileno() is None
        assert str(failure) in driver.describe()["last error"].text
        assert first.shut_down == 1
        assert driver.read_ready() == ()
        for _ in range(2):
            clock.now_ns = driver.due_ns() or 0
            readings = tactile(driver.read_ready())
        (reading,) = readings
        assert (reading.counts == counts_of(3)).all()
        assert reading.interrupted
        assert not reading.faults.any()
        known = driver.describe()
        assert (known["link"].text, "why" in known) == ("up", False)
        counters = driver.counters
        assert (counters.bus_faults, counters.link_losses, counters.interrupted_sweeps) == (2, 1, 1)
    assert second.shut_down == 1


def test_one_read_takes_512_frames_at_most(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = Clock()
    bus = ScriptedBus([message(b"\0", 0x7FF)] * (2 * FRAMES_PER_DRAIN + 5))
    stand_in(monkeypatch, lambda: bus)
    with CanBridgeDriver("robotell", "x", clock=clock) as driver:
        for expected in (FRAMES_PER_DRAIN, 2 * FRAMES_PER_DRAIN):
            driver.read_ready()
            assert driver.counters.frames == expected
            assert driver.due_ns() == clock.now_ns
        driver.read_ready()
        assert driver.counters.frames == 2 * FRAMES_PER_DRAIN + 5
        assert driver.due_ns() == clock.now_ns + POLL_NS


def test_python_can_gets_bit_rate_and_bounded_queue(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    seen: dict[str, object] = {}
    monkeypatch.setattr("graspd.drivers.can.bus.can.Bus", lambda **options: seen.update(options))
    CanBridgeDriver("virtual", "x").open()
    CanBridgeDriver("robotell", "x", bitrate=500_000).open()
    assert seen["rx_queue_size"] == 16384
    assert seen["bitrate"] == 500_000
    assert seen["ignore_config"] is True


def test_a_value_error_ends_slcan_but_robotell_is_retried(monkeypatch: pytest.MonkeyPatch) -> None:
    """slcan raises `ValueError` only for a wrong argument, robotell also for an absent device."""
    stand_in(monkeypatch, lambda: int("no number"))
    with pytest.raises(DriverError, match="cannot open slcan x: invalid literal"):
        CanBridgeDriver("slcan", "x").open()
    with CanBridgeDriver("robotell", "x") as driver:
        assert driver.stream.link.state is LinkState.WAITING


def test_a_silent_board_is_down_and_comes_back(monkeypatch: pytest.MonkeyPatch) -> None:
    """No error shows it: the bus works, and other devices send on it."""
    bus, clock = ScriptedBus(), Clock()
    stand_in(monkeypatch, lambda: bus)
    foreign = message(bytes(7), 0x7FF)
    with CanBridgeDriver("robotell", "x", arbitration_id=SAMPLE_ID, clock=clock) as driver:

        def heard(*sent: can.Message) -> int:
            assert driver.read_ready() == []
            bus.script += sent
            return len(driver.read_ready())

        assert heard(*sweep_messages(0)) == 1
        for _ in range(10):
            clock.now_ns += 10 * MS - 1
            assert heard(foreign) == 0
            assert driver.stream.link.state is LinkState.UP
        clock.now_ns += 10
        assert heard(foreign) == 0
        assert str(driver.stream.link.state) == "greeting"
        assert driver.describe()["why"].text.endswith(": nothing from the board for 100 ms")
        assert "last error" not in driver.describe()
        assert heard(*sweep_messages(1)) == 1
        assert str(driver.stream.link.state) == "up"
        assert (driver.counters.link_losses, driver.counters.bus_faults) == (1, 0)


@pytest.mark.parametrize(
    ("interface", "steps", "expected"),
    [
        # A stamp after now comes from a wall clock that was set back since, and counts as now.
        ("virtual", [(1000, 100_500, (100.0,))], [(500, 500)]),
        ("virtual", [(1000, 100_500, (100.5, 101.0))], [(1000, 1000)] * 2),
        # The wall clock is read 20 ms late the second time.
        (
            "virtual",
            [(1010, 94_010, (94.001,)), (1020, 94_040, (94.004,)), (1030, 94_030, (94.007,))],
            [(1001, 1001), (1001, 1001), (1007, 1007)],
        ),
        # Without a stamp a frame came since the bus was last empty.
        (
            "robotell",
            [(1020, 0, (0.0,)), (1030, 0, ()), (1050, 0, (0.0, 0.0))],
            [(1000, 1020), (1030, 1050), (1030, 1050)],
        ),
        # Rising stamps of a server date frames by the quickest delay.
        (
            "socketcand",
            [(1010, 0, (100.0,)), (1050, 0, (100.01,)), (1060, 0, (99.0,))],
            [(1010, 1010), (1020, 1020), (1050, 1060)],
        ),
    ],
)
def test_frames_are_dated_as_their_kind_of_interface_stamps_them(
    interface: str,
    steps: list[tuple[int, int, tuple[float, ...]]],
    expected: list[tuple[int, int]],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """`steps`: time and wall time of a reading, ms, and the stamps that it finds, s. `expected`:
    the earliest and latest time at which each frame may have arrived, ms."""
    scripted, clock, wall_clock = ScriptedBus(), Clock(1_000 * MS), Clock(94_000 * MS)
    monkeypatch.setattr("graspd.drivers.can.bus.open_bus", lambda *_, **__: scripted)
    server: dict[str, str | int] = {"host": "127.0.0.1", "port": 1}
    options = server if interface == "socketcand" else {}
    bus = CanBus(interface, "x", None, clock, wall_clock, options)
    bus.open()
    found = []
    for now_ms, wall_ms, stamps_s in steps:
        clock.now_ns, wall_clock.now_ns = now_ms * MS, wall_ms * MS
        for stamp_s in stamps_s:
            received = message(b"\0", 0x7FF)
            received.timestamp = stamp_s
            scripted.script.append(received)
        found += [(since_ns / MS, until_ns / MS) for _, since_ns, until_ns in bus.drain()]
    assert np.array(found) == pytest.approx(np.array(expected), abs=0.1)
    bus.close()
    assert bus.drain() == []


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
    """Read until a reading comes, and return it; the driver's clock stands still."""
    end_s = time.monotonic() + LIMIT_S
    while not (found := tactile(driver.read_ready())):
        assert time.monotonic() < end_s, "no reading came"
    (reading,) = found
    return reading


def test_a_socketcand_server_silent_for_2_s_is_reconnected() -> None:
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
def test_a_socketcand_server_absent_or_silent_is_waited_for() -> None:
    clock = Clock()
    with socket.create_server(("127.0.0.1", 0)) as silent:
        for port in (free_port(), silent.getsockname()[1]):
            with driver_of(port, clock) as driver:
                assert driver.stream.link.state is LinkState.WAITING
                due_ns = driver.due_ns()
                assert due_ns is not None
                assert due_ns > clock.now_ns
    assert socket.getdefaulttimeout() is None, "python-can's socket is closed when it is freed"
