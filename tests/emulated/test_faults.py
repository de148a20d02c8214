"""Sensors, host and port that misbehave: the board counts exactly what was done to it."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from tests.drivers.spi.bridge_c import (
    HELLO,
    SWEEP,
    counts_of,
    pattern,
    seq_of,
)
from tests.emulated.board import Board, serials
from tests.emulated.conftest import Image

PERIOD_MS = 10.0


@pytest.fixture(scope="module")
def powered(image: Image) -> Iterator[Board]:
    """One board for all tests of this file; each begins with `sweeping` and mends what it broke."""
    with Board() as board:
        yield board.power(image())


@pytest.fixture
def sweeping(powered: Board) -> Board:
    """A board that has just said HELLO and START is sent."""
    assert all(serials(powered.hello()))
    powered.frames.clear()
    powered.start()
    return powered


def sweep_on(board: Board, count: int) -> list[bytes]:
    """Wait for this number of SWEEPs more, to the pause between two of them."""
    board.take(SWEEP)
    return board.until(SWEEP, count, PERIOD_MS * (count + 2))


def test_an_unread_port_costs_frames_and_no_sweep(sweeping: Board) -> None:
    board = sweeping
    before = board.status()
    first = seq_of(sweep_on(board, 1)[0])
    board.do("read", room=0)
    board.run(900.0)  # between two STATUS, which would be dropped too
    board.do("read")
    sweeps = sweep_on(board, 30)
    after = board.status()
    seqs = [first, *map(seq_of, sweeps)]
    lost = seqs[-1] + 1 - first - len(seqs)
    assert after.tx_dropped - before.tx_dropped == lost
    assert 60 < lost < 90  # 2 kB wait in the firmware, 0.6 kB in its USB
    assert seqs == sorted(set(seqs))
    assert after.overruns == before.overruns
    for sweep in sweeps:
        assert (counts_of(sweep) == pattern(seq_of(sweep))).all()


def test_a_reopened_port_is_greeted_again(sweeping: Board) -> None:
    board = sweeping
    sweep_on(board, 3)
    board.do("close")
    board.run(900.0)
    assert not board.frames
    board.do("open")
    assert list(serials(board.hello())) == [b"BTSP%012d" % (at + 1) for at in range(3)]
    board.start()
    board.take(SWEEP)
    for row, sweep in enumerate(sweep_on(board, 10)):
        assert seq_of(sweep) == row
        assert (counts_of(sweep) == pattern(row)).all()


def test_a_stuck_spi_ends_in_a_watchdog_reset(sweeping: Board) -> None:
    board = sweeping
    sweep_on(board, 2)
    board.run(PERIOD_MS - 1.0)  # in the middle of the next
    resets = board.do("state")["resets"]
    board.cut("stick")
    board.run(900.0)
    assert not board.take(SWEEP)
    board.run(300.0)
    state = board.do("state")
    assert state["resets"] == resets + 1
    assert state["configured"]
    (hello,) = board.take(HELLO)
    assert hello[5:9] == bytes(4)  # that of a reset
    assert int.from_bytes(hello[9:17], "little") < 100_000  # ticks begin again
    assert list(serials(hello)) == [b"BTSP%012d" % (at + 1) for at in range(3)]
    status = board.status()
    assert (status.sweeps, status.rx_errors, status.spi_errors) == (0, 0, [0, 0, 0])
    assert not board.take(SWEEP)  # until START
