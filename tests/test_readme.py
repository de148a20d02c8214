"""The README's code is run as it stands there."""

from __future__ import annotations

import ast
import re
import subprocess
import sys
from pathlib import Path

from graspd.drivers.recordings.csv_player import DEMO_TABLE
from tests.clients.building import skip_unless_it_can_be_compiled
from tests.kit.messages import decode_verdict

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text()
ENDPOINT = "ipc:///tmp/graspd-demo.ipc"


def block(language: str) -> str:
    """The one code block of the README in this language."""
    (code,) = re.findall(rf"```{language}\n(.*?)```", README, re.DOTALL)
    return str(code)


def run_subscriber(command: list[str], endpoint: str) -> list[str]:
    """What a subscriber prints: of nobody at first, then of a replay of 200 verdicts."""
    replay = [sys.executable, "-m", "graspd", "replay", str(DEMO_TABLE), "--speed", "2"]
    replay += ["--publish", endpoint, "--wait", "20"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as subscriber:
        try:
            assert subscriber.stdout is not None
            lines = [subscriber.stdout.readline().rstrip("\n")]
            subprocess.run(replay, check=True, capture_output=True, timeout=200)
            for line in subscriber.stdout:
                lines.append(line.rstrip("\n"))
                if lines[-1] == "unknown" and len(lines) - lines.count("unknown") == 200:
                    break
            return lines
        finally:
            subscriber.kill()


def program(language: str, endpoint: str) -> str:
    """The README's, for an endpoint, and with less patience until the first message."""
    code = block(language)
    assert ENDPOINT in code
    assert code.count("2000") == 1
    return code.replace(ENDPOINT, endpoint).replace("2000", "200")


def test_the_python_subscriber_prints_verdicts_and_unknown_on_silence(tmp_path: Path) -> None:
    endpoint = f"ipc://{tmp_path}/graspd"
    command = [sys.executable, "-Wignore", "-u", "-c", program("python", endpoint)]
    first, *lines, last = run_subscriber(command, endpoint)
    said = [ast.literal_eval(line) for line in lines if line != "unknown"]
    assert [each["seq"] for each in said] == list(range(200))
    assert first == last == "unknown"


def test_the_cpp_subscriber_prints_verdicts_and_unknown_on_silence(tmp_path: Path) -> None:
    skip_unless_it_can_be_compiled()
    endpoint = f"ipc://{tmp_path}/graspd"
    source, binary = tmp_path / "subscriber.cpp", tmp_path / "subscriber"
    source.write_text(program("cpp", endpoint))
    warnings = ["-Wall", "-Wextra", "-Werror"]
    subprocess.run(["g++", "-std=c++17", *warnings, source, "-o", binary, "-lzmq"], check=True)
    first, *lines, last = run_subscriber([str(binary)], endpoint)
    said = [decode_verdict(line.encode()) for line in lines if line != "unknown"]
    assert [each.seq for each in said] == list(range(200))
    assert first == last == "unknown"
