"""The programs in the README and the clients' page work as they stand there."""

from __future__ import annotations

import json
import re
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest
import zmq

from graspd.daemon import scene
from tests.clients.bench import Daemon
from tests.clients.building import CPP, skip_unless_it_can_be_compiled
from tests.kit.messages import GOLDEN
from tests.kit.waiting import wait_until

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text()
ENDPOINT = "ipc:///tmp/graspd-demo.ipc"
CLIENTS = (ROOT / "deploy/clients/README.md").read_text()
BESIDE = {"OUT": "ipc:///run/graspd/right.ipc", "ASK": "ipc:///run/graspd/right.ask.ipc"}
"""Endpoints in the programs of the clients' page, which are a scene's defaults."""


def block(language: str, page: str = README) -> str:
    """Return the first code block in this language in the text of a page."""
    return str(re.findall(rf"```{language}\n(.*?)```", page, re.DOTALL)[0])


def program(endpoint: str) -> str:
    """Return the README's program with this endpoint, and with a tenth of its timeout."""
    code = block("python")
    assert ENDPOINT in code
    assert code.count("2000") == 1
    return code.replace(ENDPOINT, endpoint).replace("2000", "200")


def test_the_subscriber_prints_unknown_on_silence_and_old_readings(tmp_path: Path) -> None:
    endpoint, output = f"ipc://{tmp_path}/graspd", tmp_path / "heard"
    command = [sys.executable, "-Wignore", "-u", "-c", program(endpoint)]
    content = json.loads((GOLDEN / "verdict_stable.json").read_text())
    with (
        zmq.Context() as context,
        context.socket(zmq.PUB) as publisher,
        output.open("w") as file,
        subprocess.Popen(command, stdout=file) as subscriber,
    ):
        publisher.linger = 0

        def has_heard() -> bool:
            for number, age_ns in ((1, 300_000_000), (2, 0)):
                content["seq"], content["t_mono_ns"] = number, time.monotonic_ns() - age_ns
                publisher.send_multipart([b"verdict.right", json.dumps(content).encode()])
            return output.read_text().count("0f0e0d0c0b0a09080706050403020100") > 3

        try:
            wait_until(lambda: output.read_text().startswith("unknown"))
            publisher.bind(endpoint)
            wait_until(has_heard, step_s=0.02)
            wait_until(lambda: output.read_text().endswith("unknown\n" * 3))
        finally:
            subscriber.kill()
    heard = output.read_text()
    assert "'seq': 2" in heard
    assert "'seq': 1," not in heard


def test_readme_and_clients_page_name_only_endpoints_of_scenes() -> None:
    scenes = [scene.load(ROOT / f"deploy/{name}.toml") for name in ("scenes/demo", "clients/loop")]
    default = {"tactile": {"driver": "spi", "port": "/dev/ttyACM0"}, "ask": {}}
    scenes.append(scene.parse(default, Path("right.toml")))
    known = {end for wanted in scenes for end in (wanted.endpoint, wanted.ask_endpoint)}
    assert set(re.findall(r"ipc:///[\w./-]+", README + CLIENTS)) <= known
    assert set(BESIDE.values()) <= known


def python_client(code: str, folder: Path) -> list[str]:
    (folder / "client.py").write_text(
        f"def lift():\n    print('lifted')\n    return True\n\n{code}"
    )
    (folder / "graspd_client.py").symlink_to(ROOT / "deploy/clients/python/graspd_client.py")
    return [sys.executable, "-Wignore", str(folder / "client.py")]


def cpp_client(code: str, folder: Path) -> list[str]:
    skip_unless_it_can_be_compiled()
    source, binary = folder / "client.cpp", folder / "client"
    source.write_text(f'{code}\nbool lift() {{ std::cout << "lifted"; return true; }}\n')
    flags = ["-std=c++17", "-O0", "-Wall", "-Wextra", "-Werror", f"-I{CPP}"]
    subprocess.run(["g++", *flags, source, "-o", binary, "-lzmq"], check=True)
    return [str(binary)]


@pytest.mark.slow
@pytest.mark.parametrize(("language", "made"), [("python", python_client), ("cpp", cpp_client)])
def test_the_clients_pages_program_lifts_only_with_a_daemon(
    language: str, made: Callable[[str, Path], list[str]], tmp_path: Path
) -> None:
    with Daemon(tmp_path, whole_grasps=True) as daemon:
        code = block(language, CLIENTS)
        for name, place in (("OUT", daemon.endpoint), ("ASK", daemon.ask_endpoint)):
            assert code.count(f'"{BESIDE[name]}"') == 1
            code = code.replace(f'"{BESIDE[name]}"', f'"{place}"')
        command = made(code, tmp_path)

        def lifts() -> bool:
            said = subprocess.run(command, check=True, capture_output=True, text=True).stdout
            assert "lifted" in said or said.startswith("do not lift: ")
            return "lifted" in said

        wait_until(lifts)
    assert not lifts()
