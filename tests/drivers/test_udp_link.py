"""A link of datagrams on a scripted socket: who may send, when it is silent, what was dropped."""

from __future__ import annotations

import errno
import os
import socket
import struct
from unittest.mock import Mock

import pytest

from graspd.drivers.base import Fact, LinkCause, LinkError
from graspd.drivers.datagrams.joints import JointStreamDriver
from graspd.drivers.link import LinkState
from graspd.drivers.udp import (
    Datagram,
    DatagramReceiver,
    Endpoint,
)
from tests.drivers.palm.palm_stream import MS, joints
from tests.drivers.udp_standin import HERE, THERE, Receiver
from tests.kit.clock import Clock

SILENCE_NS = 500 * MS
GOOD = b'{"joints":{"FFJ3":0.1}}'


class Bench:
    """An open link, its clock, and the sockets that it opens one after the other."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, only_from: str | None = None) -> None:
        self.sockets = [Receiver(3), Receiver(4)]
        waiting = list(self.sockets)
        monkeypatch.setattr("graspd.drivers.udp.DatagramReceiver", lambda *_: waiting.pop(0))
        self.clock = Clock()
        self.link = JointStreamDriver("udp://127.0.0.1:5700", only_from=only_from, clock=self.clock)
        self.link.open()
        self.counters = self.link.stream.counters

    def hear(self, *sent: Datagram) -> list[int]:
        """Let the datagrams `sent` arrive; return the ages of their readings, ns."""
        self.sockets[0].waiting += sent
        return [self.clock.now_ns - reading.t_ns for reading in joints(self.link.read_ready())]

    def fell_silent(self) -> bool:
        before = self.counters.link_losses
        self.link.read_ready()
        return self.counters.link_losses > before

    def listening(self) -> tuple[int | None, int | None]:
        return self.link.fileno(), self.link.port


@pytest.fixture
def bench(monkeypatch: pytest.MonkeyPatch) -> Bench:
    return Bench(monkeypatch)


def test_the_first_good_sender_is_the_only_one_until_silent(bench: Bench) -> None:
    assert bench.hear(Datagram(b"x", 0, THERE)) == []
    assert bench.link.link.state is LinkState.GREETING
    assert bench.hear(Datagram(GOOD, 0, HERE), Datagram(GOOD, 0, THERE)) == [0]
    assert (bench.counters.bad_messages, bench.counters.foreign_datagrams) == (1, 1)
    assert bench.link.describe() == {
        "source": Fact("udp://127.0.0.1:5700"),
        "link": Fact("up"),
        "heard": Fact("joint stream from 127.0.0.1 port 7"),
    }
    bench.clock.now_ns += SILENCE_NS
    assert bench.fell_silent()
    assert bench.hear(Datagram(GOOD, 0, THERE)) == [0]


def test_a_refused_sender_is_named_as_the_cause(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    bench = Bench(monkeypatch, "127.0.0.1")
    other = ("10.0.0.5", 7)
    why = "datagrams of 10.0.0.5 are refused by only_from"
    bench.hear(*[Datagram(GOOD, 0, other)] * 3)
    assert bench.link.describe()["link"] == Fact("greeting", LinkCause.FOREIGN)
    assert bench.link.describe()["why"] == Fact(why)
    bench.hear(Datagram(GOOD, 0, HERE), Datagram(GOOD, 0, other))
    assert bench.link.describe()["link"] == Fact("up")
    assert "why" not in bench.link.describe()
    bench.clock.now_ns += SILENCE_NS
    assert bench.fell_silent()
    bench.hear(Datagram(GOOD, 0, other))
    assert bench.link.describe()["link"] == Fact("greeting", LinkCause.FOREIGN)
    told = [record.getMessage() for record in caplog.records if record.levelname == "WARNING"]
    silence = "nothing good for 500 ms"
    assert told == [f"joints: {each}; trying again" for each in (why, silence, why)]


@pytest.mark.parametrize(
    ("source", "only_from", "sender", "is_heard"),
    [
        ("udp://[::]:0", "127.0.0.1", "127.0.0.1", True),
        ("udp://[::]:0", "::ffff:127.0.0.1", "127.0.0.1", True),
        ("udp://[::]:0", "0:0::1", "::1", True),
        ("udp://[::]:0", "::1", "127.0.0.1", False),
        ("udp://[::ffff:127.0.0.1]:0", "127.0.0.1", "127.0.0.1", True),
    ],
)
def test_only_from_compares_addresses_and_not_their_spelling(
    source: str, only_from: str, sender: str, is_heard: bool
) -> None:
    family = socket.AF_INET6 if ":" in sender else socket.AF_INET
    driver = JointStreamDriver(source, only_from=only_from)
    try:
        driver.open()
    except LinkError:
        pytest.skip("this machine has no IPv6")
    with driver, socket.socket(family, socket.SOCK_DGRAM) as near:
        near.sendto(b'{"joints":{"FFJ3":0.1}}', (sender, driver.port or 0))
        assert bool(driver.read_ready()) == is_heard
        assert driver.counters.foreign_datagrams == (not is_heard)


@pytest.mark.parametrize("number", [errno.EAFNOSUPPORT, errno.EMFILE])
def test_a_socket_that_cannot_be_made_is_a_link_error(
    monkeypatch: pytest.MonkeyPatch, number: int
) -> None:
    """On a computer without IPv6, or in a process without a free descriptor."""
    refused = Mock(side_effect=OSError(number, os.strerror(number)))
    monkeypatch.setattr("graspd.drivers.udp.socket.socket", refused)
    with pytest.raises(LinkError, match=f"^cannot listen on .*: {os.strerror(number)}$"):
        JointStreamDriver("udp://[::1]:5700").open()


def test_readings_have_their_datagrams_ages_and_never_go_back(bench: Bench) -> None:
    sent = [Datagram(GOOD, age_ns, HERE) for age_ns in (5, 7, 2)]
    assert bench.hear(*sent) == [5, 5, 2]


def test_silence_is_noticed_when_it_is_due_and_once(bench: Bench) -> None:
    assert bench.link.due_ns() is None
    assert not bench.fell_silent()
    bench.hear(Datagram(GOOD, 10 * MS, HERE))
    assert bench.link.due_ns() == bench.clock.now_ns + SILENCE_NS - 10 * MS
    bench.clock.now_ns += SILENCE_NS - 10 * MS - 1
    assert not bench.fell_silent()
    bench.clock.now_ns += 1
    assert bench.fell_silent()
    assert not bench.fell_silent()
    assert (bench.link.link.state, bench.counters.link_losses) == (LinkState.GREETING, 1)
    assert bench.link.describe()["link"] == Fact("greeting", LinkCause.TIMEOUT)
    assert bench.link.describe()["why"].text == "nothing good for 500 ms"
    assert bench.link.due_ns() is None


def test_kernel_drops_are_summed_over_reopened_sockets(bench: Bench) -> None:
    first, second = bench.sockets
    bench.hear(Datagram(GOOD, 0, HERE))
    assert bench.counters.kernel_drops == 3
    first.waiting.append(LinkError(LinkCause.INTERFACE_DOWN, "Network is down"))
    assert bench.hear() == []
    assert (bench.link.link.state, first.closed) == (LinkState.WAITING, True)
    assert bench.listening() == (None, None)
    due_ns = bench.link.due_ns()
    assert due_ns is not None
    bench.clock.now_ns = due_ns - 1
    assert bench.hear() == []
    assert bench.listening() == (None, None)
    bench.clock.now_ns = due_ns
    assert bench.hear() == []
    assert bench.listening() == (99, 5700)
    assert bench.counters.kernel_drops == 3 + 4
    second.waiting.append(LinkError(LinkCause.INTERFACE_DOWN, "Network is down"))
    assert bench.hear() == []
    assert bench.counters.kernel_drops == 3 + 4


def test_at_most_256_datagrams_are_taken_at_once(bench: Bench) -> None:
    assert len(bench.hear(*[Datagram(GOOD, 0, HERE)] * 300)) == 256
    assert len(bench.hear()) == 300 - 256


def test_a_receive_buffer_of_128_kibibytes_is_requested() -> None:
    """0.2 s of palm packets; the kernel gives as much to any socket that requests the same."""
    receiver = DatagramReceiver(Endpoint("127.0.0.1", 0), 100)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        other.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 131_072)
        with socket.socket(fileno=os.dup(receiver.fileno())) as same:
            sizes = {each.getsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF) for each in (same, other)}
    receiver.close()
    assert len(sizes) == 1


@pytest.mark.parametrize(
    ("source", "endpoint"),
    [
        ("udp://127.0.0.1:0", Endpoint("127.0.0.1", 0)),
        ("udp://127.0.0.1:65535", Endpoint("127.0.0.1", 65535)),
        ("udp://[::1]:5700", Endpoint("::1", 5700)),
        ("udp://127.0.0.1:65536", None),
        ("udp://127.0.0.1", None),
        ("udp://127.0.0.1:\u0661", None),
        ("tcp://127.0.0.1:5700", None),
        ("udp://localhost:5700", None),
    ],
)
def test_a_source_is_an_address_and_a_port(source: str, endpoint: Endpoint | None) -> None:
    if endpoint is None:
        with pytest.raises(ValueError, match=r"is not (like udp://|an IP address)"):
            Endpoint.parse(source)
    else:
        assert Endpoint.parse(source) == endpoint
        assert str(endpoint) == source


class Kernel:
    """A socket that hands over what the kernel would: datagrams with notes, or errors."""

    def __init__(self, *_: object) -> None:
        self.script: list[tuple[bytes, list[tuple[int, int, bytes]]] | OSError] = []
        self.options: dict[int, int] = {}

    def setsockopt(self, level: int, option: int, value: int) -> None:
        assert level == socket.SOL_SOCKET
        self.options[option] = value

    def setblocking(self, _on: bool) -> None: ...

    def bind(self, _address: object) -> None: ...

    def close(self) -> None: ...

    def recvmsg(self, most: int, _room: int) -> tuple[bytes, list[object], int, tuple[object, ...]]:
        if not self.script:
            raise BlockingIOError
        step = self.script.pop(0)
        if isinstance(step, OSError):
            raise step
        return step[0][:most], list(step[1]), 0, ("::1", 7, 0, 0)


def noted(
    monkeypatch: pytest.MonkeyPatch, *script: tuple[bytes, list[tuple[int, int, bytes]]] | OSError
) -> tuple[DatagramReceiver, Kernel]:
    kernel = Kernel()
    kernel.script += script
    monkeypatch.setattr("graspd.drivers.udp.socket.socket", lambda *_: kernel)
    monkeypatch.setattr("graspd.drivers.udp.time.time_ns", lambda: 5_000_000_010)
    monkeypatch.setattr("graspd.drivers.udp.time.monotonic_ns", lambda: 900_000_000)
    return DatagramReceiver(Endpoint("::1", 5700), 100), kernel


SOL, STAMP, LOST = socket.SOL_SOCKET, 35, 40
"""Numbers of SO_TIMESTAMPNS and SO_RXQ_OVFL in asm-generic/socket.h."""


@pytest.mark.parametrize(
    ("notes", "age_ns", "dropped"),
    [
        ([(SOL, STAMP, struct.pack("@ll", 5, 7))], 3, 0),
        ([(SOL, STAMP, struct.pack("@ll", 5, 11))], 0, 0),  # the wall clock was set back
        ([(SOL, STAMP, b"short")], 0, 0),
        ([(0, STAMP, struct.pack("@ll", 5, 7)), (0, LOST, struct.pack("@I", 9))], 0, 0),
        ([(SOL, LOST, struct.pack("@Q", 9))], 0, 0),
        ([(SOL, STAMP, struct.pack("@ll", 5, 7)), (SOL, LOST, struct.pack("@I", 2))], 3, 2),
        ([(SOL, 99, struct.pack("@I", 9))], 0, 0),
        ([], 0, 0),
    ],
)
def test_age_and_drops_come_from_valid_kernel_stamps(
    monkeypatch: pytest.MonkeyPatch,
    notes: list[tuple[int, int, bytes]],
    age_ns: int,
    dropped: int,
) -> None:
    receiver, kernel = noted(monkeypatch, (b"a", notes))
    assert list(receiver.receive(5)) == [Datagram(b"a", age_ns, ("::1", 7))]
    assert receiver.dropped == dropped
    assert kernel.options[STAMP]
    assert kernel.options[LOST]


@pytest.mark.parametrize(
    ("step_ms", "age_ms"), [(-350, 450), (6, 450), (-6, 450), (5, 255), (-5, 245)]
)
def test_a_step_of_the_wall_clock_makes_no_datagram_younger(
    monkeypatch: pytest.MonkeyPatch, step_ms: int, age_ms: int
) -> None:
    """A stall of 450 ms; the datagram came after 200 ms of it. Up to 5 ms are not a step."""
    stamp = struct.pack("@ll", 5, 200_000_010)
    receiver, kernel = noted(monkeypatch)
    assert list(receiver.receive(5)) == []
    kernel.script += [(b"a", [(SOL, STAMP, stamp)])] * 2
    wall_ns = 5_000_000_010 + (450 + step_ms) * 1_000_000
    monkeypatch.setattr("graspd.drivers.udp.time.time_ns", lambda: wall_ns)
    monkeypatch.setattr("graspd.drivers.udp.time.monotonic_ns", lambda: 1_350_000_000)
    ages = [datagram.age_ns for most in (1, 5) for datagram in receiver.receive(most)]
    assert ages == [age_ms * 1_000_000] * 2


def test_an_overlong_datagram_is_truncated_to_limit_plus_one(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    receiver, _ = noted(monkeypatch, (bytes(100), []), (bytes(500), []), (b"a", []))
    assert [len(datagram.data) for datagram in receiver.receive(2)] == [100, 101]
    assert len(list(receiver.receive(3))) == 1


def test_an_interrupted_receive_is_repeated_but_an_error_raises(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    broken = OSError(100, "Network is down")
    receiver, _ = noted(monkeypatch, InterruptedError(), (b"a", []), broken)
    taken = receiver.receive(5)
    assert next(taken).data == b"a"
    with pytest.raises(LinkError, match="cannot receive: Network is down") as raised:
        next(taken)
    assert raised.value.cause is LinkCause.INTERFACE_DOWN
