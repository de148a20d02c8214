"""Buses that fail, come back, have a socket, a terminal or nothing: the CAN bridge keeps up."""

from __future__ import annotations

import errno
import logging
import os
import pty
import socket
import struct
import time
import tty
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import can
import pytest

from drivers.base import Reading, TactileReading
from drivers.can_bridge import POLL_NS, REST_MAX_NS, CanBridgeDriver
from drivers.can_bus import FRAMES_PER_DRAIN, SO_RXQ_OVFL, CanBus
from drivers.can_formats import CanFormat, encode_sample
from drivers.can_frames import CanFrame, FrameFlag, pack_frame
from drivers.link import BACKOFF_MAX_S, LinkState
from drivers.twins.can import SAMPLE_ID, CanTwin
from tests.drivers.can_standin import (
    LOOPBACK,
    ScriptedBus,
    SocketBus,
    bridge,
    channel,
    contact,
    message,
    stand_in,
    sweep_messages,
    tactile,
)
from tests.drivers.can_words import SLOT_NS, Clock, samples, truth

MS = 1_000_000


def test_an_absent_socketcan_interface_is_waited_for(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.DEBUG)
    clock = Clock()
    with CanBridgeDriver("socketcan", "nocan77", clock=clock) as driver:
        for _ in range(20):
            assert driver.link_state is LinkState.WAITING
            due_ns = driver.due_ns()
            assert due_ns is not None
            assert 0 < due_ns - clock.now_ns <= BACKOFF_MAX_S * 1e9
            clock.now_ns = due_ns
            assert driver.read_ready() == ()
        assert driver.counters.bus_faults == 21
        assert driver.last_error is not None
        assert "nocan77" in driver.last_error
    noisy = [record for record in caplog.records if record.levelno >= logging.WARNING]
    assert len(noisy) == 1, "one warning per outage, and none of python-can's"


FAILURES = [
    can.CanOperationError("adapter says no"),
    can.CanTimeoutError("too late"),
    can.CanInitializationError("gone"),
    OSError(errno.ENETDOWN, "Network is down"),
    OSError(errno.ENODEV, "No such device"),
    struct.error("unpack requires a buffer of 4 bytes"),
    ValueError("invalid literal for int() with base 16"),
    TypeError("ord() expected a character"),
    IndexError("string index out of range"),
    AssertionError("only requested a single extra field"),
    RuntimeError("whatever"),
]


@pytest.mark.parametrize("failure", FAILURES, ids=lambda failure: type(failure).__name__)
@pytest.mark.parametrize("shutdown_fails", [False, True])
def test_whatever_python_can_raises_is_a_link_fault_that_is_recovered_from(
    monkeypatch: pytest.MonkeyPatch, failure: Exception, shutdown_fails: bool
) -> None:
    first = ScriptedBus([*sweep_messages(0), *sweep_messages(1)[:10], failure])
    second = ScriptedBus([*sweep_messages(2)[10:], *sweep_messages(3)])
    first.shutdown_error = can.CanOperationError("cannot close") if shutdown_fails else None
    buses: list[object] = [first, second]
    stand_in(monkeypatch, lambda: buses.pop(0))
    clock = Clock()
    driver = CanBridgeDriver("pcan", "x", arbitration_id=SAMPLE_ID, clock=clock)
    with driver:
        (reading,) = tactile(driver.read_ready())
        assert (reading.counts == truth(0)).all()
        assert driver.describe()["link"] == "waiting"
        assert driver.fileno() is None
        assert str(failure) in driver.describe()["last error"]
        assert first.shut_down == 1
        assert driver.read_ready() == ()
        due_ns = driver.due_ns()
        assert due_ns is not None
        clock.now_ns = due_ns
        (reading,) = tactile(driver.read_ready())
        assert (reading.counts == truth(3)).all()
        assert not reading.faults.any()
        assert driver.describe()["link"] == "up"
        counters = driver.counters
        assert (counters.bus_faults, counters.link_losses, counters.interrupted_sweeps) == (1, 1, 1)
    assert second.shut_down == 1


@pytest.mark.parametrize("failure", FAILURES, ids=lambda failure: type(failure).__name__)
def test_whatever_opening_raises_is_tried_again(
    monkeypatch: pytest.MonkeyPatch, failure: Exception
) -> None:
    outcomes: list[Exception | ScriptedBus] = [failure, failure, ScriptedBus(sweep_messages())]

    def open_bus() -> object:
        outcome = outcomes.pop(0)
        if isinstance(outcome, Exception):
            raise outcome
        return outcome

    stand_in(monkeypatch, open_bus)
    clock = Clock()
    with CanBridgeDriver("pcan", "x", arbitration_id=SAMPLE_ID, clock=clock) as driver:
        readings: list[Reading] = []
        while not readings:
            due_ns = driver.due_ns()
            assert due_ns is not None
            clock.now_ns = max(clock.now_ns, due_ns)
            readings += driver.read_ready()
        assert driver.counters.bus_faults == 2
        assert driver.counters.link_losses == 0


def test_a_keyboard_interrupt_is_no_link_fault(monkeypatch: pytest.MonkeyPatch) -> None:
    stand_in(monkeypatch, lambda: ScriptedBus([KeyboardInterrupt()]))
    with CanBridgeDriver("pcan", "x") as driver, pytest.raises(KeyboardInterrupt):
        driver.read_ready()


@pytest.fixture
def socket_bus(monkeypatch: pytest.MonkeyPatch) -> Iterator[SocketBus]:
    with SocketBus() as bus:
        stand_in(monkeypatch, lambda: bus)
        yield bus


def over_socket(**options: Any) -> CanBridgeDriver:  # noqa: ANN401
    options.setdefault("arbitration_id", SAMPLE_ID)
    return CanBridgeDriver("socketcan", LOOPBACK, sequence="electrodes", **options)


def sweep_of_frames(sweep: int) -> list[CanFrame]:
    return [
        CanFrame(SAMPLE_ID, encode_sample(channel, words)) for channel, words, _ in samples(sweep)
    ]


def test_a_socketcan_bus_is_read_from_its_socket(socket_bus: SocketBus) -> None:
    with over_socket() as driver:
        assert driver.fileno() == socket_bus.socket.fileno()
        assert socket_bus.socket.getsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF) >= 212_992
        assert driver.due_ns() is None
        for frame in sweep_of_frames(0):
            socket_bus.send(frame)
        (reading,) = tactile(driver.read_ready())
        assert (reading.counts == truth(0)).all()
        assert driver.read_ready() == []


def test_a_frame_is_as_old_as_its_stay_in_the_kernel(socket_bus: SocketBus) -> None:
    with over_socket() as driver:
        for frame in sweep_of_frames(0):
            socket_bus.send(frame)
        time.sleep(0.05)
        (reading,) = tactile(driver.read_ready())
        assert 50 * MS <= time.monotonic_ns() - reading.t_ns < 5_000 * MS


@pytest.mark.parametrize(
    ("step_ns", "age_ns"), [(3_600_000 * MS, 3_600_000 * MS), (-5_000 * MS, 0)]
)
def test_a_step_of_the_wall_clock_makes_frames_old_and_never_of_the_future(
    socket_bus: SocketBus, step_ns: int, age_ns: int
) -> None:
    with over_socket(wall_clock=lambda: time.time_ns() + step_ns) as driver:
        for frame in sweep_of_frames(0):
            socket_bus.send(frame)
        (reading,) = tactile(driver.read_ready())
        assert 0 <= time.monotonic_ns() - reading.t_ns - age_ns < 5_000 * MS


def test_bus_off_loses_the_link_and_drops_the_sweep_at_hand(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    clock = Clock()
    with SocketBus() as first, SocketBus() as second:
        buses = [first, second]
        stand_in(monkeypatch, lambda: buses.pop(0))
        with over_socket(clock=clock) as driver:
            for frame in sweep_of_frames(0) + sweep_of_frames(1)[:9]:
                first.send(frame)
            first.send(CanFrame(0x040, bytes(8), FrameFlag.ERROR))
            assert len(driver.read_ready()) == 1
            assert driver.link_state is LinkState.WAITING
            assert driver.last_error == "bus-off"
            due_ns = driver.due_ns()
            assert due_ns is not None
            clock.now_ns = due_ns
            for frame in sweep_of_frames(2)[9:] + sweep_of_frames(3):
                second.send(frame)
            (reading,) = tactile(driver.read_ready())
            assert (reading.counts == truth(3)).all()
            counters = driver.counters
            assert (counters.bus_off, counters.link_losses, counters.error_frames) == (1, 1, 1)


def test_error_frames_short_of_bus_off_are_counted_only(socket_bus: SocketBus) -> None:
    with over_socket() as driver:
        frames = sweep_of_frames(0)
        frames.insert(3, CanFrame(0x004, bytes.fromhex("0001000000000000"), FrameFlag.ERROR))
        frames.insert(9, CanFrame(0x080, bytes(8), FrameFlag.ERROR))
        for frame in frames:
            socket_bus.send(frame)
        (reading,) = tactile(driver.read_ready())
        assert not reading.faults.any()
        assert (driver.counters.error_frames, driver.counters.controller_overflows) == (2, 1)
        assert driver.link_state is LinkState.UP


def test_records_that_are_no_frames_are_counted(socket_bus: SocketBus) -> None:
    with over_socket() as driver:
        for record in (b"\1", bytes(15), bytes(71), pack_frame(CanFrame(1, b"")) + b"\0"):
            socket_bus.far_end.send(record)
        for frame in sweep_of_frames(0):
            socket_bus.send(frame)
        assert len(driver.read_ready()) == 1
        assert driver.counters.malformed_frames == 4


class DownSocket(socket.socket):
    """A socket of an interface that was taken down."""

    def recvmsg(self, *_: object) -> Any:  # noqa: ANN401
        raise OSError(errno.ENETDOWN, "Network is down")


def test_an_interface_that_goes_down_is_a_link_fault(monkeypatch: pytest.MonkeyPatch) -> None:
    bus = ScriptedBus()
    with DownSocket(socket.AF_UNIX, socket.SOCK_DGRAM) as down:
        bus.socket = down  # type: ignore[attr-defined]
        stand_in(monkeypatch, lambda: bus)
        with over_socket() as driver:
            assert driver.read_ready() == []
            assert driver.link_state is LinkState.WAITING
            assert driver.last_error is not None
            assert "Network is down" in driver.last_error


def test_what_the_kernel_drops_is_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    """UDP stands in: its sockets report drops in the same way as CAN sockets."""
    bus = ScriptedBus()
    with (
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as near,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as far,
    ):
        near.bind(("127.0.0.1", 0))
        far.connect(near.getsockname())
        bus.socket = near  # type: ignore[attr-defined]
        stand_in(monkeypatch, lambda: bus)
        with over_socket() as driver:
            assert near.getsockopt(socket.SOL_SOCKET, SO_RXQ_OVFL) == 1
            near.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1)
            record = pack_frame(CanFrame(0x7FF, b""))
            for _ in range(200):
                far.send(record)
            driver.read_ready()
            far.send(record)
            driver.read_ready()
            counters = driver.counters
            assert counters.kernel_drops > 0
            assert counters.frames + counters.kernel_drops == 201


def test_one_call_takes_a_bounded_number_of_frames(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = Clock()
    bus = ScriptedBus([message(b"\0", 0x7FF)] * (2 * FRAMES_PER_DRAIN + 5))
    stand_in(monkeypatch, lambda: bus)
    with CanBridgeDriver("pcan", "x", clock=clock) as driver:
        for expected in (FRAMES_PER_DRAIN, 2 * FRAMES_PER_DRAIN):
            driver.read_ready()
            assert driver.counters.frames == expected
            assert driver.due_ns() == clock.now_ns
        driver.read_ready()
        assert driver.counters.frames == 2 * FRAMES_PER_DRAIN + 5
        assert driver.due_ns() == clock.now_ns + POLL_NS


def test_a_bus_without_a_descriptor_is_polled_every_millisecond() -> None:
    clock = Clock()
    with bridge(channel(), clock=clock) as driver:
        assert driver.fileno() is None
        assert driver.due_ns() == clock.now_ns
        driver.read_ready()
        assert driver.due_ns() == clock.now_ns + POLL_NS


def send_on_time(bus: SocketBus, frames: Sequence[CanFrame], start_s: float) -> None:
    for at, frame in enumerate(frames):
        time.sleep(max(start_s + at * SLOT_NS / 1e9 - time.monotonic(), 0.0))
        bus.send(frame)


def test_the_loop_rests_while_no_reading_is_near(socket_bus: SocketBus) -> None:
    """Descriptor or time: at any moment the loop has one of them to wait for."""
    with over_socket() as driver:
        start_s = time.monotonic()
        rests, readings = 0, 0
        for sweep in range(20):
            for part in (sweep_of_frames(sweep)[:12], sweep_of_frames(sweep)[12:]):
                send_on_time(socket_bus, part, start_s)
                start_s += 12 * SLOT_NS / 1e9
                readings += len(driver.read_ready())
                due_ns = driver.due_ns()
                assert (driver.fileno() is None) == (due_ns is not None)
                if due_ns is not None:
                    rests += 1
                    assert due_ns - time.monotonic_ns() <= REST_MAX_NS
        assert readings == 20
        assert rests > 0
        driver.close()
        assert driver.due_ns() is driver.fileno() is None


def test_frames_per_second_are_told_until_there_are_none() -> None:
    clock = Clock()
    where = channel()
    with bridge(where, clock=clock) as driver:
        with can.Bus(interface="virtual", channel=where, ignore_config=True) as bus:
            for _ in range(11):
                for sent in sweep_messages():
                    bus.send(sent)
                clock.now_ns += 100 * MS
                driver.read_ready()
        assert driver.frames_per_s == pytest.approx(240, rel=0.05)
        clock.now_ns += 10_000 * MS
        assert driver.frames_per_s == 0.0


@pytest.fixture
def slcan_line() -> Iterator[tuple[str, Callable[[bytes], None], Callable[[], None]]]:
    """Path of a terminal that plays an slcan adapter, a way to write to it and to unplug it."""
    near, far = pty.openpty()
    tty.setraw(far)
    path = os.ttyname(far)
    descriptors = [near, far]

    def unplug() -> None:
        while descriptors:
            os.close(descriptors.pop())

    yield path, lambda data: (os.write(near, data), None)[1], unplug
    unplug()


def test_an_slcan_adapter_is_read_and_its_unplugging_leaves_nothing_open(
    slcan_line: tuple[str, Callable[[bytes], None], Callable[[], None]],
) -> None:
    path, write, unplug = slcan_line
    driver = CanBridgeDriver(
        "slcan", path, arbitration_id=SAMPLE_ID, sequence="electrodes", bitrate=1_000_000
    )
    before_s = time.monotonic()
    with driver:
        assert driver.fileno() is not None
        for frame in sweep_of_frames(0):
            write(f"t{frame.arbitration_id:03X}7{frame.data.hex().upper()}\r".encode())
        readings: list[Reading] = []
        while not readings and time.monotonic() - before_s < 5.0:
            readings += driver.read_ready()
        assert (tactile(readings)[0].counts == truth(0)).all()
        assert time.monotonic() - before_s < 1.5, "python-can's default sleeps two seconds"
        unplug()
        driver.read_ready()
        assert driver.link_state is LinkState.WAITING
        assert driver.counters.link_losses == 1
        for _ in range(3):
            time.sleep(0.12)
            driver.read_ready()
        assert driver.counters.bus_faults >= 3


def test_data_bit_rates_reach_an_slcan_adapter(monkeypatch: pytest.MonkeyPatch) -> None:
    seen: dict[str, object] = {}
    monkeypatch.setattr("drivers.can_bus.can.Bus", lambda **options: seen.update(options))
    bus = CanBridgeDriver(
        "slcan", "/dev/null", format="sweep_fd", bitrate=1_000_000, data_bitrate=5_000_000
    )
    bus.open()
    timing = seen["timing"]
    assert isinstance(timing, can.BitTimingFd)
    assert (timing.nom_bitrate, timing.data_bitrate) == (1_000_000, 5_000_000)
    assert seen["sleep_after_open"] == 0.0


def test_bus_options_reach_python_can_over_our_own(monkeypatch: pytest.MonkeyPatch) -> None:
    seen: dict[str, object] = {}
    monkeypatch.setattr("drivers.can_bus.can.Bus", lambda **options: seen.update(options))
    options = {"rx_queue_size": 7}
    CanBridgeDriver("virtual", "x", bitrate=500_000, bus_options=options).open()
    assert seen["rx_queue_size"] == 7
    assert seen["bitrate"] == 500_000
    assert seen["ignore_config"] is True


def test_real_socketcan_plays_count_for_count() -> None:
    """Needs a kernel with CAN: `ip link add dev vcan0 type vcan; ip link set vcan0 mtu 72 up`."""
    if not hasattr(socket, "AF_CAN"):
        pytest.skip("this Python knows no CAN sockets")
    try:
        socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW).close()
    except OSError as error:
        pytest.skip(f"this kernel has no PF_CAN: {error}")
    try:
        socket.if_nametoindex("vcan0")
    except OSError:
        pytest.skip("there is no interface vcan0")
    counts = contact(200)
    for frame_format in CanFormat:
        driver = CanBridgeDriver(
            "socketcan", "vcan0", format=frame_format, arbitration_id=SAMPLE_ID
        )
        twin = CanTwin(
            "socketcan", "vcan0", iter(counts), format=frame_format, arbitration_id=SAMPLE_ID
        )
        readings: list[TactileReading] = []
        with driver, twin:
            assert driver.fileno() is not None
            while twin.send_sweep():
                readings += tactile(driver.read_ready())
            assert driver.counters.kernel_drops == 0
        assert len(readings) == len(counts)
        for reading, expected in zip(readings, counts, strict=True):
            assert (reading.counts == expected).all()


def test_a_bus_that_was_never_opened_drains_nothing() -> None:
    bus = CanBus("virtual", "x", {}, time.monotonic_ns, time.time_ns)
    assert bus.drain() == []
    assert bus.fileno() is None
    bus.close()
