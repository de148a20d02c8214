"""Drivers and twins of every link in one thread and on one clock, as the doctor listens to them.

The hand's own time may pass faster than the link's: `Hand.skip` leaves out what is not sent.
"""

from __future__ import annotations

import contextlib
import itertools
import json
import os
import select
import socket
from collections.abc import Callable, Iterator
from pathlib import Path
from subprocess import CompletedProcess

from graspd.daemon.commands.doctor import examine
from graspd.daemon.doctor.electrodes import ElectrodeStatistics
from graspd.daemon.doctor.finding import Cause, Finding, Level
from graspd.drivers.base import Driver, TactileReading
from graspd.drivers.can.driver import CanBridgeDriver
from graspd.drivers.datagrams.joints import JointStreamDriver
from graspd.drivers.datagrams.tactile import TactileStreamDriver
from graspd.drivers.palm.stream import PalmDriver
from graspd.drivers.spi.driver import SpiBridgeDriver
from graspd.drivers.twins.datagrams import DatagramTwin, JointTwin, PalmTwin, TactileTwin
from graspd.drivers.twins.faults import LinkFaults
from graspd.drivers.twins.grasps.grasps import Counts
from graspd.drivers.twins.grasps.whole_grasps import synthetic_grasps
from graspd.drivers.twins.spi import SpiTwin
from tests.drivers.can.can_standin import StampingTwin, channel
from tests.kit.clock import Clock
from tests.kit.inside import graspd
from tests.kit.scenes import written

MS = 1_000_000
FINGERS = ("ff", "mf", "th")
NO_FAULTS = LinkFaults()
LOOPBACK = "udp://127.0.0.1:0"


class Hand:
    """Counts of whole synthetic grasps, without end, for a twin to send."""

    def __init__(self, rate_hz: float) -> None:
        self._counts = (moment.counts for moment in synthetic_grasps(rate_hz=rate_hz, loop=True))

    def __iter__(self) -> Iterator[Counts]:
        return self._counts

    def skip(self, moments: int) -> None:
        """Leave out this number of moments."""
        next(itertools.islice(self._counts, moments, moments), None)


Step = Callable[[], None]
"""Let one period of a link pass: move its clock, and let the twin send."""
Link = contextlib.AbstractContextManager[tuple[Driver, Step]]


@contextlib.contextmanager
def spi(hand: Hand, folder: Path, faults: LinkFaults = NO_FAULTS) -> Iterator[tuple[Driver, Step]]:
    """A bridge on a pseudo-terminal, at 100 Hz."""
    clock, port = Clock(), folder / "bridge"
    sent: list[bytes] = []
    driver = SpiBridgeDriver(str(port), FINGERS, clock=clock)
    with SpiTwin(port, hand, faults=faults, clock=clock, tap=sent.append) as twin, driver:

        def step() -> None:
            clock.now_ns += 10 * MS
            sent.clear()
            twin.run_once()
            if sent and (line := driver.fileno()) is not None:
                # A busy kernel hands over later what was written to a terminal.
                select.select([line], [], [], 0.05)

        yield driver, step


@contextlib.contextmanager
def can(hand: Hand, _folder: Path, faults: LinkFaults) -> Iterator[tuple[Driver, Step]]:
    """A board on a virtual bus, at 100 Hz."""
    clock, where = Clock(), channel()
    driver = CanBridgeDriver(
        "virtual", where, FINGERS, sequence="electrodes", clock=clock, wall_clock=clock
    )
    twin = StampingTwin(
        "virtual", where, iter(hand), sequence="electrodes", faults=faults, clock=clock
    )
    with driver, twin:

        def step() -> None:
            clock.now_ns += 10 * MS
            twin.send_sweep()

        yield driver, step


@contextlib.contextmanager
def _udp(
    twin: DatagramTwin, driver: PalmDriver | JointStreamDriver | TactileStreamDriver, clock: Clock
) -> Iterator[tuple[Driver, Step]]:
    """A driver that gets a twin's datagrams over UDP; each step sends those of one period."""
    cycles = twin.cycles()
    with driver, socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:

        def step() -> None:
            clock.now_ns += twin.period_ns
            for datagram in next(cycles):
                sender.sendto(datagram, ("127.0.0.1", driver.port or 0))

        yield driver, step


def palm(hand: Hand, _folder: Path, faults: LinkFaults) -> Link:
    """Packets of a palm over UDP, one a millisecond."""
    clock = Clock()
    return _udp(PalmTwin(hand, faults=faults), PalmDriver(LOOPBACK, clock=clock), clock)


def datagrams(hand: Hand, _folder: Path, faults: LinkFaults) -> Link:
    """Counts as JSON over UDP, at 100 Hz."""
    clock = Clock()
    return _udp(TactileTwin(hand, faults=faults), TactileStreamDriver(LOOPBACK, clock=clock), clock)


def joints(_hand: Hand, _folder: Path, faults: LinkFaults) -> Link:
    """Joint angles over UDP, at 100 Hz."""
    clock = Clock()
    return _udp(JointTwin(faults), JointStreamDriver(LOOPBACK, clock=clock), clock)


LINKS: dict[str, Callable[[Hand, Path, LinkFaults], Link]] = {
    "spi": spi,
    "can": can,
    "palm": palm,
    "datagrams": datagrams,
    "joints": joints,
}
STEPS_PER_S = {"spi": 100, "can": 100, "palm": 1000, "datagrams": 100, "joints": 100}


def listen(driver: Driver, step: Step, steps: int, statistics: ElectrodeStatistics) -> None:
    """Let `steps` periods of the link pass; add the tactile readings to `statistics`."""
    for _ in range(steps):
        step()
        for reading in driver.read_ready():
            if isinstance(reading, TactileReading):
                statistics.add(reading)


def faults_told(driver: Driver, statistics: ElectrodeStatistics, seconds: float) -> list[Finding]:
    """Findings of the doctor that are not `OK`, after it listened for `seconds`."""
    felt = None if driver.name == JointStreamDriver.name else statistics
    told = examine(driver, felt, seconds)
    return [finding for finding in told if finding.level is not Level.OK]


SPI = '[tactile]\ndriver = "spi"\nport = "{}"\n'
CAN = '[tactile]\ndriver = "can"\nchannel = "{}"\n'


def refused(number: int) -> Callable[..., object]:
    def open_port(*_: object, **__: object) -> object:
        raise OSError(number, os.strerror(number))

    return open_port


def scene_of(folder: Path, text: str) -> Path:
    """Write a scene of `text`, with a model, a socket and no session unless it has these; return
    its path."""
    if "[model]" not in text:
        text += '[model]\nname = "cnn1"\n'
    if "[publish]" not in text:
        text += f'[publish]\nendpoint = "ipc://{folder}/graspd"\n'
    if "[session]" not in text:
        text += "[session]\nkeep = false\n"
    return written(folder, text)


def asked(folder: Path, text: str, *options: str) -> CompletedProcess[str]:
    """Run `graspd doctor`, with `options`, for 0.6 s on a scene of `text`."""
    return graspd("doctor", scene_of(folder, text), "--listen", 0.6, *options)


def look(folder: Path, text: str) -> list[dict[str, str]]:
    """Return the doctor's findings on the scene `text`, without ok and `slow` (a busy computer)."""
    result = asked(folder, text, "--json")
    told = [f for f in json.loads(result.stdout)["findings"] if f["level"] != "ok"]
    assert result.returncode == int("error" in {finding["level"] for finding in told})
    return [finding for finding in told if finding["cause"] != Cause.SLOW]
