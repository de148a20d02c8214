"""The README's code is run as it stands there."""

from __future__ import annotations

import ast
import json
import re
import subprocess
import sys
import time
from pathlib import Path

import zmq

from graspd.drivers.recordings.csv_player import DEMO_TABLE
from tests.clients.building import skip_unless_it_can_be_compiled
from tests.kit.messages import GOLDEN, decode_verdict
from tests.kit.waiting import wait_until

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text()
AGE_LIMIT = r"200e6|200'000'000"
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


def patient(code: str) -> str:
    """With an age limit that a busy computer keeps."""
    assert len(re.findall(AGE_LIMIT, code)) == 1
    return re.sub(AGE_LIMIT, "60e9", code)


def heard_of_old_and_new(command: list[str], endpoint: str, output: Path) -> str:
    """What a subscriber prints of `stable` readings in turns: number 1 old, number 2 new."""
    content = json.loads((GOLDEN / "verdict_stable.json").read_text())
    with (
        zmq.Context() as context,
        context.socket(zmq.PUB) as publisher,
        output.open("w") as file,
        subprocess.Popen(command, stdout=file) as subscriber,
    ):
        publisher.linger = 0
        publisher.bind(endpoint)

        def has_heard() -> bool:
            for number, age_ns in ((1, 300_000_000), (2, 0)):
                content["seq"], content["t_mono_ns"] = number, time.monotonic_ns() - age_ns
                publisher.send_multipart([b"verdict.right", json.dumps(content).encode()])
            return output.read_text().count("0f0e0d0c0b0a09080706050403020100") > 3

        try:
            wait_until(has_heard, step_s=0.02)
        finally:
            subscriber.kill()
    return output.read_text()


def test_the_python_subscriber_prints_verdicts_and_unknown_on_silence(tmp_path: Path) -> None:
    endpoint = f"ipc://{tmp_path}/graspd"
    command = [sys.executable, "-Wignore", "-u", "-c", patient(program("python", endpoint))]
    first, *lines, last = run_subscriber(command, endpoint)
    said = [ast.literal_eval(line) for line in lines if line != "unknown"]
    assert [each["seq"] for each in said] == list(range(200))
    assert first == last == "unknown"


def test_the_python_subscriber_takes_old_readings_for_unknown(tmp_path: Path) -> None:
    endpoint = f"ipc://{tmp_path}/graspd"
    command = [sys.executable, "-Wignore", "-u", "-c", program("python", endpoint)]
    heard = heard_of_old_and_new(command, endpoint, tmp_path / "heard")
    assert "'seq': 2" in heard
    assert "'seq': 1," not in heard


def compiled(code: str, folder: Path) -> str:
    source, binary = folder / "subscriber.cpp", folder / "subscriber"
    source.write_text(code)
    warnings = ["-Wall", "-Wextra", "-Werror"]
    subprocess.run(["g++", "-std=c++17", *warnings, source, "-o", binary, "-lzmq"], check=True)
    return str(binary)


def test_the_cpp_subscriber_prints_verdicts_and_unknown_on_silence(tmp_path: Path) -> None:
    skip_unless_it_can_be_compiled()
    endpoint = f"ipc://{tmp_path}/graspd"
    binary = compiled(patient(program("cpp", endpoint)), tmp_path)
    first, *lines, last = run_subscriber([binary], endpoint)
    said = [decode_verdict(line.encode()) for line in lines if line != "unknown"]
    assert [each.seq for each in said] == list(range(200))
    assert first == last == "unknown"


def test_the_cpp_subscriber_takes_old_readings_for_unknown(tmp_path: Path) -> None:
    skip_unless_it_can_be_compiled()
    endpoint = f"ipc://{tmp_path}/graspd"
    binary = compiled(program("cpp", endpoint), tmp_path)
    heard = heard_of_old_and_new([binary], endpoint, tmp_path / "heard")
    assert '"seq":2' in heard
    assert '"seq":1,' not in heard
