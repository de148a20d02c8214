"""Sensors, host and port that misbehave: the board counts exactly what was done to it."""

from __future__ import annotations

import random
from collections.abc import Iterator

import numpy as np
import pytest

from tests.drivers.spi.bridge_c import (
    HELLO,
    PING,
    SWEEP,
    counts_of,
    damaged,
    frame,
    judged,
    pattern,
    seq_of,
    words_of,
)
from tests.emulated.board import Board, serials
from tests.emulated.conftest import Image

PERIOD_MS = 10.0
SLOTS = 24
ERROR_CHANNEL, ERROR_SAMPLING_DELAY = 0xA558, 0xA52D
"""Words that stand for an error (manual table 8)."""
DEAD = 0x0101
"""The word of a count of 0 (manual figure 15)."""


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
    """So many more SWEEPs, to the pause between two of them."""
    board.take(SWEEP)
    return board.until(SWEEP, count, PERIOD_MS * (count + 2))


def test_error_words_and_dead_electrodes_are_reported(sweeping: Board) -> None:
    board = sweeping
    before = board.status()
    sweep_on(board, 2)
    board.sensor(2, "force", 4, ERROR_CHANNEL)
    board.sensor(0, "dead", 1 << 7)
    spoilt = sweep_on(board, 30)
    board.sensor(2, "force", 4, -1)
    board.sensor(0, "dead", 0)
    after = board.status()
    for sweep in spoilt:
        words = words_of(sweep)
        assert words[4, 2] == ERROR_CHANNEL
        assert words[7, 0] == DEAD
        whole = np.ones((3, SLOTS), dtype=bool)
        whole[2, 4] = whole[0, 7] = False
        assert (counts_of(sweep)[whole] == pattern(seq_of(sweep))[whole]).all()
    assert np.subtract(after.spi_errors, before.spi_errors).tolist() == [0, 0, 30]
    assert (after.overruns, after.tx_dropped) == (before.overruns, before.tx_dropped)


def test_a_late_sensor_gives_error_words_and_recovers(
    sweeping: Board,
) -> None:
    board = sweeping
    before = board.status()
    sweep_on(board, 2)
    board.sensor(1, "settle", 80_000)
    late = sweep_on(board, 10)
    board.sensor(1, "settle", 50_000)
    sound = sweep_on(board, 5)
    after = board.status()
    for sweep in late:
        assert (words_of(sweep)[:, 1] == ERROR_SAMPLING_DELAY).all()
        assert (counts_of(sweep)[[0, 2]] == pattern(seq_of(sweep))[[0, 2]]).all()
    for sweep in sound:
        assert (counts_of(sweep) == pattern(seq_of(sweep))).all()
    assert np.subtract(after.spi_errors, before.spi_errors).tolist() == [0, 10 * SLOTS, 0]


def test_a_sensor_that_is_unplugged_is_missed_and_found_again(sweeping: Board) -> None:
    board = sweeping
    before = board.status()
    sweep_on(board, 2)
    board.sensor(1, "unplug", 1)
    gone = sweep_on(board, 120)  # a second has passed: it was looked for
    board.sensor(1, "unplug", 0)
    back = sweep_on(board, 120)
    after = board.status()
    assert all((words_of(sweep)[:, 1] == 0xFFFF).all() for sweep in gone)
    assert (gone[0][20], gone[-1][20]) == (0b111, 0b101)
    assert (back[0][20], back[-1][20]) == (0b101, 0b111)
    assert all((counts_of(sweep) == pattern(seq_of(sweep))).all() for sweep in back)
    assert np.subtract(after.spi_errors, before.spi_errors).tolist() == [0, 120 * SLOTS, 0]
    seqs = [seq_of(sweep) for sweep in (*gone, *back)]
    assert seqs == list(range(seqs[0], seqs[0] + 240))
    # What is looked for at a sweep's time makes that one late, and no other.
    assert after.overruns - before.overruns <= 1


def test_100000_damaged_bytes_are_counted_while_sweeps_come(
    sweeping: Board,
) -> None:
    board, seed = sweeping, 20251122
    rng = random.Random(seed)
    noise = bytearray()
    while len(noise) < 100_000:
        one = damaged(rng)
        if not judged(one)[0]:  # a sound START or STOP would be obeyed
            noise += one
    noise += b"\0"
    found, errors = judged(bytes(noise))
    assert all(one.startswith("81 ") for one in found)  # and by chance a PING
    before = board.status()
    sweep_on(board, 1)
    for at in range(0, len(noise), 1000):
        board.send(bytes(noise[at : at + 1000]))
        board.run(PERIOD_MS)
    sweeps = board.take(SWEEP)
    after = board.status()
    assert after.rx_errors - before.rx_errors == errors, seed
    assert errors > 1000
    assert (after.overruns, after.tx_dropped) == (before.overruns, before.tx_dropped)
    seqs = [seq_of(sweep) for sweep in sweeps]
    assert seqs == list(range(seqs[0], seqs[0] + len(seqs)))
    assert len(seqs) >= len(noise) // 1000 - 1
    board.send(frame(PING, (5).to_bytes(4, "little")))
    board.run(PERIOD_MS)
    answered = [f"81 {int.from_bytes(hello[5:9], 'little')}" for hello in board.take(HELLO)]
    assert answered == [*found, "81 5"]


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
