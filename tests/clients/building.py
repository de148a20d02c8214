"""Compiling the C++ client, as its Makefile does."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
CPP = ROOT / "deploy" / "clients" / "cpp"
HEADERS = {"zmq_addon.hpp": "cppzmq-dev", "nlohmann/json.hpp": "nlohmann-json3-dev"}
"""What the client includes, and the Debian package that has it."""


def skip_unless_it_can_be_compiled() -> None:
    """Skip, and say what is missing."""
    missing = [package for header, package in HEADERS.items() if not _is_there(header)]
    missing += [tool for tool in ("g++", "make") if shutil.which(tool) is None]
    if missing:
        pytest.skip(f"no C++ client without it: apt install {' '.join(missing)}")


def _is_there(header: str) -> bool:
    return any(
        (Path(folder) / header).exists() for folder in ("/usr/include", "/usr/local/include")
    )


def compiled(name: str, folder: Path) -> Path:
    """The example of that name, made by the Makefile with its warnings as errors."""
    skip_unless_it_can_be_compiled()
    subprocess.run(
        ["make", "-s", "-C", CPP, f"BUILD={folder}", "CXXFLAGS=-O0", f"{folder}/{name}"],
        check=True,
        timeout=200,
    )
    return folder / name


def sleep_at_will(folder: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The file of which programs started from now on take the beginning for a computer's sleep."""
    skip_unless_it_can_be_compiled()
    library = folder / "sleep.so"
    source = Path(__file__).parent / "sleep.c"
    subprocess.run(
        ["gcc", "-shared", "-fPIC", "-Wall", "-Werror", source, "-o", library],
        check=True,
        timeout=200,
    )
    slept = folder / "slept"
    monkeypatch.setenv("SLEPT", str(slept))
    monkeypatch.setenv("LD_PRELOAD", str(library))
    return slept


def compiled_probe(folder: Path) -> Path:
    """The probe that tells what the header's rules say."""
    skip_unless_it_can_be_compiled()
    binary = folder / "probe"
    warnings = ["-Wall", "-Wextra", "-Wpedantic", "-Wconversion", "-Werror"]
    sanitizers = ["-fsanitize=address,undefined", "-fno-sanitize-recover=all"]
    source = Path(__file__).parent / "probe.cpp"
    subprocess.run(
        [
            "g++",
            "-std=c++17",
            "-O0",
            *warnings,
            *sanitizers,
            f"-I{CPP}",
            source,
            "-o",
            binary,
            "-lzmq",
        ],
        check=True,
        timeout=200,
    )
    return binary
