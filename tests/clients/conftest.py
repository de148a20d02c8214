"""The C++ example and the probe, compiled once."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.clients.building import compiled, compiled_probe
from tests.clients.probe import Probe, probing


@pytest.fixture(scope="session")
def lift_gate() -> Path:
    """The binary of deploy/clients/cpp/lift_gate.cpp."""
    return compiled("lift_gate")


@pytest.fixture(scope="session")
def binary() -> Path:
    """The probe that tells what the header's rules say."""
    return compiled_probe()


@pytest.fixture
def probe(binary: Path) -> Iterator[Probe]:
    """The running probe."""
    with probing(binary) as made:
        yield made
