"""The firmware on an emulated chip: its light, and hosts and sensors that misbehave."""

from __future__ import annotations

from itertools import groupby

import pytest

from tests.drivers.spi.bridge_c import HELLO, STOP, SWEEP, counts_of, frame, pattern, seq_of
from tests.emulated.board import BOOT_MS, Board, serials
from tests.emulated.conftest import Image

pytestmark = pytest.mark.timeout(600)

STEP_MS = 25


def turns(board: Board, ms: int) -> list[tuple[bool, int]]:
    """Run the board for `ms`; return each on (True) or off time of its light, ms.

    The first and last, which are cut off, are left out, unless the light never changed.
    """
    seen = []
    for _ in range(ms // STEP_MS):
        board.run(STEP_MS)
        seen.append(bool(board.do("state")["light"]))
    lengths = [(on, STEP_MS * len(list(same))) for on, same in groupby(seen)]
    return lengths[1:-1] if len(lengths) > 1 else lengths


def blinking(half_ms: int, found: list[tuple[bool, int]]) -> bool:
    return len(found) > 1 and all(length == pytest.approx(half_ms) for _, length in found)


def test_the_light_shows_idle_sweeping_and_a_missing_sensor(image: Image, board: Board) -> None:
    board.power(image())
    board.hello()
    assert blinking(500, turns(board, 2500)), "waits for START"
    board.start()
    board.run(100)
    assert turns(board, 1000) == [(True, 1000)], "sweeps"
    board.sensor(1, "unplug", 1)
    board.run(1100)
    assert blinking(100, turns(board, 1000)), "a sensor is missing"
    board.sensor(1, "unplug", 0)
    board.run(2200)
    assert turns(board, 1000) == [(True, 1000)], "found again"
    board.send(frame(STOP))
    board.run(100)
    assert blinking(500, turns(board, 2500)), "stopped"


def sweep_on(board: Board, count: int) -> list[bytes]:
    """Wait for this number of SWEEPs more, and return their payloads."""
    board.take(SWEEP)
    return board.until(SWEEP, count, 10.0 * (count + 2))


@pytest.fixture
def sweeping(image: Image, board: Board) -> Board:
    """A board that has greeted with HELLO, and to which START is sent."""
    board.power(image())
    assert all(serials(board.hello()))
    board.start()
    return board


def test_an_unread_port_drops_frames_while_sweeps_continue(sweeping: Board) -> None:
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


@pytest.mark.parametrize(("gone", "back"), [("close", "open"), ("detach", "attach")])
def test_after_a_port_comes_back_a_greeting_restarts_the_sweeps(
    sweeping: Board, gone: str, back: str
) -> None:
    board = sweeping
    sweep_on(board, 3)
    board.cut(gone)
    board.frames.clear()
    board.run(900.0)
    assert not board.frames
    board.do(back)
    board.run(BOOT_MS)
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
    board.run(9.0)  # in the middle of the next
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
