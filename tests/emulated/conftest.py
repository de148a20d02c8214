"""Fixtures for the tests on the emulated chip; all are skipped where it cannot be."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from tests.emulated.board import Board
from tests.emulated.build import image as build_image
from tests.emulated.build import missing

Image = Callable[..., Path]
"""`tests.emulated.build.image`"""


@pytest.fixture(scope="session")
def image() -> Image:
    """Builds an image, or skips the test and says why."""
    reason = missing()
    if reason is not None:
        pytest.skip(reason)
    return build_image


@pytest.fixture
def board(image: Image) -> Iterator[Board]:
    """A board without power."""
    with Board() as one:
        yield one


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Emulated time is what is tested; real time only ends what hangs, on a busy computer too."""
    for item in items:
        if item.path.is_relative_to(Path(__file__).parent):
            item.add_marker(pytest.mark.timeout(600))
