"""The README's code is run as it stands there."""

from __future__ import annotations

import ast
import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from drivers.recordings.csv_player import DEMO_TABLE
from tests.clients.building import skip_unless_it_can_be_compiled
from tests.kit.messages import decode_verdict

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text()
ENDPOINT = "ipc:///tmp/graspd-demo.ipc"


def test_files_that_say_where_to_start_are_there() -> None:
    architecture = (ROOT / "deploy" / "ARCHITECTURE.md").read_text()
    extend = architecture.partition("## Where to start")[2]
    rows = [row.split("|") for row in extend.splitlines() if row.startswith("| ")][1:]
    assert len(rows) > 10
    paths = [re.findall(r"`((?:daemon|drivers|models|tests)/[^`]*)`", row[2]) for row in rows]
    missing = [path for row in paths for path in row if not (ROOT / path).exists()]
    assert missing == []


def block(language: str) -> str:
    """The one code block of the README in this language."""
    (code,) = re.findall(rf"```{language}\n(.*?)```", README, re.DOTALL)
    return str(code)


def run_subscriber(command: list[str], endpoint: str) -> list[str]:
    """What a subscriber prints while a replay publishes 200 verdicts to it, up to the silence."""
    replay = [sys.executable, "-m", "daemon", "replay", str(DEMO_TABLE), "--speed", "2"]
    replay += ["--publish", endpoint, "--wait", "20"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as subscriber:
        try:
            subprocess.run(replay, check=True, capture_output=True, timeout=200)
            assert subscriber.stdout is not None
            lines: list[str] = []
            for line in subscriber.stdout:
                lines.append(line.rstrip("\n"))
                if lines[-1] == "unknown" and len(lines) - lines.count("unknown") == 200:
                    break
            return lines
        finally:
            subscriber.kill()


PATIENCE = "60000"
"""In place of the README's time, ms: what is called unknown is called so by `silence_ms`."""


def python_subscriber(endpoint: str, first_ms: str) -> list[str]:
    code = block("python")
    assert ENDPOINT in code
    assert code.count("2000") == 1
    code = code.replace(ENDPOINT, endpoint).replace("2000", first_ms)
    return [sys.executable, "-Wignore", "-u", "-c", code]


@pytest.fixture
def cpp_subscriber(tmp_path: Path) -> Callable[[str, str], list[str]]:
    """Compiles the C++ subscriber for an endpoint and a time."""
    skip_unless_it_can_be_compiled()

    def compile_it(endpoint: str, first_ms: str) -> list[str]:
        source, binary = tmp_path / "subscriber.cpp", tmp_path / "subscriber"
        code = block("cpp")
        assert ENDPOINT in code
        assert code.count("2000") == 1
        source.write_text(code.replace(ENDPOINT, endpoint).replace("2000", first_ms))
        warnings = ["-Wall", "-Wextra", "-Werror"]
        subprocess.run(["g++", "-std=c++17", *warnings, source, "-o", binary, "-lzmq"], check=True)
        return [str(binary)]

    return compile_it


def test_the_python_subscriber_prints_verdicts_and_unknown_on_silence(tmp_path: Path) -> None:
    endpoint = f"ipc://{tmp_path}/graspd"
    *lines, last = run_subscriber(python_subscriber(endpoint, PATIENCE), endpoint)
    said = [ast.literal_eval(line) for line in lines if line != "unknown"]
    assert [each["seq"] for each in said] == list(range(200))
    assert last == "unknown"


def test_the_cpp_subscriber_prints_verdicts_and_unknown_on_silence(
    cpp_subscriber: Callable[[str, str], list[str]], tmp_path: Path
) -> None:
    endpoint = f"ipc://{tmp_path}/graspd"
    *lines, last = run_subscriber(cpp_subscriber(endpoint, PATIENCE), endpoint)
    said = [decode_verdict(line.encode()) for line in lines if line != "unknown"]
    assert [each.seq for each in said] == list(range(200))
    assert last == "unknown"


def first_line(command: list[str]) -> str:
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as subscriber:
        assert subscriber.stdout is not None
        try:
            return subscriber.stdout.readline()
        finally:
            subscriber.kill()


def test_the_python_subscriber_of_nobody_prints_unknown(tmp_path: Path) -> None:
    assert first_line(python_subscriber(f"ipc://{tmp_path}/nobody", "200")) == "unknown\n"


def test_the_cpp_subscriber_of_nobody_prints_unknown(
    cpp_subscriber: Callable[[str, str], list[str]], tmp_path: Path
) -> None:
    assert first_line(cpp_subscriber(f"ipc://{tmp_path}/nobody", "200")) == "unknown\n"
