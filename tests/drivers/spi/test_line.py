"""A serial port on a stand-in for pyserial: how much at once, how patient, what is told."""

from __future__ import annotations

import errno
import termios

import pytest
import serial

from graspd.drivers.base import DriverError, LinkError
from graspd.drivers.spi.conversation import LineEvent
from graspd.drivers.spi.driver import SerialLine


class Port:
    """What pyserial opens: reads `incoming`, and has `waiting` values for bytes still to go."""

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
    """More than the 64 KiB that a kernel keeps, and never more at once."""
    port = Port(b"x" * (33 * 4096))
    line = opened(monkeypatch, port)
    assert len(line.read()) == 32 * 4096
    assert port.reads == [4096] * 32
    assert len(line.read()) == 4096
    assert line.read() == b""


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
def test_a_full_line_is_not_a_failure(
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
def test_closing_waits_20_ms_for_last_bytes(
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


def test_who_taps_a_line_gets_all_that_comes_and_goes(monkeypatch: pytest.MonkeyPatch) -> None:
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
