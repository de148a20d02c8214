"""The bridge's firmware, in C: against the manual and Python's own tools, and as a process."""

from __future__ import annotations

import random
import re
import shutil
import struct
import subprocess
import time
import zlib
from pathlib import Path

import pytest

from graspd.drivers.base import TactileReading
from graspd.drivers.biotac import ERROR_WORDS
from graspd.drivers.spi.driver import SpiBridgeDriver
from graspd.drivers.spi.messages import FIRMWARE
from tests.drivers.one_sweep import tactile
from tests.drivers.spi.bridge_c import (
    BRIDGE,
    DIGEST,
    ELECTRODE_COMMANDS,
    HELLO,
    PAC,
    PDC,
    PING,
    SANITIZERS,
    STATUS,
    SWEEP,
    TAC,
    TDC,
    ask,
    build_program,
    damaged,
    frame,
    judged,
    pattern,
)
from tests.kit.programs import ran
from tests.kit.waiting import wait_until

pytestmark = pytest.mark.usefixtures("comes_first")


@pytest.fixture(scope="module")
def bridge_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder in which programs are built; skips without a C compiler that has sanitizers."""
    if shutil.which("cc") is None:
        pytest.skip("no C compiler (cc)")
    folder = tmp_path_factory.mktemp("bridge")
    (folder / "empty.c").write_text("int main(void) { return 0; }\n")
    if ran("cc", *SANITIZERS, folder / "empty.c", "-o", folder / "empty").returncode != 0:
        pytest.skip("the C compiler has no address and undefined behaviour sanitizers")
    return folder


@pytest.fixture(scope="module")
def bridge_probe(bridge_folder: Path) -> Path:
    """Program of the C implementation that answers the questions of `ask`."""
    core = ("src/biotac.c", "src/cobs.c", "src/crc32.c", "src/protocol.c")
    return build_program(bridge_folder, "probe", "test/probe.c", *core)


@pytest.fixture(scope="module")
def bridge_program(bridge_folder: Path) -> Path:
    """The bridge as a program of this computer."""
    return build_program(bridge_folder, "graspd-bridge", "src/*.c", "host/*.c")


def test_the_firmware_passes_its_own_tests(bridge_folder: Path) -> None:
    sources = ("test/test_bridge.c", "host/sim_sensor.c", "src/*.c")
    done = ran(build_program(bridge_folder, "test_bridge", *sources))
    assert done.returncode == 0, done.stdout + done.stderr
    names = re.findall(r"TEST\((\w+)\),", (BRIDGE / "test" / "test_bridge.c").read_text())
    assert done.stdout.splitlines() == [f"ok {name}" for name in names]


def test_the_digest_is_that_of_the_documented_schema() -> None:
    schema = (BRIDGE / "PROTOCOL.md").read_text().split("-" * 72 + "\n")[1]
    assert zlib.crc32(schema.encode("ascii")) == DIGEST
    header = (BRIDGE / "src" / "protocol.h").read_text()
    assert re.findall(r"PROTOCOL_DIGEST 0x(\w+)u", header) == [f"{DIGEST:08X}"]


def test_the_drivers_firmware_version_is_that_of_the_shipped_source() -> None:
    header = (BRIDGE / "src" / "bridge.h").read_text()
    (made,) = re.findall(r"BRIDGE_FIRMWARE = 0x(\w+),", header)
    assert int(made, 16) == FIRMWARE


def test_the_core_needs_no_heap_and_no_floating_point() -> None:
    for source in sorted((BRIDGE / "src").glob("*.[ch]")):
        code = re.sub(r"/\*.*?\*/", "", source.read_text(), flags=re.DOTALL)
        assert not re.search(r"\b(malloc|calloc|realloc|free|alloca|float|double)\b", code), source


def test_commands_are_those_of_the_manual(bridge_probe: Path) -> None:
    commands = bytes.fromhex(ask(bridge_probe, ["tables"])[0].split()[0])
    expected = bytes([PAC, PDC, TAC, TDC]) + bytes(13) + ELECTRODE_COMMANDS + bytes(256 - 41)
    assert commands == expected
    assert 0xA1 not in commands


def test_sequences_are_those_of_the_manual(bridge_probe: Path) -> None:
    electrodes, every, interleaved = map(
        bytes.fromhex, ask(bridge_probe, ["sequence 0", "sequence 1", "sequence 2"])
    )
    assert electrodes == ELECTRODE_COMMANDS
    assert every == bytes([PAC, PDC, TAC, TDC]) + ELECTRODE_COMMANDS
    others = ELECTRODE_COMMANDS + bytes([PDC, TAC, TDC])
    assert interleaved == b"".join(bytes([other, PAC]) for other in others)


def test_exactly_the_4096_response_words_are_sound(bridge_probe: Path) -> None:
    told = ask(bridge_probe, ["tables"])[0].split()[1]
    sound = {word for word in range(1 << 16) if told[word] == "1"}
    expected = set()
    for count in range(4096):
        high, low = count >> 5 << 1, (count & 31) << 3
        high += bin(high).count("1") % 2 == 0
        low += bin(low).count("1") % 2 == 0
        expected.add(high << 8 | low)
    assert sound == expected
    golden = "0101 0108 01F8 0201 4C91 7FF8 8001 A251 AEF8 C1D9 FEF8"
    assert {int(word, 16) for word in golden.split()} <= sound
    assert not sound & {*ERROR_WORDS, 0x0000, 0xFFFF}


def test_every_frame_agrees_with_an_independent_computation(bridge_probe: Path) -> None:
    rng = random.Random(3)
    requests, expected = [], []
    for _ in range(200):
        sensors, slots = rng.randint(1, 5), rng.choice((1, 24, 28, 54, 64))
        nonce, period, seq = (rng.choice((0, 1, rng.getrandbits(32))) for _ in range(3))
        start, end = rng.choice((0, rng.getrandbits(64))), rng.getrandbits(64)
        firmware, present = rng.getrandbits(16), rng.getrandbits(sensors)
        board, serials = rng.randbytes(16), rng.randbytes(16 * sensors)
        commands, words = rng.randbytes(slots), rng.randbytes(2 * slots * sensors)
        counters = [rng.getrandbits(32) for _ in range(4 + sensors)]
        requests += [
            f"hello {nonce} {start} 1000000 {firmware} {board.hex()} {period} {sensors} {slots} "
            f"{serials.hex()} {commands.hex()}",
            f"sweep {seq} {start} {end} {present} {sensors} {slots} {words.hex()}",
            f"status {end} {' '.join(map(str, counters[:4]))} {sensors} "
            f"{' '.join(map(str, counters[4:]))}",
        ]
        hello = struct.pack("<BIIQIH", 1, DIGEST, nonce, start, 1000000, firmware) + board
        hello += struct.pack("<IBB", period, sensors, slots) + serials + commands
        sweep = struct.pack("<IQQBBB", seq, start, end, present, sensors, slots) + words
        status = struct.pack(f"<QIIIIB{sensors}I", end, *counters[:4], sensors, *counters[4:])
        expected += [frame(HELLO, hello), frame(SWEEP, sweep), frame(STATUS, status)]
    assert ask(bridge_probe, requests) == [one.hex() for one in expected]
    assert max(map(len, expected)) <= 672


def test_sound_frames_are_found_among_100000_damaged_and_errors_counted(
    bridge_probe: Path,
) -> None:
    seed = 20251121
    rng = random.Random(seed)
    stream, nonces = bytearray(), []
    for nonce in range(1000):
        for _ in range(100):
            stream += damaged(rng)
        stream += b"\0" + frame(PING, struct.pack("<I", 0xA0000000 + nonce))
        nonces.append(f"81 {0xA0000000 + nonce}")
    done = subprocess.run([bridge_probe, "receive"], input=stream, capture_output=True, check=False)
    assert done.returncode == 0, (seed, done.stderr.decode())
    *lines, last = done.stdout.decode().splitlines()
    found, errors = judged(bytes(stream))
    assert lines == found, seed
    assert last == f"errors {errors}", seed
    assert [line for line in lines if line in set(nonces)] == nonces, seed
    assert errors > 50_000


@pytest.mark.parametrize(
    "words",
    [
        "--sensors 2.5",
        "--sensors 3,",
        "--period-us 20000ms",
        "--dead 0:3,4",
        "--answer 0:3:A52DH",
        "--unplug 4 --sensors 3",
        "--serial 0:BTSP-longer-than-sixteen",
    ],
)
def test_the_bridge_refuses_an_option_that_means_nothing(bridge_program: Path, words: str) -> None:
    assert ran(bridge_program, *words.split()).returncode == 2


def test_counts_of_a_file_on_standard_input_end_the_bridge(
    bridge_program: Path, tmp_path: Path
) -> None:
    link, rows = tmp_path / "port", tmp_path / "rows"
    rows.write_text((" ".join(["1000"] * 72) + "\n") * 5)
    with (
        rows.open() as file,
        subprocess.Popen(
            [bridge_program, "--link", link, "--counts", "-"], stdin=file, stdout=subprocess.DEVNULL
        ) as bridge,
    ):
        try:
            wait_until(link.exists)
            with SpiBridgeDriver(str(link), ("ff", "mf", "th")) as driver:
                wait_until(lambda: (driver.read_ready(), bridge.poll())[1] is not None)
        finally:
            bridge.terminate()


def test_the_driver_reads_the_firmware_running_on_a_pc(
    bridge_program: Path, tmp_path: Path
) -> None:
    link = tmp_path / "port"
    readings: list[TactileReading] = []
    with subprocess.Popen([bridge_program, "--link", link], stdout=subprocess.DEVNULL) as bridge:
        try:
            wait_until(link.exists)
            with SpiBridgeDriver(str(link), ("ff", "mf", "th")) as driver:
                while len(readings) < 50:
                    time.sleep(0.001)
                    readings += tactile(driver.read_ready())
        finally:
            bridge.terminate()
    assert bridge.returncode == 0
    for reading in readings:
        assert not reading.faults.any()
        assert (reading.counts == pattern(reading.seq)).all()
