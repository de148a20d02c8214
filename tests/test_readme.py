"""The README's code is run as it stands there."""

from __future__ import annotations

import ast
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from daemon.publish.messages import decode_verdict
from drivers.recordings.csv_player import DEMO_TABLE

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text()
ENDPOINT = "ipc:///tmp/graspd-demo.ipc"


def test_files_that_say_where_to_start_are_there() -> None:
    extend = README.partition("## Extend")[2].partition("\nMIT ")[0]
    rows = [row.split("|") for row in extend.splitlines() if row.startswith("| ")][1:]
    assert len(rows) > 10
    paths = [re.findall(r"`((?:daemon|drivers|models|tests)/[^`]*)`", row[2]) for row in rows]
    missing = [path for row in paths for path in row if not (ROOT / path).exists()]
    assert missing == []


def block(language: str) -> str:
    """The one code block of the README in this language."""
    (code,) = re.findall(rf"```{language}\n(.*?)```", README, re.DOTALL)
    return str(code)


def verdict_lines(command: list[str], endpoint: str) -> list[str]:
    """Run a subscriber while a replay publishes 200 verdicts to it."""
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as subscriber:
        replay = [sys.executable, "-m", "daemon", "replay", str(DEMO_TABLE), "--speed", "2"]
        subprocess.run(
            [*replay, "--publish", endpoint, "--wait", "20"],
            check=True,
            capture_output=True,
            timeout=200,
        )
        return subscriber.communicate(timeout=100)[0].splitlines()


def test_the_python_subscriber_prints_verdicts(tmp_path: Path) -> None:
    endpoint = f"ipc://{tmp_path}/graspd"
    code = block("python")
    assert ENDPOINT in code
    # The process that starts first waits longer for the replay to come up.
    code = code.replace(ENDPOINT, endpoint).replace("2000", "5000", 1)
    lines = verdict_lines([sys.executable, "-Wignore", "-u", "-c", code], endpoint)
    assert len(lines) == 200
    assert [ast.literal_eval(line)["seq"] for line in lines] == list(range(200))


def test_the_cpp_subscriber_compiles_and_prints_verdicts(tmp_path: Path) -> None:
    if shutil.which("g++") is None or not Path("/usr/include/zmq_addon.hpp").exists():
        pytest.skip("no C++ compiler or no cppzmq: apt install g++ cppzmq-dev")
    endpoint = f"ipc://{tmp_path}/graspd"
    source = tmp_path / "subscriber.cpp"
    code = block("cpp")
    assert ENDPOINT in code
    source.write_text(code.replace(ENDPOINT, endpoint).replace("2000", "5000"))
    binary = tmp_path / "subscriber"
    subprocess.run(
        ["g++", "-std=c++17", "-Wall", "-Wextra", source, "-o", binary, "-lzmq"], check=True
    )
    lines = verdict_lines([str(binary)], endpoint)
    assert [decode_verdict(line.encode()).seq for line in lines] == list(range(len(lines)))
    assert len(lines) == 200
