"""The firmware on an emulated chip: its images, its bytes against those of a PC, its light."""

from __future__ import annotations

from itertools import groupby

import pytest

from tests.drivers.spi.bridge_c import START, STOP, SWEEP, StartBridge, frame
from tests.emulated.board import BOARD_ID, Board
from tests.emulated.conftest import Image

SWEEPS = 300
AT_ONCE = 50
"""Sweeps of the PC, whose time is real, that may take as long as its patience."""


def without_ticks(hello: bytes, sweeps: list[bytes]) -> tuple[bytes, list[bytes]]:
    """HELLO without its tick, SWEEPs without their start and end."""
    return hello[:9] + hello[17:], [sweep[:4] + sweep[20:] for sweep in sweeps]


def test_hello_and_300_sweeps_are_those_of_the_pc(
    image: Image, board: Board, start_bridge: StartBridge
) -> None:
    host = start_bridge("--board", BOARD_ID)
    on_the_pc = host.hello()
    host.send(frame(START))
    swept = [one for _ in range(SWEEPS // AT_ONCE) for one in host.next_of(SWEEP, AT_ONCE)]
    expected = without_ticks(on_the_pc, swept)
    board.power(image())
    hello = board.hello()
    board.start()
    sweeps = board.until(SWEEP, SWEEPS, 10.0 * SWEEPS + 20.0)
    assert without_ticks(hello, sweeps) == expected


STEP_MS = 25


def turns(board: Board, ms: int) -> list[tuple[bool, int]]:
    """How long, ms, the light was on and off in turn, without what both ends cut off."""
    seen = []
    for _ in range(ms // STEP_MS):
        board.run(STEP_MS)
        seen.append(bool(board.do("state")["light"]))
    lengths = [(on, STEP_MS * len(list(same))) for on, same in groupby(seen)]
    return lengths[1:-1] if len(lengths) > 1 else lengths


def blinking(half_ms: int, found: list[tuple[bool, int]]) -> bool:
    return len(found) > 1 and all(length == pytest.approx(half_ms) for _, length in found)


def test_the_light_tells_idle_sweeping_and_a_missing_sensor_apart(
    image: Image, board: Board
) -> None:
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
