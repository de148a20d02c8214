"""The bridge's port to an STM32F405, in QEMU: byte for byte what the port to a PC says.

QEMU's chip has the core and its timer, a USART, and an SPI with nothing on it; clocks, pins and
baud rate it has not. So there are two images: the chip's own, whose sensors are all absent, and one
in which `stm32_sensors.c` takes the place of its `spi.c`.
"""

from __future__ import annotations

import random
import re
import shutil
import socket
import struct
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from graspd.drivers.base import TactileReading
from graspd.drivers.spi.driver import SpiBridgeDriver
from tests.drivers.spi.bridge_c import (
    BRIDGE,
    HELLO,
    PING,
    START,
    STATUS,
    Host,
    StartBridge,
    counts_of,
    frame,
    judged,
    pattern,
)

NEEDED = ("make", "arm-none-eabi-gcc", "qemu-system-arm")
PERIOD_US, SENSORS, SLOTS = 10_000, 3, 24
WAITS_US = SLOTS * (50 + SENSORS * 5)
"""What a sweep waits at least, by PROTOCOL.md."""
HELD = 200
"""Bytes sent at once: the port holds 256 that the core has not taken yet."""
ID_AT = "-Wl,--defsym=device_id=0x08000000"
"""QEMU's chip has no unique id, so the images show their own first bytes as one."""
FINGERS = ("ff", "mf", "th")
PATIENCE_S = 20.0


def make_image(folder: Path, *variables: str) -> Path:
    """An image and the same as ELF; skips the test where it cannot be made or run."""
    missing = [name for name in NEEDED if shutil.which(name) is None]
    if not missing:
        asked = ["arm-none-eabi-gcc", "-print-file-name=nano.specs"]
        found = subprocess.run(asked, capture_output=True, text=True, check=True).stdout
        missing = [] if "/" in found else ["newlib for arm-none-eabi-gcc"]
    if missing:
        pytest.skip(f"no {', '.join(missing)}, for the emulated STM32")
    make = ["make", "-C", str(BRIDGE / "stm32"), f"BUILD={folder}", *variables]
    done = subprocess.run(make, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    return folder / "graspd-bridge.bin"


@pytest.fixture(scope="module")
def chip_image(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What is written to a chip."""
    return make_image(tmp_path_factory.mktemp("chip"), f"EMULATED={ID_AT}")


@pytest.fixture(scope="module")
def sensors_image(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same with simulated sensors in it."""
    return make_image(
        tmp_path_factory.mktemp("sensors"),
        f"SENSORS={Path(__file__).with_name('stm32_sensors.c')} ../host/sim_sensor.c",
        f"EMULATED={ID_AT} -D_XOPEN_SOURCE=700 -I../host --specs=nosys.specs",
    )


def qemu(image: Path, *options: str) -> list[str]:
    machine = ["qemu-system-arm", "-machine", "netduinoplus2", "-nodefaults", "-display", "none"]
    return [
        *machine,
        "-kernel",
        str(image.with_suffix(".elf")),
        "-serial",
        "chardev:line",
        *options,
    ]


@contextmanager
def chip(image: Path) -> Iterator[Host]:
    """A chip whose time is counted in instructions, 8 ns each: no stall of this computer shows."""
    ours, theirs = socket.socketpair()
    with theirs:
        line = theirs.fileno()
        options = ("-chardev", f"socket,id=line,fd={line}", "-icount", "shift=3,sleep=off")
        process = subprocess.Popen(qemu(image, *options), pass_fds=[line])
    host = Host(process, "", ours.detach())
    try:
        yield host
    finally:
        host.stop()


def board_of(image: Path) -> str:
    return image.read_bytes()[:8].hex().upper()


def said(host: Host, count: int) -> tuple[bytes, list[bytes]]:
    """The HELLO of a greeting and the first sweeps."""
    return host.hello(nonce=0x12345678), host.first_sweeps(count)


def without_ticks(hello: bytes, sweeps: list[bytes]) -> list[bytes]:
    return [hello[:9] + hello[17:], *(one[:4] + one[20:] for one in sweeps)]


def status_of(host: Host) -> tuple[int, ...]:
    """Sweeps, overruns, tx_dropped, rx_errors, and spi_errors of each sensor."""
    (payload,) = host.next_of(STATUS)
    counters = struct.unpack("<QIIIIB3I", payload)
    return (*counters[1:5], *counters[6:])


def test_the_chip_with_sensors_says_what_the_pc_says(
    sensors_image: Path, start_bridge: StartBridge
) -> None:
    count = 200
    theirs = start_bridge("--board", board_of(sensors_image))
    with chip(sensors_image) as ours:
        (of_reset,) = ours.next_of(HELLO)
        hello, sweeps = said(ours, count)
        assert without_ticks(hello, sweeps) == without_ticks(*said(theirs, count))
        made, *others = status_of(ours)
    assert of_reset[:9] == hello[:5] + bytes(4)
    assert of_reset[17:] == hello[17:]
    assert (counts_of(sweeps[-1]) == pattern(count - 1)).all()
    assert made >= count
    assert others == [0] * 6
    ticks = np.array([struct.unpack_from("<QQ", one, 4) for one in sweeps], dtype=np.int64)
    assert (abs(np.diff(ticks[:, 0]) - PERIOD_US) <= 20).all()
    assert (ticks[:, 1] - ticks[:, 0] >= WAITS_US).all()


def test_the_image_for_the_chip_finds_no_sensor_on_an_empty_bus(
    chip_image: Path, start_bridge: StartBridge
) -> None:
    nobody = ["--board", board_of(chip_image)]
    for sensor in range(SENSORS):
        nobody += ["--serial", f"{sensor}:none"]
        for electrode in range(1, SLOTS + 1):
            nobody += ["--answer", f"{sensor}:{electrode}:0000"]
    theirs = start_bridge(*nobody)
    with chip(chip_image) as ours:
        ours.next_of(HELLO)  # what is said to a chip before that is lost
        found = without_ticks(*said(ours, 20))
        assert found == without_ticks(*said(theirs, 20))
        sweeps, *others = status_of(ours)
    assert found[-1].endswith(bytes([0, SENSORS, SLOTS]) + bytes(2 * SENSORS * SLOTS))
    assert others == [0, 0, 0] + [sweeps * SLOTS] * SENSORS


def test_damaged_bytes_from_the_host_are_counted_and_do_no_harm(sensors_image: Path) -> None:
    seed = 20251122
    rng = random.Random(seed)
    stream = b""
    with chip(sensors_image) as host:
        host.next_of(HELLO)
        for nonce in range(1, 61):
            piece = b""
            while len(piece) < HELD - 20:
                whole = bytearray(frame(rng.choice((PING, START)), rng.randbytes(4)))
                whole[rng.randrange(len(whole))] ^= 1 << rng.randrange(8)
                piece += rng.choice((bytes(whole), rng.randbytes(rng.randrange(1, 9))))
            piece = piece[: HELD - 20] + b"\0" + frame(PING, struct.pack("<I", nonce))
            host.send(piece)
            stream += piece
            while host.next_of(HELLO)[0][5:9] != struct.pack("<I", nonce):
                pass
        found, errors = judged(stream)
        assert len([one for one in found if one.startswith("81 ")]) == 60, seed
        host.next_of(STATUS)
        assert status_of(host) == (0, 0, 0, errors, 0, 0, 0), seed
    assert errors > 500, seed


def test_the_driver_reads_the_chip_in_real_time(sensors_image: Path) -> None:
    process = subprocess.Popen(
        qemu(sensors_image, "-chardev", "pty,id=line"), stdout=subprocess.PIPE, text=True
    )
    assert process.stdout is not None
    readings: list[TactileReading] = []
    try:
        with process.stdout:
            port = re.findall(r"/dev/\S+", process.stdout.readline())[0]
        end_s = time.monotonic() + PATIENCE_S
        with SpiBridgeDriver(port, FINGERS) as driver:
            while len(readings) < 200 or driver.describe()["clock"].text != "trusted":
                assert time.monotonic() < end_s, driver.describe()
                readings += [r for r in driver.read_ready() if isinstance(r, TactileReading)]
                time.sleep(0.002)
            assert driver.describe()["board"].text == board_of(sensors_image)
            assert driver.serials == {f: f"BTSP{i:012}" for i, f in enumerate(FINGERS, 1)}
    finally:
        process.terminate()
        assert process.wait(10) == 0
    for reading in readings:
        row = next(k for k in range(4096) if (1000 + 7 * k) % 4096 == reading.counts[0, 0])
        assert not reading.faults.any()
        assert (reading.counts == pattern(row)).all()
