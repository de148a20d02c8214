"""The C++ example, compiled once."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.clients.building import compiled


@pytest.fixture(scope="session")
def lift_gate(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The binary of deploy/clients/cpp/lift_gate.cpp."""
    return compiled("lift_gate", tmp_path_factory.mktemp("cpp"))
