"""Fixtures of the drivers of datagrams."""

from __future__ import annotations

import pytest

from tests.drivers.palm.palm_stream import DatagramClock


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> DatagramClock:
    """The clock of a driver, which receives datagrams at its time."""
    clock = DatagramClock()
    clock.rule(monkeypatch)
    return clock
