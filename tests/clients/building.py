"""Compile the C++ client, as its Makefile does, and drive it by the orders of probe.cpp.

Programs are cached by a checksum of their sources and compiler.
"""

from __future__ import annotations

import fcntl
import hashlib
import os
import shutil
import signal
import subprocess
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
CPP = ROOT / "deploy" / "clients" / "cpp"
KEPT = Path.home() / ".cache" / "graspd-tests"
KEEP_S = 7 * 24 * 3600.0
Words = Sequence[str | Path]
HEADERS = {"zmq_addon.hpp": "cppzmq-dev", "nlohmann/json.hpp": "nlohmann-json3-dev"}
"""Headers that the client includes, and the Debian packages that have them."""


def lacking() -> list[str]:
    """Return the Debian packages that are missing to compile the client; [] if none is."""
    missing = [package for header, package in HEADERS.items() if not _is_there(header)]
    return missing + [tool for tool in ("g++", "make") if shutil.which(tool) is None]


def skip_unless_it_can_be_compiled() -> None:
    """Skip the test if the C++ client cannot be compiled here, and say what is missing."""
    if missing := lacking():
        pytest.skip(f"no C++ client without it: apt install {' '.join(missing)}")


def _is_there(header: str) -> bool:
    return any(
        (Path(folder) / header).exists() for folder in ("/usr/include", "/usr/local/include")
    )


def compiled(name: str) -> Path:
    """Return the example program `name`, made by the client's Makefile; cached."""
    skip_unless_it_can_be_compiled()
    return kept(
        lambda folder: ["make", "-s", "-C", CPP, f"BUILD={folder}", "CXXFLAGS=-O0", folder / name],
        name,
    )


def kept(command: Callable[[Path], Words], name: str) -> Path:
    """Return the program `name`; if not cached, run the command `command(folder)`, which makes it
    in `folder`.

    The cache is valid while sources and compiler stay the same; programs of others that were used
    last a week ago are removed. One process makes the program, in four seconds, while others wait.
    """
    sources = [
        *CPP.glob("*.?pp"),
        CPP / "Makefile",
        *Path(__file__).parent.glob("*.c*"),
        Path(__file__),
    ]
    compiler = subprocess.run(["g++", "--version"], capture_output=True, check=True).stdout
    digest = hashlib.sha256(compiler)
    for source in sorted(sources):
        digest.update(source.read_bytes())
    program = KEPT / digest.hexdigest()[:16] / name
    program.parent.mkdir(parents=True, exist_ok=True)
    os.utime(program.parent)
    for former in KEPT.iterdir():
        if former.stat().st_mtime < time.time() - KEEP_S:
            shutil.rmtree(former, ignore_errors=True)
    with (program.parent / f"{name}.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not program.exists():
            with tempfile.TemporaryDirectory(dir=program.parent) as folder:
                subprocess.run(command(Path(folder)), check=True, timeout=200)
                (Path(folder) / name).replace(program)
    return program


def sleep_at_will(folder: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return a path: once a file is there, programs started from now on see that the computer has
    slept for an hour."""
    skip_unless_it_can_be_compiled()
    source = Path(__file__).parent / "sleep.c"
    words: Words = ["gcc", "-shared", "-fPIC", "-Wall", "-Werror", source, "-o"]
    library = kept(lambda made: [*words, made / "sleep.so"], "sleep.so")
    slept = folder / "slept"
    monkeypatch.setenv("SLEPT", str(slept))
    monkeypatch.setenv("LD_PRELOAD", str(library))
    return slept


def compiled_probe(name: str = "probe") -> Path:
    """Return the program of `name`.cpp in this folder, compiled with sanitizers."""
    skip_unless_it_can_be_compiled()
    warnings = ["-Wall", "-Wextra", "-Wpedantic", "-Wconversion", "-Werror"]
    sanitizers = ["-fsanitize=address,undefined", "-fno-sanitize-recover=all"]
    source = Path(__file__).parent / f"{name}.cpp"
    words: Words = [
        "g++",
        "-std=c++17",
        "-O0",
        *warnings,
        *sanitizers,
        f"-I{CPP}",
        source,
        "-lzmq",
        "-o",
    ]
    return kept(lambda folder: [*words, folder / name], name)


class Probe:
    """A running program of probe.cpp, driven by lines."""

    def __init__(self, process: subprocess.Popen[str]) -> None:
        self._process = process

    def tell(self, *words: object) -> None:
        """Give the probe the order `words`, which it reads after the next `flush`."""
        assert self._process.stdin is not None
        self._process.stdin.write(" ".join(map(str, words)) + "\n")

    def ask(self, *words: object) -> str:
        """Give the probe the order `words`; return the first line of its answer."""
        self.tell(*words)
        self.flush()
        return self.line()

    def flush(self) -> None:
        assert self._process.stdin is not None
        self._process.stdin.flush()

    def line(self) -> str:
        """Wait for the next line that the probe writes, and return it; "" after its end."""
        assert self._process.stdout is not None
        return self._process.stdout.readline().rstrip("\n")

    def send_signal(self, number: signal.Signals) -> None:
        self._process.send_signal(number)
