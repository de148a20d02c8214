"""The firmware on an emulated chip says what the firmware on a PC says, byte for byte."""

from __future__ import annotations

import pytest

from tests.drivers.spi.bridge_c import START, SWEEP, StartBridge, frame
from tests.emulated.board import BOARD_ID, Board
from tests.emulated.conftest import Image

SWEEPS = 300
AT_ONCE = 50
"""Sweeps of the PC, whose time is real, that may take as long as its patience."""


def without_ticks(hello: bytes, sweeps: list[bytes]) -> tuple[bytes, list[bytes]]:
    """HELLO without its tick, SWEEPs without their start and end."""
    return hello[:9] + hello[17:], [sweep[:4] + sweep[20:] for sweep in sweeps]


@pytest.mark.parametrize("port", ["pico", "sketch"])
def test_hello_and_300_sweeps_are_those_of_the_pc(
    port: str, image: Image, board: Board, start_bridge: StartBridge
) -> None:
    host = start_bridge("--board", BOARD_ID)
    on_the_pc = host.hello()
    host.send(frame(START))
    swept = [one for _ in range(SWEEPS // AT_ONCE) for one in host.next_of(SWEEP, AT_ONCE)]
    expected = without_ticks(on_the_pc, swept)
    board.power(image(port))
    hello = board.hello()
    board.start()
    sweeps = board.until(SWEEP, SWEEPS, 10.0 * SWEEPS + 20.0)
    assert without_ticks(hello, sweeps) == expected
