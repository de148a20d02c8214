"""The C++ example and the probe, compiled once."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.clients.building import compiled, compiled_probe


@pytest.fixture(scope="session")
def lift_gate() -> Path:
    """The binary of deploy/clients/cpp/lift_gate.cpp."""
    return compiled("lift_gate")


@pytest.fixture(scope="session")
def binary() -> Path:
    """The probe that tells what the header's rules say."""
    return compiled_probe()
