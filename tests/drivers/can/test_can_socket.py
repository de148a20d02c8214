"""Frames of CAN sockets, their age and losses, and of adapters on a serial line."""

from __future__ import annotations

import os
import pty
import socket
import threading
import time
import tty
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from unittest import mock

import can
import pytest
from can.interfaces.udp_multicast.utils import pack_message

from graspd.drivers.base import ElectrodeFault, TactileReading
from graspd.drivers.can.driver import CanBridgeDriver
from graspd.drivers.can.frames import ERROR, CanFrame
from graspd.drivers.link import LinkState
from graspd.drivers.twins.can import SAMPLE_ID, CanTwin
from tests.drivers.can.can_standin import (
    LOOPBACK,
    ScriptedBus,
    SocketBus,
    message,
    stand_in,
    sweep_messages,
    sweep_of_frames,
)
from tests.drivers.can.can_words import pack_frame
from tests.drivers.one_sweep import counts_of, sweeps_of, tactile
from tests.kit.clock import Clock
from tests.kit.waiting import wait_until

MS = 1_000_000


@pytest.fixture
def socket_bus(monkeypatch: pytest.MonkeyPatch) -> Iterator[SocketBus]:
    with SocketBus() as bus:
        stand_in(monkeypatch, lambda: bus)
        yield bus


def over_socket(**options: Any) -> CanBridgeDriver:  # noqa: ANN401
    options.setdefault("arbitration_id", SAMPLE_ID)
    return CanBridgeDriver("socketcan", LOOPBACK, sequence="electrodes", **options)


def test_a_socketcan_bus_is_read_from_its_socket(socket_bus: SocketBus) -> None:
    with over_socket() as driver:
        assert driver.fileno() == socket_bus.socket.fileno()
        assert socket_bus.socket.getsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF) >= 212_992
        assert driver.due_ns() is None
        socket_bus.send(*sweep_of_frames(0))
        (reading,) = tactile(driver.read_ready())
        assert (reading.counts == counts_of(0)).all()
        assert driver.read_ready() == []


@pytest.mark.parametrize(
    ("step_ns", "age_ns"), [(3_600_000 * MS, 3_600_000 * MS), (-5_000 * MS, 0)]
)
def test_a_wall_clock_step_makes_frames_old_but_never_future(
    step_ns: int, age_ns: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    with SocketBus(stamped=True) as bus:
        stand_in(monkeypatch, lambda: bus)
        with over_socket(wall_clock=lambda: time.time_ns() + step_ns) as driver:
            before_ns = time.monotonic_ns()
            bus.send(*sweep_of_frames(0))
            asked_ns = time.monotonic_ns()
            readings = tactile(driver.read_ready())
            read_ns = time.monotonic_ns()
    between_ns = read_ns - asked_ns + MS
    assert before_ns - between_ns <= readings[-1].t_ns + age_ns <= read_ns


def test_bus_off_drops_the_sweep_and_reopens_the_bus(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    clock = Clock()
    with SocketBus() as first, SocketBus() as second:
        buses = [first, second]
        stand_in(monkeypatch, lambda: buses.pop(0))
        with over_socket(clock=clock, wall_clock=clock) as driver:
            first.send(*sweep_of_frames(0), *sweep_of_frames(1)[:9])
            first.send(CanFrame(0x040, bytes(8), ERROR))
            assert len(driver.read_ready()) == 1
            assert driver.stream.link.state is LinkState.WAITING
            assert driver.stream.last_error == "bus-off"
            due_ns = driver.due_ns()
            assert due_ns is not None
            clock.now_ns = due_ns
            second.send(*sweep_of_frames(2)[9:], *sweep_of_frames(3))
            (reading,) = tactile(driver.read_ready())
            assert (reading.counts == counts_of(3)).all()
            counters = driver.counters
            assert (counters.bus_off, counters.link_losses, counters.error_frames) == (1, 1, 1)


def test_an_overflow_of_the_controller_ends_the_current_sweep(socket_bus: SocketBus) -> None:
    with over_socket() as driver:
        frames = sweep_of_frames(0)
        frames[3:5] = [CanFrame(0x004, bytes.fromhex("0001000000000000"), ERROR)]
        socket_bus.send(*frames, *sweep_of_frames(1))
        cut, whole = tactile(driver.read_ready())
        assert (cut.counts[:, :3] == counts_of(0)[:, :3]).all()
        assert (cut.faults[:, 3:] == ElectrodeFault.MISSING).all()
        assert (whole.counts == counts_of(1)).all()
        assert (driver.counters.controller_overflows, driver.counters.cut_sweeps) == (1, 1)
        assert driver.counters.unsynchronised_frames == 19


def test_records_that_are_not_frames_are_counted(socket_bus: SocketBus) -> None:
    with over_socket() as driver:
        for record in (b"\1", bytes(15), bytes(71), pack_frame(CanFrame(1, b"")) + b"\0"):
            socket_bus.far_end.send(record)
        socket_bus.send(*sweep_of_frames(0))
        assert len(driver.read_ready()) == 1
        assert driver.counters.malformed_frames == 4


def test_datagrams_of_other_types_than_python_cans_are_malformed(socket_bus: SocketBus) -> None:
    wrong = [("data", 10**9), ("data", 10**18), ("data", bytes(9)), ("arbitration_id", 256.5)]
    with CanBridgeDriver("udp_multicast", "239.74.163.2", sequence="electrodes") as driver:
        for field, value in (*wrong, ("arbitration_id", 0x800), ("is_fd", "no")):
            sent = message(bytes(7))
            setattr(sent, field, value)
            socket_bus.far_end.send(pack_message(sent))
        socket_bus.far_end.send(b"\x81\xa1x" + 4000 * b"\x91")  # nested 4000 deep
        for sent in sweep_messages(0):
            socket_bus.far_end.send(pack_message(sent))
        (reading,) = tactile(driver.read_ready())
        assert (reading.counts == counts_of(0)).all()
        assert (driver.counters.malformed_frames, driver.counters.foreign_frames) == (7, 0)


def test_frames_dropped_by_the_kernel_end_the_current_sweep(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Time does not show the loss: the clock stands still, and whole sweeps may be lost."""
    clock = Clock()
    bus = ScriptedBus()
    with (
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as near,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as far,
    ):
        near.bind(("127.0.0.1", 0))
        far.connect(near.getsockname())
        bus.socket = near  # type: ignore[attr-defined]
        stand_in(monkeypatch, lambda: bus)
        with over_socket(clock=clock, wall_clock=clock) as driver:
            near.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1)
            for sweep in range(20):
                for frame in sweep_of_frames(sweep):
                    far.send(pack_frame(frame))
            readings = tactile(driver.read_ready())
            for frame in [*sweep_of_frames(20), *sweep_of_frames(21)]:
                far.send(pack_frame(frame))
                readings += tactile(driver.read_ready())
        assert driver.counters.kernel_drops == 22 * 24 - driver.counters.frames > 0
        assert driver.counters.cut_sweeps <= 1
        for reading in readings:
            sound = reading.faults == 0
            assert any((reading.counts[sound] == counts_of(n)[sound]).all() for n in range(22))
        assert (readings[-1].counts == counts_of(21)).all()


def test_frames_wait_in_the_kernel_for_15_ms_at_most(
    socket_bus: SocketBus,
) -> None:
    clock = Clock()
    rests: dict[int, int | None] = {}
    with over_socket(clock=clock, wall_clock=clock) as driver:
        for sweep in range(8):  # a sample a millisecond: a sweep takes 24
            for at, frame in enumerate(sweep_of_frames(sweep)):
                clock.now_ns += MS
                socket_bus.send(frame)
                driver.read_ready()
                due_ns = driver.due_ns()
                assert due_ns is not None
                is_resting = driver.fileno() is None
                rests[at] = (due_ns - clock.now_ns) // MS if is_resting else None
    left = {at: 23 - at for at in range(23)} | {23: 24}
    assert rests == {at: min(ms - 1, 15) if ms > 1 else None for at, ms in left.items()}


def test_counts_pass_through_real_socketcan_unchanged() -> None:
    """Needs a kernel with CAN: `ip link add dev vcan0 type vcan; ip link set vcan0 up`."""
    try:
        socket.if_nametoindex("vcan0")
    except OSError:
        pytest.skip("there is no interface vcan0")
    counts = sweeps_of(200)
    driver = CanBridgeDriver("socketcan", "vcan0", arbitration_id=SAMPLE_ID)
    twin = CanTwin("socketcan", "vcan0", iter(counts))
    readings: list[TactileReading] = []
    with driver, twin:
        assert driver.fileno() is not None
        while twin.send_sweep():
            readings += tactile(driver.read_ready())
        assert driver.counters.kernel_drops == 0
    assert len(readings) == len(counts)
    for reading, expected in zip(readings, counts, strict=True):
        assert (reading.counts == expected).all()


def test_a_twin_warns_once_that_its_bus_refuses_frames(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    bus = mock.Mock()
    bus.send.side_effect, bus.recv.return_value = can.CanOperationError("full"), None
    stand_in(monkeypatch, lambda: bus)
    with CanTwin("virtual", "x", iter(sweeps_of(2))) as twin:
        assert twin.send_sweep()
        assert twin.send_sweep()
    assert caplog.messages == ["x refuses frames: full"]


def test_a_frame_behind_an_slcan_adapters_answer_is_read(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """python-can's `recv` returns None for such an answer, although frames wait behind it."""
    sleep, slept_s = time.sleep, [0.0]

    def noted(seconds: float) -> None:
        slept_s.append(seconds)
        sleep(seconds)

    monkeypatch.setattr(time, "sleep", noted)
    near, far = pty.openpty()
    tty.setraw(far)
    with CanBridgeDriver("slcan", os.ttyname(far), arbitration_id=SAMPLE_ID) as driver:
        driver.read_ready()
        frame = sweep_of_frames(0)[0]
        os.write(near, b"z\r\a" + f"t{SAMPLE_ID:03X}7{frame.data.hex()}\r".encode())
        driver.read_ready()
        assert driver.counters.frames == 1
    assert max(slept_s) < 1.5, "python-can's default sleeps two seconds"
    os.close(near)
    os.close(far)


ADAPTERS: dict[str, Callable[[CanFrame], bytes]] = {
    "slcan": lambda frame: b"t%03X7%s\r" % (SAMPLE_ID, frame.data.hex().encode()),
    "serial": lambda frame: (
        b"\xaa\0\0\0\0\7" + SAMPLE_ID.to_bytes(4, "little") + frame.data + b"\xbb"
    ),
    "seeedstudio": lambda frame: (
        b"\xaa\xc7" + SAMPLE_ID.to_bytes(2, "little") + frame.data + b"\x55"
    ),
}
"""By interface: a frame as its adapter sends it (python-can's and Seeed Studio's documents)."""


def plug(path: Path) -> tuple[int, int]:
    """Link `path` to a terminal; return its two ends, the adapter's first."""
    near, far = pty.openpty()
    tty.setraw(far)
    path.symlink_to(os.ttyname(far))
    return near, far


def from_adapter(interface: str, path: Path, clock: Clock) -> CanBridgeDriver:
    """Return a driver. Its clock must stand still, or a stall would drop frames without stamps."""
    options: dict[str, Any] = {"arbitration_id": SAMPLE_ID, "sequence": "electrodes"}
    return CanBridgeDriver(interface, str(path), clock=clock, **options)


@pytest.mark.parametrize("interface", ADAPTERS)
def test_an_unplugged_adapter_is_opened_again(interface: str, tmp_path: Path) -> None:
    path, clock = tmp_path / "adapter", Clock()
    ends = plug(path)
    with from_adapter(interface, path, clock) as driver:
        os.write(ends[0], ADAPTERS[interface](sweep_of_frames(0)[0]))
        wait_until(lambda: driver.read_ready() or driver.counters.frames)
        for end in ends:
            os.close(end)
        path.unlink()
        driver.read_ready()
        assert driver.stream.link.state is LinkState.WAITING
        ends = plug(path)
        clock.now_ns = driver.due_ns() or 0
        assert driver.read_ready() == []
        os.write(ends[0], b"".join(map(ADAPTERS[interface], sweep_of_frames(1))))
        wait_until(driver.read_ready)
        assert (driver.counters.faulty_readings, driver.counters.bus_faults) == (0, 1)
    for end in ends:
        os.close(end)


@pytest.mark.parametrize("interface", ADAPTERS)
def test_a_silent_adapter_is_read_without_waiting(interface: str, tmp_path: Path) -> None:
    path = tmp_path / "adapter"
    ends = plug(path)
    with from_adapter(interface, path, Clock()) as driver:
        waited_s = []
        for _ in range(5):
            before_s = time.monotonic()
            assert driver.read_ready() == []
            waited_s.append(time.monotonic() - before_s)
        assert min(waited_s) < 0.05, "python-can's default waits 0.1 s"
    for end in ends:
        os.close(end)


@pytest.mark.parametrize("interface", ADAPTERS)
def test_a_frame_in_two_pieces_is_read_whole(interface: str, tmp_path: Path) -> None:
    path = tmp_path / "adapter"
    near, far = plug(path)
    sent = ADAPTERS[interface](sweep_of_frames(0)[0])
    with from_adapter(interface, path, Clock()) as driver:
        for number, cut in enumerate(range(1, len(sent)), 1):
            rest = threading.Timer(0.002, os.write, (near, sent[cut:]))
            os.write(near, sent[:cut])
            rest.start()
            wait_until(lambda: driver.read_ready() or driver.counters.frames == number)  # noqa: B023
            rest.join()
        assert driver.counters.bus_faults == 0
    os.close(near)
    os.close(far)


@pytest.mark.parametrize(
    "text", [b"rcv 100 A2A251A8C894B9 E\n", bytes(32), b"$GPGGA,123519,4807.038,N\r\n"]
)
def test_bytes_without_a_can_frame_fail_after_a_kilobyte(text: bytes, tmp_path: Path) -> None:
    path, sent = tmp_path / "adapter", ADAPTERS["slcan"](sweep_of_frames(0)[0])
    near, far = plug(path)
    with from_adapter("slcan", path, Clock()) as driver:
        for frames in range(1, 60):
            os.write(near, 20 * b"z\r" + sent)
            wait_until(lambda: driver.read_ready() or driver.counters.frames == frames)  # noqa: B023
        wait_until(
            lambda: os.write(near, text) and (driver.read_ready() or driver.stream.last_error)
        )
        assert "no CAN frame" in str(driver.stream.last_error)
    os.close(near)
    os.close(far)
