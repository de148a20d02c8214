"""Serial links, ours and python-can's, work again after a loss while 2,000 files are open."""

from __future__ import annotations

import contextlib
import itertools
import os
import pty
import tty
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import pytest

from graspd.drivers.base import Driver, Reading
from graspd.drivers.can.driver import CanBridgeDriver
from graspd.drivers.spi.driver import SpiBridgeDriver
from graspd.drivers.twins.can import SAMPLE_ID
from graspd.drivers.twins.spi import SpiTwin
from tests.drivers.can.can_standin import sweep_of_frames
from tests.drivers.one_sweep import sweeps_of
from tests.kit.crowd import SELECT_MAX, crowded
from tests.kit.waiting import wait_until

FINGERS = ("ff", "mf", "th")


class Bench(NamedTuple):
    """An open driver, a sender of a little data, and ways to unplug the device and plug it in."""

    driver: Driver
    send: Callable[[], object]
    unplug: Callable[[], object]
    plug: Callable[[], object]


@contextlib.contextmanager
def spi(folder: Path) -> Iterator[Bench]:
    with (
        SpiTwin(folder / "port", itertools.cycle(sweeps_of(50))) as twin,
        SpiBridgeDriver(str(folder / "port"), FINGERS) as driver,
    ):
        yield Bench(driver, lambda: twin.run_once(0.001), twin.unplug, twin.plug)


@contextlib.contextmanager
def slcan(folder: Path) -> Iterator[Bench]:
    path, ends = folder / "adapter", list[int]()

    def unplug() -> None:
        path.unlink(missing_ok=True)  # the kernel gives the terminal's name to others at once
        while ends:
            os.close(ends.pop())

    def plug() -> None:
        ends.extend(pty.openpty())
        tty.setraw(ends[1])
        path.symlink_to(os.ttyname(ends[1]))

    def send() -> None:
        for frame in sweep_of_frames(0):
            line = f"t{frame.arbitration_id:03X}7{frame.data.hex().upper()}\r"
            os.write(ends[0], line.encode())

    plug()
    with CanBridgeDriver("slcan", str(path), arbitration_id=SAMPLE_ID, sequence="electrodes") as it:
        yield Bench(it, send, unplug, plug)
    unplug()


@pytest.mark.parametrize("bench", [spi, slcan], ids=lambda bench: bench.__name__)
def test_a_driver_reconnects_on_a_descriptor_above_1024(
    bench: Callable[[Path], contextlib.AbstractContextManager[Bench]], tmp_path: Path
) -> None:
    with bench(tmp_path) as (driver, send, unplug, plug):
        descriptors: list[int] = []

        def reads() -> Sequence[Reading]:
            send()
            for _ in range(2):
                if (descriptor := driver.fileno()) is not None:
                    descriptors.append(descriptor)
                if readings := driver.read_ready():
                    return readings
            return ()

        wait_until(reads)
        assert max(descriptors, default=0) < SELECT_MAX
        unplug()
        while driver.fileno() is not None:
            driver.read_ready()
        with crowded():
            plug()
            wait_until(lambda: reads() and max(descriptors) >= SELECT_MAX)
            driver.close()
