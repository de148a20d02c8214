"""The C++ example and the probe, compiled once."""

from __future__ import annotations

import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.clients.building import Probe, compiled, compiled_probe


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
    """The running probe; the test fails if its sanitizers find something."""
    with subprocess.Popen(
        [binary], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as process:
        yield Probe(process)
        process.communicate(timeout=200)
        assert process.returncode == 0, "the sanitizers found something"
