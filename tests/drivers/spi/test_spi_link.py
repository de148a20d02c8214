"""The link to the serial bridge, and driver and twin over a real pseudo-terminal."""

from __future__ import annotations

import dataclasses
import logging
import socket
import struct
from collections.abc import Iterator
from pathlib import Path

import pytest

from graspd.drivers.base import TactileReading
from graspd.drivers.link import LinkState
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
def test_a_port_that_can_never_be_is_refused(port: str) -> None:
    with pytest.raises(ValueError, match=f"^port {port}: "):
        SpiBridgeDriver(port, FINGERS)
    for possible in ("/dev/absent", "loop://", "socket://here:5", "hwgrep://absent"):
        SpiBridgeDriver(possible, FINGERS)


def test_the_greeting_is_that_of_the_protocol(rig: Rig) -> None:
    said = rig.greet()
    assert [type(message) for message in said] == [Stop, Ping]
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
def test_a_bridge_of_another_version_is_refused_in_one_line(
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


def test_a_port_that_another_program_has_is_said(rig: Rig) -> None:
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


def test_a_socket_has_a_descriptor_until_it_is_lost() -> None:
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


def test_frames_that_find_no_room_are_counted(rig: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
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
            return driver.counters.link_losses >= 6

        wait_until(is_lost_often, step_s=0.0002)
        # The twin may break the link again before the driver notices.
        assert driver.counters.link_losses <= twin.injected["disconnect"] <= 7
    made = {row.tobytes() for row in rows[: twin.sweeps_made]}
    assert len(readings) > 150
    assert all(reading.counts.tobytes() in made for reading in readings)
    seqs = [reading.seq for reading in readings]
    assert seqs == sorted(set(seqs))


def test_only_a_dead_link_is_replaced(tmp_path: Path) -> None:
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
