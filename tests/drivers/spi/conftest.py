"""Fixtures for the tests of drivers: the bridge's programs, compiled once, and running bridges."""

from __future__ import annotations

import os
import shutil
import subprocess
import tty
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.daemon.processes import put_first
from tests.drivers.spi.bridge_c import SANITIZERS, Host, StartBridge, build_program


@pytest.fixture(scope="session")
def bridge_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where programs are built; skips where nothing can be."""
    if shutil.which("cc") is None:
        pytest.skip("no C compiler (cc)")
    folder = tmp_path_factory.mktemp("bridge")
    (folder / "empty.c").write_text("int main(void) { return 0; }\n")
    attempt = subprocess.run(
        ["cc", *SANITIZERS, str(folder / "empty.c"), "-o", str(folder / "empty")],
        capture_output=True,
        check=False,
    )
    if attempt.returncode != 0:
        pytest.skip("the C compiler has no address and undefined behaviour sanitizers")
    return folder


@pytest.fixture(scope="session")
def bridge_probe(bridge_folder: Path) -> Path:
    """Answers questions about the C implementation."""
    core = ("src/biotac.c", "src/cobs.c", "src/crc32.c", "src/protocol.c")
    return build_program(bridge_folder, "probe", "test/probe.c", *core)


@pytest.fixture(scope="session")
def bridge_program(bridge_folder: Path) -> Path:
    """The bridge as a process on a pseudo-terminal."""
    return build_program(bridge_folder, "graspd-bridge", "src/*.c", "host/*.c")


@pytest.fixture
def start_bridge(bridge_program: Path) -> Iterator[StartBridge]:
    """Starts bridges with the given options; all of them end with the test."""
    hosts: list[Host] = []

    def start(*options: object, stdin: bytes | None = None) -> Host:
        """What is given on `stdin` ends when the test closes it."""
        process = subprocess.Popen(
            [bridge_program, *map(str, options)], stdin=subprocess.PIPE, stdout=subprocess.PIPE
        )
        put_first(process.pid)
        assert process.stdin is not None
        assert process.stdout is not None
        if stdin is not None:
            process.stdin.write(stdin)
            process.stdin.flush()
        else:
            process.stdin.close()
        path = process.stdout.readline().decode().strip()
        process.stdout.close()
        descriptor = os.open(path, os.O_RDWR | os.O_NOCTTY)
        tty.setraw(descriptor)
        hosts.append(Host(process, path, descriptor))
        return hosts[-1]

    yield start
    for host in hosts:
        host.stop()
