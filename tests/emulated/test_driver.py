"""The daemon's driver and judgement on the emulated board, with emulated time as their clock."""

from __future__ import annotations

import select
from collections.abc import Iterator, Sequence
from itertools import chain, islice
from pathlib import Path

import numpy as np
import pytest

from drivers.base import TactileReading
from drivers.recordings.csv_player import DEMO_RECORDING
from drivers.spi.driver import SpiBridgeDriver
from drivers.spi.line import LineEvent
from drivers.twins.grasps.grasps import Counts, recorded_counts
from drivers.twins.spi import SpiTwin
from tests.drivers.spi.bridge_bench import Clock
from tests.emulated.board import Board
from tests.emulated.conftest import Image
from tests.emulated.lockstep import EPOCH_NS, FINGERS, PATIENCE_S, LockStep
from tests.process_replay import differences, judged

SWEEPS = 6000
"""A minute at 100 Hz."""
LINKED_MS = 1000.0
"""A greeting takes less."""


def grasps() -> list[Counts]:
    """Counts of three fingers, grasp after grasp, shape (3, 24) each."""
    again = chain.from_iterable(recorded_counts(DEMO_RECORDING) for _ in range(3))
    return list(islice(again, SWEEPS + 1000))


def write_counts(path: Path, rows: Sequence[Counts]) -> Path:
    """Counts for the board's five sensors, of which the last two rest."""
    felt = np.zeros((len(rows), 5, 24), dtype=np.uint16)
    felt[:, : len(FINGERS)] = rows
    path.write_text("".join(" ".join(map(str, row.ravel())) + "\n" for row in felt))
    return path


def read_from_a_twin(path: Path, rows: Sequence[Counts]) -> list[TactileReading]:
    """What the driver makes of a twin on this computer, whose time passes as fast as it can."""
    clock = Clock(EPOCH_NS)
    readings: list[TactileReading] = []
    sent: list[int] = []
    said: list[bytes] = []

    def note(event: LineEvent, data: bytes) -> None:
        if event is LineEvent.OPENED:
            sent.clear()  # opening throws away what had come before
        elif event is LineEvent.SENT:
            said.append(data)

    twin = SpiTwin(path, rows, clock=clock, tap=lambda data: sent.append(len(data)))
    driver = SpiBridgeDriver(str(path), FINGERS, clock=clock)
    driver.tap(note)
    with twin, driver:
        while len(readings) < SWEEPS:
            twin.run_once(PATIENCE_S if said else 0.0)
            said.clear()
            readings += [r for r in driver.read_ready() if isinstance(r, TactileReading)]
            while driver.counters.bytes < sum(sent):
                assert select.select([driver.fileno()], [], [], PATIENCE_S)[0]
                readings += [r for r in driver.read_ready() if isinstance(r, TactileReading)]
            if not said:
                due_ns = [due for due in (twin.due_ns(), driver.due_ns()) if due is not None]
                clock.now_ns = max(min(due_ns), clock.now_ns)
    return readings


@pytest.fixture
def linked(image: Image, board: Board, tmp_path: Path) -> Iterator[LockStep]:
    """The driver on a board that sweeps."""
    board.power(image())
    link = LockStep(board, tmp_path / "port")
    link.open()
    link.serve(LINKED_MS, lambda: len(link.readings) > 0)
    yield link
    link.close()


def test_a_minute_is_read_without_loss_and_judged_as_that_of_a_twin(
    image: Image, board: Board, tmp_path: Path
) -> None:
    rows = grasps()
    board.power(image(), write_counts(tmp_path / "counts", rows))
    link = LockStep(board, tmp_path / "port")
    link.open()
    link.serve(LINKED_MS + 10.0 * SWEEPS, lambda: len(link.readings) == SWEEPS)
    counters = link.driver.counters
    link.close()
    assert [reading.seq for reading in link.readings] == list(range(SWEEPS))
    assert not any(reading.faults.any() for reading in link.readings)
    np.testing.assert_array_equal([reading.counts for reading in link.readings], rows[:SWEEPS])
    assert (counters.missed_readings, counters.clock_faults, counters.clock_fallbacks) == (0, 0, 0)
    assert (counters.bad_crc, counters.bad_cobs, counters.stale_sweeps) == (0, 0, 0)
    assert (counters.bridge_overruns, counters.bridge_tx_dropped) == (0, 0)
    assert counters.link_losses == counters.unanswered_pings == 0

    expected = judged(iter(read_from_a_twin(tmp_path / "twin", rows)[:SWEEPS]), joints=False)
    found = judged(iter(link.readings), joints=False)
    assert {entry["verdict"] for entry in found} == {"stable", "slip", "unknown"}
    assert differences(expected, found) == []
