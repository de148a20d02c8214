"""The daemon's driver and judgement on the emulated board, with emulated time as their clock."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import chain, islice
from pathlib import Path

import numpy as np
import pytest

from graspd.drivers.base import TactileReading
from graspd.drivers.link import LinkState
from graspd.drivers.recordings.csv_player import DEMO_RECORDING
from graspd.drivers.twins.grasps.grasps import Counts, recorded_counts
from tests.drivers.spi.bridge_c import pattern
from tests.emulated.board import Board
from tests.emulated.conftest import Image
from tests.emulated.lockstep import EPOCH_NS, FINGERS, LockStep
from tests.process_replay.verdicts import judged

PERIOD_NS = 10_000_000
SWEEPS = 2000
"""Twenty seconds at 100 Hz, with grasps that are stable, that slip and that are refused."""
READINGS_APART = 3
P_SLIP_APART = 0.02
"""What a few readings more or less make of the probability; 0.003 is measured."""
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


@pytest.fixture
def linked(image: Image, board: Board, tmp_path: Path) -> Iterator[LockStep]:
    """The driver on a board that sweeps."""
    board.power(image())
    link = LockStep(board, tmp_path / "port")
    link.open()
    link.serve(LINKED_MS, lambda: len(link.readings) > 0)
    yield link
    link.close()


def test_twenty_seconds_are_judged_as_exact_ones(
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
    assert (counters.missed_readings, counters.clock_faults) == (0, 0)
    assert (counters.bad_crc, counters.bad_cobs, counters.stale_sweeps) == (0, 0, 0)
    assert (counters.bridge_overruns, counters.bridge_tx_dropped) == (0, 0)
    assert counters.link_losses == counters.unanswered_pings == 0

    # The board's times differ from exact ones by microseconds: the moment of a judgement may be
    # that of the reading before or after.
    sound = np.zeros((len(FINGERS), 24), dtype=np.uint8)
    exact = [
        TactileReading(EPOCH_NS + number * PERIOD_NS, number, row, sound)
        for number, row in enumerate(rows[:SWEEPS])
    ]
    expected = grasp_verdicts(exact)
    found = grasp_verdicts(link.readings)
    assert {verdict for _, verdict, _ in found} == {"stable", "slip", "unknown"}
    assert [verdict for _, verdict, _ in found] == [verdict for _, verdict, _ in expected]
    for (at, _, p_slip), (exact_at, _, exact_p_slip) in zip(found, expected, strict=True):
        assert abs(at - exact_at) <= READINGS_APART
        assert p_slip == pytest.approx(exact_p_slip, abs=P_SLIP_APART)


def grasp_verdicts(readings: Sequence[TactileReading]) -> list[tuple[int, str, float | None]]:
    """Return reading, verdict and probability of slip of each judged grasp."""
    found, at = [], 0
    for entry in judged(iter(readings), joints=False):
        if entry["judged"]:
            found.append((at, entry["verdict"], entry.get("p_slip")))
        at += entry["n"]
    return found


@pytest.mark.parametrize("loss", ["unplug", "detach", "stick"])
def test_a_link_that_comes_back_mixes_no_reading(linked: LockStep, loss: str) -> None:
    """Power that goes, a cable that is pulled, a firmware that hangs until its watchdog bites."""
    board = linked.board
    linked.serve(500.0)
    before = linked.readings[-1]
    board.cut(loss)
    linked.serve(1500.0)
    assert linked.driver.conversation.link.state is not LinkState.UP or loss == "stick"
    if loss != "stick":
        board.do({"unplug": "plug", "detach": "attach"}[loss])
    linked.serve(6000.0, lambda: linked.readings[-1].seq >= before.seq + 100)
    counters = linked.driver.counters
    assert linked.driver.conversation.link.state is LinkState.UP
    assert counters.link_losses == 1
    assert counters.clock_faults == 0
    assert not any(reading.faults.any() for reading in linked.readings)
    seqs, times = zip(*((reading.seq, reading.t_ns) for reading in linked.readings), strict=True)
    assert list(seqs) == sorted(set(seqs))
    assert list(times) == sorted(times)
    counts = [reading.counts for reading in linked.readings[-100:]]
    first = next(row for row in range(400) if (pattern(row) == counts[0]).all())
    assert all((pattern(first + n) == one).all() for n, one in enumerate(counts))
    assert board.do("state")["resets"] == (1 if loss == "stick" else 0)
