"""Sockets of peers that are closed after each test."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from tests.daemon.publish.doors import Peers


@pytest.fixture
def peers() -> Iterator[Peers]:
    made = Peers()
    yield made
    made.close()
