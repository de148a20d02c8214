"""The bridge's firmware as a process: what a host sees, and what the driver makes of it."""

from __future__ import annotations

import os
import select
import signal
import struct
import subprocess
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

from graspd.drivers.base import ElectrodeFault, TactileReading
from graspd.drivers.spi.driver import SpiBridgeDriver
from tests.drivers.one_sweep import tactile
from tests.drivers.spi.bridge_c import (
    DIGEST,
    ELECTRODE_COMMANDS,
    START,
    STOP,
    SWEEP,
    StartBridge,
    counts_of,
    frame,
    pattern,
    seq_of,
)

pytestmark = pytest.mark.usefixtures("comes_first")

FINGERS = ("ff", "mf", "th")


def test_a_hello_says_what_the_bridge_is(start_bridge: StartBridge) -> None:
    host = start_bridge(
        "--sensors", 2, "--period-us", 12345, "--board", "left hand", "--serial", "1:XX"
    )
    hello = host.hello(0xCAFE)
    assert struct.unpack_from("<BII", hello) == (1, DIGEST, 0xCAFE)
    tick, tick_hz, firmware, board, *numbers = struct.unpack_from("<QIH16sIBB", hello, 9)
    assert numbers == [12345, 2, 24]
    assert (tick_hz, firmware) == (1_000_000, 0x0002)
    assert tick < 60_000_000
    assert board == b"left hand".ljust(16, b"\0")
    assert hello[45:61] == b"BTSP000000000001"
    assert hello[61:77] == bytes(16)
    assert hello[77:] == ELECTRODE_COMMANDS


def test_sweeps_carry_what_the_sensors_feel(start_bridge: StartBridge) -> None:
    host = start_bridge("--period-us", 3000)
    host.hello()
    host.send(frame(START))
    sweeps = host.next_of(SWEEP, 100)
    assert [seq_of(sweep) for sweep in sweeps] == list(range(100))
    for row, sweep in enumerate(sweeps):
        np.testing.assert_array_equal(counts_of(sweep), pattern(row))
    starts, ends = np.array([struct.unpack_from("<QQ", sweep, 4) for sweep in sweeps]).T
    assert (ends - starts >= 1900).all()
    host.send(frame(STOP), frame(START))
    while seq_of(again := host.next_of(SWEEP)[0]) != 0:
        pass
    np.testing.assert_array_equal(counts_of(again), pattern(0))


def test_a_stream_of_counts_ends_the_bridge_when_it_ends(start_bridge: StartBridge) -> None:
    rows = np.random.default_rng(5).integers(0, 4096, (12, 1, 24))
    lines = "".join(" ".join(map(str, row.ravel())) + "\n" for row in rows)
    host = start_bridge("--counts", "-", "--sensors", 1, "--period-us", 2000, stdin=lines.encode())
    host.hello()
    host.send(frame(START))
    for row, sweep in enumerate(host.next_of(SWEEP, 10)):
        np.testing.assert_array_equal(counts_of(sweep), rows[row])
    assert host.process.stdin is not None
    host.process.stdin.close()  # not earlier: what nobody has read is lost with the terminal
    assert host.process.wait(100) == 0


def test_a_link_leads_to_the_terminal_and_goes_with_the_process(
    start_bridge: StartBridge, tmp_path: Path
) -> None:
    link = tmp_path / "bridge"
    host = start_bridge("--link", link)
    assert os.readlink(link) == host.path
    host.process.send_signal(signal.SIGINT)
    assert host.process.wait(100) == 0
    assert not link.is_symlink()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--sensors", "6"), "--sensors: 6 is not a number in 1..5"),
        (("--dead", "0:25"), "--dead: 25 is not a number in 1..24"),
        (("--sequence", "16"), "does not run"),
        (("--sequence", ""), "does not run"),
        (("--period-us", "-1"), "--period-us: -1 is not a number"),
        (("--counts",), "--counts needs a value"),
        (("--colour", "red"), "no such option: --colour"),
    ],
)
def test_a_wrong_option_is_refused(
    bridge_program: Path, options: Sequence[str], message: str
) -> None:
    done = subprocess.run([bridge_program, *options], capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert message in done.stderr


def read(port: object, count: int, timeout_s: float = 20.0) -> list[TactileReading]:
    """The first readings of three fingers, of a driver that is served as the daemon does."""
    readings: list[TactileReading] = []
    end_s = time.monotonic() + timeout_s
    with SpiBridgeDriver(str(port), FINGERS) as driver:
        while len(readings) < count:
            assert time.monotonic() < end_s, f"{len(readings)} readings, {driver.counters}"
            due_ns, descriptor = driver.due_ns(), driver.fileno()
            wait_s = 0.1 if due_ns is None else (due_ns - time.monotonic_ns()) / 1e9
            descriptors = [] if descriptor is None else [descriptor]
            select.select(descriptors, [], [], min(max(wait_s, 0.0), 0.1))
            readings += tactile(driver.read_ready())
        assert driver.counters.missed_readings == 0
        assert driver.counters.bad_crc + driver.counters.bad_cobs == 0
    return readings[:count]


def test_the_driver_flags_what_is_wrong_with_a_sensor(start_bridge: StartBridge) -> None:
    host = start_bridge(
        *("--unplug", 1, "--dead", "0:8", "--period-us", 4000),
        *("--answer", "2:5:A52D", "--answer", "2:6:A558", "--answer", "2:24:A259"),
    )
    expected = np.zeros((3, 24), dtype=np.uint8)
    expected[1] = ElectrodeFault.MISSING
    expected[2, [4, 5]] = ElectrodeFault.ERROR_WORD
    expected[2, 23] = ElectrodeFault.PARITY
    for row, reading in enumerate(read(host.path, 20)):
        np.testing.assert_array_equal(reading.faults, expected)
        assert reading.counts[0, 7] == 0
        sound = expected == 0
        sound[0, 7] = False
        np.testing.assert_array_equal(reading.counts[sound], pattern(row)[sound])
