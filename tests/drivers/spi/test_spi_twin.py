"""Driver and twin over a real pseudo-terminal: count for count, fault by fault, plug by plug."""

from __future__ import annotations

import itertools
import time
import zlib
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from cobs import cobs

from graspd.drivers.base import TactileReading
from graspd.drivers.spi.driver import SpiBridgeDriver
from graspd.drivers.spi.messages import DIGEST
from graspd.drivers.twins.faults import LinkFaults
from graspd.drivers.twins.grasps.grasps import Counts
from graspd.drivers.twins.spi import SpiTwin
from tests.drivers.one_sweep import tactile
from tests.drivers.spi.bridge_bench import FINGERS, run
from tests.drivers.twins.signals import GeneratedContact
from tests.kit.clock import Clock

SWEEPS = 600
RATE_HZ = 10_000.0


def generated(sweeps: int = SWEEPS, seed: int = 3) -> list[Counts]:
    return list(itertools.islice(GeneratedContact(len(FINGERS), seed=seed), sweeps))


def together(
    folder: Path, rows: list[Counts], faults: LinkFaults
) -> tuple[SpiTwin, SpiBridgeDriver, list[TactileReading], bytes]:
    """All rows through twin and driver, each when the one before is read, and the wire's bytes."""
    wire, clock = bytearray(), Clock()
    readings: list[TactileReading] = []
    path = folder / "bridge"
    twin = SpiTwin(path, rows, rate_hz=RATE_HZ, faults=faults, tap=wire.extend, clock=clock)
    driver = SpiBridgeDriver(str(path), FINGERS, clock=clock)
    with twin:
        wire.clear()  # what is on the line before it is opened is thrown away
        with driver:
            while not twin.exhausted or driver.counters.bytes < len(wire):
                if driver.counters.bytes >= len(wire):
                    clock.now_ns += round(1e9 / RATE_HZ)
                    twin.run_once()
                readings += tactile(driver.read_ready())
            readings += tactile(driver.read_ready())
    return twin, driver, readings, bytes(wire)


def damaged_pieces(wire: bytes) -> int:
    """How many pieces between zeros are no frames, by a decoder of this test's own."""
    damaged = 0
    for piece in wire.split(b"\0")[:-1]:
        if not piece:
            continue
        try:
            decoded = cobs.decode(piece)
        except cobs.DecodeError:
            damaged += 1
            continue
        seed = 0 if decoded[:1] == b"\x01" else DIGEST
        crc = zlib.crc32(decoded[:-4], seed).to_bytes(4, "little")
        damaged += len(decoded) < 5 or crc != decoded[-4:]
    return damaged


LOSING = {"bit_flip_probability", "drop_probability", "reorder_probability"}


@pytest.mark.parametrize(
    "faults",
    [
        {},
        {"bit_flip_probability": 0.3},
        {"drop_probability": 0.2},
        {"duplicate_probability": 0.2},
        {"reorder_probability": 0.2},
        {"one_byte_at_a_time": True},
        {"burst_frames": 7},
        {
            "bit_flip_probability": 0.05,
            "drop_probability": 0.1,
            "duplicate_probability": 0.1,
            "reorder_probability": 0.1,
            "burst_frames": 3,
        },
    ],
    ids=lambda faults: "+".join(faults) or "none",
)
def test_faults_are_counted_one_by_one_and_no_reading_is_invented(
    tmp_path: Path, faults: dict[str, float]
) -> None:
    rows = generated()
    twin, driver, readings, wire = together(tmp_path, rows, LinkFaults(seed=1, **faults))  # type: ignore[arg-type]
    counters, injected = driver.counters, twin.injected_in_sweeps
    for reading in readings:  # the number of a reading is that of the sweep it was made from
        assert np.array_equal(reading.counts, rows[reading.seq]), reading.seq
        assert not reading.faults.any()
    seqs = [reading.seq for reading in readings]
    assert seqs == sorted(set(seqs))
    lost_at_end = SWEEPS - 1 - seqs[-1]
    assert counters.readings + counters.missed_readings + lost_at_end == twin.sweeps_made == SWEEPS
    assert counters.bad_cobs + counters.bad_crc + counters.too_long == damaged_pieces(wire)
    lost = counters.missed_readings + lost_at_end
    if len(faults) == 1:
        flips, drops = injected["bit_flip"], injected["drop"]
        # A flipped delimiter joins two frames: both are lost.
        assert drops + flips <= lost - counters.reordered <= drops + 2 * flips
        assert counters.duplicates == injected["duplicate"]
        assert abs(injected["reorder"] - counters.reordered) <= 1  # the last may stay behind
    if not set(faults) & LOSING:
        assert lost == 0
        assert counters.clock_faults == counters.clock_fallbacks == 0


def test_a_link_that_breaks_in_the_middle_of_a_frame_comes_back(tmp_path: Path) -> None:
    faults = LinkFaults(disconnect_every_frames=40)
    rows = generated(100_000 // 24)
    twin = SpiTwin(tmp_path / "b", rows, rate_hz=1000.0, faults=faults)
    began_s = time.monotonic()
    with twin, SpiBridgeDriver(str(tmp_path / "b"), FINGERS) as driver:
        readings = run(twin, driver, lambda _: driver.counters.link_losses >= 6)
        assert time.monotonic() - began_s < 6 * 2.0, "it is back within two seconds"
        # The twin may break the link again before the driver notices.
        assert driver.counters.link_losses <= twin.injected["disconnect"] <= 7
    made = {row.tobytes() for row in rows[: twin.sweeps_made]}
    assert len(readings) > 150
    assert all(reading.counts.tobytes() in made for reading in readings)
    seqs = [reading.seq for reading in readings]
    assert seqs == sorted(set(seqs))


def test_a_link_that_leads_somewhere_is_left_alone_and_one_that_leads_nowhere_is_not(
    tmp_path: Path,
) -> None:
    path = tmp_path / "bridge"
    path.symlink_to("/dev/pts/of-a-twin-that-was-killed")
    with SpiTwin(path, generated(1)) as first:
        terminal = path.readlink()
        second = SpiTwin(path, generated(1))
        with pytest.raises(FileExistsError, match=f"leads to {terminal}; .* another twin"):
            second.open()
        second.close()
        assert path.readlink() == terminal
        first.plug()
        assert path.exists()
    assert not path.is_symlink()


def test_a_source_without_counts_and_a_rate_of_nothing_are_refused(tmp_path: Path) -> None:
    empty: Iterator[Counts] = iter(())
    with pytest.raises(ValueError, match="no counts"):
        SpiTwin(tmp_path / "b", empty)
    with pytest.raises(ValueError, match="rate_hz"):
        SpiTwin(tmp_path / "b", generated(1), rate_hz=0.0)
