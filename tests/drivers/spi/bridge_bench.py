"""The other end of a serial bridge for tests: by hand message by message, or the twin at work."""

from __future__ import annotations

import dataclasses
import os
import random
import select
import time
import tty
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray

from drivers.base import TactileReading
from drivers.biotac import SEQUENCE_ELECTRODES, encode_word, sample_command
from drivers.link import LinkState
from drivers.spi.driver import SpiBridgeDriver
from drivers.spi.messages import DIGEST, FrameParser, Hello, Message, Ping, Sweep, decode, encode
from drivers.twins.spi import SpiTwin
from tests.kit.clock import Clock

MS = 1_000_000
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
        """What the host said, up to a message of the given type."""
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
    channels: Sequence[int] = SEQUENCE_ELECTRODES,
    sensors: int = 3,
    tick_hz: int = 1_000_000,
) -> Hello:
    commands = tuple(sample_command(channel) for channel in channels)
    return Hello(nonce, tick, tick_hz, tick_hz // 100, ("BTSP-1",) * sensors, commands, board="b")


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


def take(driver: SpiBridgeDriver, bridge: ScriptedBridge) -> list[TactileReading]:
    """All readings of what the bridge has sent; returns early when the driver gives up."""
    readings: list[TactileReading] = []
    deadline = time.monotonic() + PATIENCE_S
    while driver.counters.bytes < bridge.sent_bytes and driver.link_state is not LinkState.WAITING:
        assert time.monotonic() < deadline, f"{driver.counters} of {bridge.sent_bytes} bytes"
        descriptor = driver.fileno()
        assert descriptor is not None
        select.select([descriptor], [], [], 0.1)
        readings += [r for r in driver.read_ready() if isinstance(r, TactileReading)]
    return readings


def greeted(
    driver: SpiBridgeDriver, bridge: ScriptedBridge, answer: Callable[[int], Message] = hello
) -> list[Message]:
    """Open the driver and answer its PINGs; what it had said until the first."""
    driver.open()
    said = heard = bridge.heard(Ping)
    for _ in range(2):  # the serial numbers are believed when they are told again
        (ping,) = (message for message in heard if isinstance(message, Ping))
        bridge.send(answer(ping.nonce))
        take(driver, bridge)
        if driver.link_state is LinkState.WAITING or driver.conversation.hello is not None:
            break
        heard = bridge.heard(Ping)
    return said


@dataclass(frozen=True)
class Rig:
    bridge: ScriptedBridge
    driver: SpiBridgeDriver
    clock: Clock

    def greet(self, answer: Hello | None = None) -> list[Message]:
        """Bring the driver so far that it has sent START."""

        def answered(nonce: int) -> Message:
            return dataclasses.replace(answer or hello(0), nonce=nonce)

        return greeted(self.driver, self.bridge, answered)

    def wait(self, ms: float) -> None:
        self.clock.now_ns += round(ms * MS)
        assert self.driver.read_ready() == []


def run(
    twin: SpiTwin, driver: SpiBridgeDriver, done: Callable[[list[TactileReading]], bool]
) -> list[TactileReading]:
    """Both in turns, in real time, until `done` with the readings so far."""
    readings: list[TactileReading] = []
    deadline = time.monotonic() + PATIENCE_S
    while not done(readings):
        assert time.monotonic() < deadline, f"{len(readings)} readings; {driver.counters}"
        twin.run_once()
        due_ns = driver.due_ns()
        if (due_ns is not None and time.monotonic_ns() >= due_ns) or is_readable(driver):
            readings += [r for r in driver.read_ready() if isinstance(r, TactileReading)]
        else:
            time.sleep(0.0002)
    return readings


def replug_times_s(
    twin: SpiTwin, driver: SpiBridgeDriver, times: int, rng: random.Random
) -> list[float]:
    """Unplug for up to 0.3 s and plug in again; s from each plugging in to the next reading."""
    run(twin, driver, lambda readings: len(readings) >= 3)
    times_s = []
    for _ in range(times):
        twin.unplug()
        plug_s = time.monotonic() + rng.uniform(0.0, 0.3)
        while driver.link_state is not LinkState.WAITING or time.monotonic() < plug_s:
            driver.read_ready()
            time.sleep(0.001)
        twin.plug()
        plug_s = time.monotonic()
        run(twin, driver, lambda readings: len(readings) > 0)
        times_s.append(time.monotonic() - plug_s)
    return times_s


def is_readable(driver: SpiBridgeDriver) -> bool:
    descriptor = driver.fileno()
    return descriptor is not None and bool(select.select([descriptor], [], [], 0)[0])
