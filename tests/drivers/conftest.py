"""Fixtures of the drivers of datagrams."""

from __future__ import annotations

import pytest

from tests.drivers.udp_standin import Receiver
from tests.kit.clock import Clock


@pytest.fixture
def receiver(monkeypatch: pytest.MonkeyPatch) -> Receiver:
    """Stand-in that a driver opens in place of a socket."""
    receiver = Receiver()
    monkeypatch.setattr("graspd.drivers.udp.DatagramReceiver", lambda *_: receiver)
    return receiver


@pytest.fixture
def clock() -> Clock:
    return Clock()
