"""The bridge's end of a serial line for tests: its messages, passed by calls or a scripted port."""

from __future__ import annotations

import dataclasses
import os
import select
import time
import tty
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray

from graspd.drivers.base import TactileReading
from graspd.drivers.biotac import SEQUENCES, encode_word, sample_command
from graspd.drivers.link import LinkState
from graspd.drivers.spi.conversation import Conversation
from graspd.drivers.spi.driver import SpiBridgeDriver
from graspd.drivers.spi.messages import (
    DIGEST,
    FrameParser,
    Hello,
    Message,
    Ping,
    Sweep,
    decode,
    encode,
)
from tests.drivers.one_sweep import tactile
from tests.kit.clock import Clock

MS = 1_000_000
T0 = 5_000_000 * MS
"""Host time when a conversation begins, ns."""
FINGERS = ("ff", "mf", "th")
PATIENCE_S = 100.0
"""Real time that a test waits for bytes that must come."""


class ScriptedBridge:
    """A pseudo-terminal on which a test says exactly what a bridge says."""

    def __init__(self) -> None:
        self._master, self._slave = os.openpty()
        tty.setraw(self._slave)
        self.port = os.ttyname(self._slave)
        self.sent_bytes = 0
        self._parser = FrameParser(DIGEST)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_details: object) -> None:
        self.unplug()

    def unplug(self) -> None:
        if self._master >= 0:
            os.close(self._master)
            os.close(self._slave)
        self._master = -1

    def send(self, *messages: Message | bytes) -> None:
        for message in messages:
            data = message if isinstance(message, bytes) else encode(message)
            self.sent_bytes += os.write(self._master, data)

    def heard(self, last: type[Message]) -> list[Message]:
        """Messages from the host, up to one of type `last`."""
        messages: list[Message] = []
        deadline = time.monotonic() + PATIENCE_S
        while not messages or type(messages[-1]) is not last:
            assert time.monotonic() < deadline, f"no {last.__name__} after {messages}"
            if select.select([self._master], [], [], 0.1)[0]:
                for frame in self._parser.feed(os.read(self._master, 4096)):
                    message = decode(*frame)
                    assert message is not None
                    messages.append(message)
        return messages

    def says_nothing_more(self) -> bool:
        return not select.select([self._master], [], [], 0.02)[0]


def hello(
    nonce: int,
    tick: int = 0,
    *,
    channels: Sequence[int] = SEQUENCES["electrodes"],
    sensors: int = 3,
    period_ms: int = 10,
) -> Hello:
    commands = tuple(sample_command(channel) for channel in channels)
    serials = ("BTSP-1",) * sensors
    return Hello(nonce, tick, 1_000_000, 1000 * period_ms, serials, commands, board="b")


def words(first: int = 1000, slots: int = 24, sensors: int = 3) -> NDArray[np.uint16]:
    """Words whose counts tell slot and sensor: `first + 10 * slot + sensor`."""
    return np.array(
        [
            [encode_word(first + 10 * slot + sensor) for sensor in range(sensors)]
            for slot in range(slots)
        ],
        dtype=np.uint16,
    )


def sweep(seq: int, tick: int, present: int = 7, read: NDArray[np.uint16] | None = None) -> Sweep:
    return Sweep(seq, tick, tick + 1900, present, words() if read is None else read)


def said(conversation: Conversation, now_ns: int) -> list[Message]:
    """Messages that the host has to send now, recorded as sent."""
    messages = []
    parser = FrameParser(DIGEST)
    for data in conversation.say(now_ns):
        conversation.sent(data, now_ns)
        messages += [decode(*frame) for frame in parser.feed(data)]
    return [message for message in messages if message is not None]


def hear(conversation: Conversation, message: Message, now_ns: int) -> list[TactileReading]:
    """Let a message arrive at `now_ns`, a sweep not before its end; return the readings of it."""
    if isinstance(message, Sweep):
        now_ns = max(now_ns, T0 + 1000 * message.tick_end)
    return tactile(conversation.receive(encode(message), now_ns))


def opened(nonce: int = 41, sensors: Sequence[str] | None = None) -> Conversation:
    conversation = Conversation("port", FINGERS, sensors, nonce=nonce)
    conversation.opened(T0)
    return conversation


def answer(conversation: Conversation, about: Hello, now_ns: int = T0) -> None:
    """Let the HELLO `about` answer the PING that is due."""
    (nonce,) = (each.nonce for each in said(conversation, now_ns) if isinstance(each, Ping))
    assert hear(conversation, dataclasses.replace(about, nonce=nonce), now_ns) == []


def told(conversation: Conversation, serials: tuple[str, ...], now_ns: int) -> None:
    """Let a HELLO with these serial numbers answer the due PING; reopen a link that is lost."""
    about = dataclasses.replace(hello(0, period_ms=50), serials=serials)
    answer(conversation, about, now_ns)
    if conversation.link.state is LinkState.WAITING:
        conversation.opened(now_ns)


def greeted(about: Hello | None = None, sensors: Sequence[str] | None = None) -> Conversation:
    """A conversation, before START, whose bridge has answered with the HELLO `about`; None:
    `hello(0)`. `sensors`: as for `Conversation`."""
    conversation = opened(40, sensors)
    for _ in range(2):  # the serial numbers are believed when they are told again
        if conversation.hello is None and conversation.link.state is LinkState.GREETING:
            answer(conversation, about or hello(0))
    return conversation


def take(driver: SpiBridgeDriver, bridge: ScriptedBridge) -> list[TactileReading]:
    """All readings of what the bridge has sent; returns early when the driver gives up."""
    readings: list[TactileReading] = []
    deadline = time.monotonic() + PATIENCE_S
    while (
        driver.counters.bytes < bridge.sent_bytes
        and driver.conversation.link.state is not LinkState.WAITING
    ):
        assert time.monotonic() < deadline, f"{driver.counters} of {bridge.sent_bytes} bytes"
        descriptor = driver.fileno()
        assert descriptor is not None
        select.select([descriptor], [], [], 0.1)
        readings += tactile(driver.read_ready())
    return readings


@dataclass(frozen=True)
class Rig:
    bridge: ScriptedBridge
    driver: SpiBridgeDriver
    clock: Clock

    def greet(self) -> list[Message]:
        """Open the driver and answer two PINGs; return its messages up to the first of them."""
        self.driver.open()
        first = self._answered()
        self._answered()
        return first

    def _answered(self) -> list[Message]:
        """Answer the next PING; return the driver's messages up to it."""
        heard = self.bridge.heard(Ping)
        (ping,) = (message for message in heard if isinstance(message, Ping))
        self.bridge.send(hello(ping.nonce))
        take(self.driver, self.bridge)
        return heard
