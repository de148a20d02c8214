"""The board's light tells what the bridge does, as its README says."""

from __future__ import annotations

from itertools import groupby

import pytest

from tests.drivers.spi.bridge_c import STOP, frame
from tests.emulated.board import Board
from tests.emulated.conftest import Image

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
    board.power(image("pico"))
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
