"""What the tests of the CAN bridge share: stand-ins for buses, and what is sent over them."""

from __future__ import annotations

import errno
import itertools
import socket
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, Self
from unittest import mock

import can
import pytest

from graspd.drivers.can.frames import CanCounters, CanFrame, encode_sample
from graspd.drivers.can.stream import CanStream
from graspd.drivers.kernel_stamps import SO_TIMESTAMPNS
from graspd.drivers.twins.can import SAMPLE_ID, CanTwin
from tests.drivers.can.can_words import pack_frame, samples

CHANNELS = itertools.count()
LOOPBACK = "lo"
"""Network interface that every computer has; the driver looks for it before python-can does."""


class SocketBus:
    """Stand-in for python-can's `socketcan` bus, of which the driver uses the raw socket.

    The socket is one end of a pair of Unix datagram sockets.
    """

    def __init__(self, *, stamped: bool = False) -> None:
        """`stamped`: the kernel stamps each frame, as those of CAN. Else the driver gives all
        frames of one read the same time."""
        self.socket, self.far_end = socket.socketpair(socket.AF_UNIX, socket.SOCK_DGRAM)
        self.socket.setsockopt(socket.SOL_SOCKET, SO_TIMESTAMPNS, stamped)
        self.far_end.setblocking(False)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.shutdown()
        self.far_end.close()

    def send(self, *frames: CanFrame) -> None:
        for frame in frames:
            self.far_end.send(pack_frame(frame))

    def fileno(self) -> int:
        return self.socket.fileno()

    def shutdown(self) -> None:
        self.socket.close()


class DownSocket(socket.socket):
    """A socket of an interface that was taken down."""

    def recvmsg(self, *_: object) -> Any:  # noqa: ANN401
        raise OSError(errno.ENETDOWN, "Network is down")


class ScriptedBus:
    """A bus without a descriptor whose `recv` follows a script of messages and exceptions."""

    def __init__(self, script: Sequence[can.Message | BaseException | None] = ()) -> None:
        self.script = list(script)
        self.shut_down = 0
        self.shutdown_error: BaseException | None = None

    def recv(self, timeout: float | None = None) -> can.Message | None:
        assert timeout == 0, "the driver waits"
        if not self.script:
            return None
        step = self.script.pop(0)
        if isinstance(step, BaseException):
            raise step
        return step

    def fileno(self) -> int:
        raise NotImplementedError

    def shutdown(self) -> None:
        self.shut_down += 1
        if self.shutdown_error is not None:
            raise self.shutdown_error


Opener = Callable[[], object]


def stand_in(monkeypatch: pytest.MonkeyPatch, opener: Opener) -> None:
    """Replace python-can's `Bus` by a function that returns or raises what `opener` does."""

    def open_bus(**_: object) -> object:
        return opener()

    monkeypatch.setattr("graspd.drivers.can.bus.can.Bus", open_bus)


def channel() -> str:
    """A virtual channel that no other test uses."""
    return f"test-{next(CHANNELS)}"


def message(data: bytes = b"", identifier: int = SAMPLE_ID, **options: bool) -> can.Message:
    options.setdefault("is_extended_id", False)
    return can.Message(arbitration_id=identifier, data=data, **options)


def sweep_messages(sweep: int = 0) -> list[can.Message]:
    return [message(encode_sample(channel, words)) for channel, words, _ in samples(sweep)]


def sweep_of_frames(sweep: int) -> list[CanFrame]:
    return [
        CanFrame(SAMPLE_ID, encode_sample(channel, words)) for channel, words, _ in samples(sweep)
    ]


class StampingTwin(CanTwin):
    """A twin whose frames are stamped by its own clock."""

    def open(self) -> None:
        stamped = partial(can.Bus, preserve_timestamps=True)
        with mock.patch("graspd.drivers.can.bus.can.Bus", stamped):
            super().open()


def decoder(
    arbitration_id: int | None = SAMPLE_ID, data_length: int | None = None
) -> tuple[CanStream, CanCounters]:
    made = CanStream(
        "bus",
        ("ff", "mf", "th"),
        arbitration_id=arbitration_id,
        sequence="electrodes",
        data_length=data_length,
    )
    return made, made.counters
