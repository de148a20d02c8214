"""Recorders of these tests flush after 100 ms."""

from __future__ import annotations

import pytest


@pytest.fixture(autouse=True)
def flushed_soon(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("graspd.daemon.record.recorder.FLUSH_NS", 100_000_000)
