"""Fixtures for the tests on the emulated chip; all are skipped if it cannot be emulated."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from tests.emulated.board import Board
from tests.emulated.build import image as build_image
from tests.emulated.build import missing

Image = Callable[..., Path]
"""Function that builds an image of the firmware: `tests.emulated.build.image`."""


@pytest.fixture(scope="session")
def image() -> Image:
    """Function that builds an image; skips the test, and says why, if nothing can be emulated."""
    reason = missing()
    if reason is not None:
        pytest.skip(reason)
    return build_image


@pytest.fixture
def board(image: Image) -> Iterator[Board]:
    """An emulated board that is not switched on yet."""
    with Board() as one:
        yield one
