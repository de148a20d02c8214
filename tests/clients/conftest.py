"""The C++ example and the probe, compiled once."""

from __future__ import annotations

import subprocess
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest

from deploy.clients.python.graspd_client import Client
from tests.clients.building import Probe, compiled, compiled_probe, lacking
from tests.clients.either import Connect, Either, InCpp, InPython


@pytest.fixture(scope="session")
def lift_gate() -> Path:
    """The binary of deploy/clients/cpp/lift_gate.cpp."""
    return compiled("lift_gate")


@pytest.fixture(scope="session")
def binary() -> Path:
    """The compiled program of probe.cpp, which runs the C++ client's rules."""
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


@pytest.fixture
def cpp(request: pytest.FixtureRequest) -> Probe | None:
    """The running probe; None where it cannot be compiled."""
    found: Probe | None = None if lacking() else request.getfixturevalue("probe")
    return found


@pytest.fixture(params=["python", "cpp"])
def connect(request: pytest.FixtureRequest) -> Iterator[Connect]:
    """Function that makes clients; the test runs once for each language. Clients in Python are
    closed afterwards."""
    with ExitStack() as stack:

        def made(folder: Path, ask: str | None = "ask", out: str | None = None) -> Either:
            out, asked = out or f"ipc://{folder}/out", ask and f"ipc://{folder}/{ask}"
            if request.param == "cpp":
                return InCpp(request.getfixturevalue("probe"), out, asked)
            return InPython(stack.enter_context(Client(out, ask_endpoint=asked)))

        yield made
