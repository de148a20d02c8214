"""The link to the serial bridge: greeting, refusals, losses, and the way back."""

from __future__ import annotations

import dataclasses
import logging
import socket
import struct
import time
from collections.abc import Iterator

import pytest

from graspd.drivers.base import DriverError
from graspd.drivers.link import LinkState
from graspd.drivers.spi.driver import SpiBridgeDriver
from graspd.drivers.spi.line import SerialLine
from graspd.drivers.spi.messages import DIGEST, Ping, Start, Stop, encode, encode_frame
from tests.drivers.spi.bridge_bench import FINGERS, MS, Rig, ScriptedBridge, hello, sweep, take
from tests.kit.clock import Clock


@pytest.fixture
def rig() -> Iterator[Rig]:
    clock = Clock()
    with ScriptedBridge() as bridge:
        driver = SpiBridgeDriver(bridge.port, FINGERS, clock=clock)
        yield Rig(bridge, driver, clock)
        driver.close()


def test_a_port_that_can_never_be_is_said_at_once() -> None:
    driver = SpiBridgeDriver("nonsense://1", FINGERS)
    with pytest.raises(DriverError, match="nonsense"):
        driver.open()
    driver.close()


def test_the_greeting_is_that_of_the_protocol(rig: Rig) -> None:
    said = rig.greet()
    assert [type(message) for message in said] == [Stop, Ping]
    assert [type(message) for message in rig.bridge.heard(Start)] == [Start]
    assert rig.driver.conversation.link.state is LinkState.GREETING
    assert rig.driver.conversation.hello is not None
    assert rig.driver.conversation.hello.board == "b"
    assert rig.driver.period_ns == 10 * MS


def test_the_first_nonce_is_of_the_time_so_that_an_old_answer_is_told_from_a_new_one(
    rig: Rig,
) -> None:
    rig.clock.now_ns = (7 << 32) + 12345
    assert rig.greet()[-1] == Ping(12346)


def test_closing_tells_the_bridge_to_stop(rig: Rig) -> None:
    rig.greet()
    rig.bridge.heard(Start)
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


def test_sweeps_that_waited_while_the_host_slept_are_no_silence(rig: Rig) -> None:
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


def test_unplugging_is_noticed_at_once(rig: Rig) -> None:
    rig.greet()
    rig.bridge.send(sweep(0, 10_000))
    take(rig.driver, rig.bridge)
    rig.bridge.unplug()
    assert rig.driver.read_ready() == ()
    assert rig.driver.conversation.link.state is LinkState.WAITING
    assert rig.driver.conversation.link.reason == f"{rig.bridge.port}: the device went away"
    assert rig.driver.counters.link_losses == 1


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


def test_a_socket_has_a_descriptor_and_its_end_is_a_lost_link() -> None:
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
    began_s = time.monotonic()
    writes = 0
    while line.write(b"x" * 1000):
        writes += 1
        assert writes < 10_000
    line.close()
    assert time.monotonic() - began_s < 2.0


def test_frames_that_find_no_room_are_counted(rig: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(SerialLine, "write", lambda _line, _frame: False)
    rig.driver.open()
    assert rig.driver.counters.host_tx_dropped == len([Stop, Ping])
