"""The link to the serial bridge: its port, on a stand-in and on a real pseudo-terminal."""

from __future__ import annotations

import dataclasses
import errno
import logging
import socket
import struct
import termios
from collections.abc import Iterator
from pathlib import Path

import pytest
import serial

from graspd.drivers.base import DriverError, LinkError, TactileReading
from graspd.drivers.link import LinkState
from graspd.drivers.spi.conversation import LineEvent
from graspd.drivers.spi.driver import SerialLine, SpiBridgeDriver
from graspd.drivers.spi.messages import DIGEST, Ping, Start, Stop, encode, encode_frame
from graspd.drivers.twins.faults import LinkFaults
from graspd.drivers.twins.spi import SpiTwin
from tests.drivers.one_sweep import sweeps_of, tactile
from tests.drivers.spi.bridge_bench import FINGERS, MS, Rig, ScriptedBridge, hello, sweep, take
from tests.kit.clock import Clock
from tests.kit.waiting import wait_until


@pytest.fixture
def rig() -> Iterator[Rig]:
    clock = Clock()
    with ScriptedBridge() as bridge:
        driver = SpiBridgeDriver(bridge.port, FINGERS, clock=clock)
        yield Rig(bridge, driver, clock)
        driver.close()


@pytest.mark.parametrize("port", ["nonsense://1", "socket://here", "rfc2217://here:70000"])
def test_a_port_name_that_cannot_exist_is_refused(port: str) -> None:
    with pytest.raises(ValueError, match=f"^port {port}: "):
        SpiBridgeDriver(port, FINGERS)
    for possible in ("/dev/absent", "loop://", "socket://here:5", "hwgrep://absent"):
        SpiBridgeDriver(possible, FINGERS)


def test_opening_sends_stop_and_ping_then_start_when_answered(rig: Rig) -> None:
    said = rig.greet()
    assert [type(message) for message in said] == [Stop, Ping]
    assert said[1] == Ping((rig.clock.now_ns + 1) % 2**32), "another in each start"
    assert [type(message) for message in rig.bridge.heard(Start)] == [Start]
    assert str(rig.driver.conversation.link.state) == "greeting"
    assert rig.driver.period_ns == 10 * MS
    rig.driver.close()
    assert [type(message) for message in rig.bridge.heard(Stop)] == [Stop]
    assert rig.driver.conversation.link.state is LinkState.CLOSED


REFUSALS = [
    (
        encode_frame(0x01, struct.pack("<BII", 2, 0xCAFEF00D, 0) + b"later things"),
        "the bridge speaks version 2, this is version 1",
    ),
    (
        encode(dataclasses.replace(hello(0), digest=0xCAFEF00D)),
        f"the bridge has layout 0xCAFEF00D of version 1, this is 0x{DIGEST:08X}",
    ),
]


@pytest.mark.parametrize(("answer", "why"), REFUSALS, ids=["version", "layout"])
def test_a_bridge_of_another_version_is_refused_with_one_warning(
    rig: Rig, caplog: pytest.LogCaptureFixture, answer: bytes, why: str
) -> None:
    rig.driver.open()
    rig.bridge.heard(Ping)
    with caplog.at_level(logging.WARNING):
        rig.bridge.send(answer, encode(sweep(0, 0)))
        assert take(rig.driver, rig.bridge) == []
    assert rig.driver.conversation.link.reason == f"{rig.bridge.port}: {why}"
    assert rig.driver.conversation.link.state is LinkState.WAITING
    assert rig.driver.counters.refused_bridges == 1
    assert [record.levelname for record in caplog.records] == ["WARNING"]
    assert rig.bridge.says_nothing_more(), "not even START"


def test_sweeps_that_waited_while_the_host_slept_are_not_silence(rig: Rig) -> None:
    rig.greet()
    for seq in range(50):
        rig.bridge.send(sweep(seq, 10_000 * seq + 100))
    rig.clock.now_ns += 500 * MS
    readings = take(rig.driver, rig.bridge)
    assert len(readings) == 50
    assert rig.driver.conversation.link.state is LinkState.UP
    # The first is half a second old and the times between them are those of the bridge.
    ages_ms = [(rig.clock.now_ns - reading.t_ns) / MS for reading in readings]
    assert ages_ms[0] == pytest.approx(498, abs=0.5)
    assert ages_ms[0] - ages_ms[-1] == pytest.approx(490, abs=0.5)


def test_a_port_in_use_is_named_as_the_cause(rig: Rig) -> None:
    rig.greet()
    with SpiBridgeDriver(rig.bridge.port, FINGERS) as second:
        assert second.conversation.link.reason == f"{rig.bridge.port}: another program has it open"
    assert rig.driver.conversation.link.state is LinkState.GREETING


def test_a_port_without_descriptor_is_polled(rig: Rig) -> None:
    clock = Clock()
    with SpiBridgeDriver("loop://", FINGERS, clock=clock) as driver:
        assert driver.fileno() is None
        assert driver.conversation.link.state is LinkState.GREETING
        clock.now_ns += 5 * MS
        assert driver.read_ready() == []
        assert driver.due_ns() == clock.now_ns + 2 * MS
        # What comes back is what was said: STOP and PING, which no bridge says.
        assert driver.counters.unknown_frames == 2


def test_a_socket_has_a_descriptor_and_its_loss_is_noticed() -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = f"socket://127.0.0.1:{server.getsockname()[1]}"
        clock = Clock()
        with SpiBridgeDriver(port, FINGERS, clock=clock) as driver:
            peer, _ = server.accept()
            with peer:
                assert driver.fileno() is not None
                assert len(peer.recv(1)) == 1
            for _ in range(100):
                if driver.conversation.link.state is LinkState.WAITING:
                    break
                driver.read_ready()
            assert driver.conversation.link.state is LinkState.WAITING


def test_a_bridge_that_does_not_read_never_blocks_the_host(rig: Rig) -> None:
    line = SerialLine(rig.bridge.port, 921_600)
    line.open()
    writes = 0
    while line.write(b"x" * 1000):  # the last one would wait for ever
        writes += 1
        assert writes < 10_000
    line.close()


def test_frames_without_room_in_the_port_are_counted_dropped(
    rig: Rig, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(SerialLine, "write", lambda _line, _frame: False)
    rig.driver.open()
    assert rig.driver.counters.host_tx_dropped == len([Stop, Ping])


def test_a_link_broken_within_a_frame_comes_back(tmp_path: Path) -> None:
    faults = LinkFaults(disconnect_every_frames=40)
    rows = sweeps_of(100_000 // 24)
    twin = SpiTwin(tmp_path / "b", rows, rate_hz=1000.0, faults=faults)
    readings: list[TactileReading] = []
    with twin, SpiBridgeDriver(str(tmp_path / "b"), FINGERS) as driver:

        def is_lost_often() -> bool:
            twin.run_once()
            readings.extend(tactile(driver.read_ready()))
            return driver.counters.link_losses >= 6 and len(readings) > 150

        wait_until(is_lost_often, step_s=0.0002)
        # The twin may break the link again before the driver notices.
        losses = driver.counters.link_losses
        assert losses <= twin.injected["disconnect"] <= losses + 1
    made = {row.tobytes() for row in rows[: twin.sweeps_made]}
    assert all(reading.counts.tobytes() in made for reading in readings)
    seqs = [reading.seq for reading in readings]
    assert seqs == sorted(set(seqs))


def test_a_twin_replaces_a_dead_symlink_but_no_live_one(tmp_path: Path) -> None:
    path = tmp_path / "bridge"
    path.symlink_to("/dev/pts/of-a-twin-that-was-killed")
    with SpiTwin(path, sweeps_of(1)) as first:
        terminal = path.readlink()
        second = SpiTwin(path, sweeps_of(1))
        with pytest.raises(FileExistsError, match=f"leads to {terminal}; .* another twin"):
            second.open()
        second.close()
        assert path.readlink() == terminal
        first.plug()
        assert path.exists()
    assert not path.is_symlink()


class Port:
    """Stand-in for a port of pyserial that reads `incoming`. `waiting`: its next `out_waiting`."""

    def __init__(self, incoming: bytes = b"", waiting: tuple[int, ...] = ()) -> None:
        self.incoming, self.waiting = incoming, list(waiting)
        self.reads: list[int] = []
        self.written = b""
        self.failure: Exception | None = None
        self.refusal: Exception | None = None
        self.discarded = self.closed = False

    def open(self) -> None:
        if self.refusal is not None:
            raise self.refusal

    def read(self, most: int) -> bytes:
        self.reads.append(most)
        if self.failure is not None and not self.incoming:
            raise self.failure
        chunk, self.incoming = self.incoming[:most], self.incoming[most:]
        return chunk

    def write(self, data: bytes) -> None:
        if self.failure is not None:
            raise self.failure
        self.written += data

    def fileno(self) -> int:
        raise AttributeError("no descriptor")

    def set_low_latency_mode(self, _on: bool) -> None:
        raise ValueError("not an FTDI adapter")

    @property
    def out_waiting(self) -> int:
        return self.waiting.pop(0) if self.waiting else 0

    def reset_output_buffer(self) -> None:
        self.discarded = True

    def close(self) -> None:
        self.closed = True


def opened(monkeypatch: pytest.MonkeyPatch, port: Port) -> SerialLine:
    monkeypatch.setattr("graspd.drivers.spi.driver.serial.serial_for_url", lambda *_, **__: port)
    line = SerialLine("port", 115_200)
    line.open()
    return line


def test_a_flood_is_taken_in_32_reads_of_4096_bytes(monkeypatch: pytest.MonkeyPatch) -> None:
    """That is more than the 64 KiB that a kernel keeps; no call reads more."""
    port = Port(b"x" * (33 * 4096))
    line = opened(monkeypatch, port)
    assert len(line.read()) == 32 * 4096
    assert port.reads == [4096] * 32
    assert len(line.read()) == 4096
    assert line.read() == b""
    assert len(port.reads) == 32 + 2 + 1, "no read after one that found nothing"


def test_bytes_before_a_failure_are_handed_over(monkeypatch: pytest.MonkeyPatch) -> None:
    port = Port(b"last words")
    port.failure = serial.SerialException("gone")
    line = opened(monkeypatch, port)
    assert line.read() == b"last words"
    with pytest.raises(LinkError, match="port: the device went away"):
        line.read()


@pytest.mark.parametrize(
    ("failure", "told"),
    [
        (serial.SerialTimeoutException("full"), None),
        (serial.SerialException("gone"), "the device went away"),
        (termios.error(5, "gone"), "the device went away"),
    ],
)
def test_a_write_returns_false_when_full_and_raises_when_gone(
    monkeypatch: pytest.MonkeyPatch, failure: Exception, told: str | None
) -> None:
    port = Port()
    line = opened(monkeypatch, port)
    assert line.write(b"abc")
    assert port.written == b"abc"
    port.failure = failure
    if told is None:
        assert not line.write(b"def")
    else:
        with pytest.raises(LinkError, match=told):
            line.write(b"def")


@pytest.mark.parametrize(
    ("waiting", "sleeps", "discarded"),
    [((), 0, False), ((9, 9), 2, False), ((9,) * 9, 9, False), ((9,) * 10, 10, True)],
)
def test_closing_waits_at_most_20_ms_for_last_bytes(
    monkeypatch: pytest.MonkeyPatch, waiting: tuple[int, ...], sleeps: int, discarded: bool
) -> None:
    slept: list[float] = []
    monkeypatch.setattr("graspd.drivers.spi.driver.time.sleep", slept.append)
    port = Port(waiting=waiting)
    line = opened(monkeypatch, port)
    line.close()
    line.close()
    assert slept == [0.002] * sleeps
    assert (port.discarded, port.closed) == (discarded, True)
    with pytest.raises(RuntimeError, match="port is not open"):
        line.read()


@pytest.mark.parametrize(
    ("failure", "kind", "told"),
    [
        (OSError(errno.EBUSY, "busy"), LinkError, "another program has it open"),
        (OSError(errno.EAGAIN, "lock"), LinkError, "another program has it open"),
        (OSError(errno.ENOENT, "x"), LinkError, "no such file or directory"),
        (serial.SerialException("first\nsecond"), LinkError, "port: first$"),
        (ValueError("not a baud rate"), DriverError, "not a baud rate"),
    ],
)
def test_why_a_port_cannot_be_opened_is_one_short_line(
    monkeypatch: pytest.MonkeyPatch, failure: Exception, kind: type[Exception], told: str
) -> None:
    def refuse(*_: object, **__: object) -> None:
        raise failure

    monkeypatch.setattr("graspd.drivers.spi.driver.serial.serial_for_url", refuse)
    with pytest.raises(kind, match=told):
        SerialLine("port", 9600).open()


def test_a_tap_of_a_line_gets_bytes_of_both_directions(monkeypatch: pytest.MonkeyPatch) -> None:
    tapped: list[tuple[LineEvent, bytes]] = []
    line = opened(monkeypatch, Port(b"in"))
    line.tap = lambda event, data: tapped.append((event, data))
    line.read()
    line.read()
    line.write(b"out")
    line.open()
    assert tapped == [
        (LineEvent.RECEIVED, b"in"),
        (LineEvent.SENT, b"out"),
        (LineEvent.OPENED, b""),
    ]
    assert [int(event) for event in LineEvent] == [1, 2, 3], "as serial link logs hold them"
