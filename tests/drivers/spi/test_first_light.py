"""What `deploy/bridge/BUILD.md` says that the doctor says at each step is what it says, and
whatever is wrong with a bridge gets a cause and advice."""

from __future__ import annotations

import argparse
import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

from graspd.daemon.commands import doctor
from tests.drivers.spi.bridge_c import BRIDGE, StartBridge

PAGE = (BRIDGE / "BUILD.md").read_text()
PORT = "/dev/serial/by-id/usb-Raspberry_Pi_Pico_E6614103E7452D2F-if00"
BOARD = ("--board", "E6614103E7452D2F")
PERIOD_US = 100_000
"""Slow, so that a computer that stalls loses no sweep; the page's numbers are of 10 ms."""
LISTEN_S = 2.0
ABSENT = {sensor: ("--unplug", sensor) for sensor in range(3)}
STEPS: dict[str, Sequence[object] | None] = {
    "No board": None,
    "A board without sensors": (*ABSENT[0], *ABSENT[1], *ABSENT[2]),
    "One sensor": (*ABSENT[1], *ABSENT[2]),
    "Swapped chip selects": (*ABSENT[0], *ABSENT[2], "--serial", "1:BTSP000000000001"),
    "All well": (),
    "Touch": (),
}
"""Steps by how the page calls them, and what the PC port is told; without any, there is none."""
VARIES = re.compile(r"bridge overruns|readings/s|^...(model|realtime priority|you are not in)")
"""Findings on the computer, its user and its load, not on the bridge."""


def counts(folder: Path, moving: int | None) -> Path:
    """Rows of counts of three untouched sensors with their noise, and of one that is touched."""
    random = np.random.default_rng(5)
    rest = random.uniform(2400, 3400, 72)
    rows = rest + random.normal(0.0, 3.5, (500, 72))
    if moving is not None:
        rows[:, 24 * moving : 24 * (moving + 1)] += 200.0 * (np.arange(500)[:, None] // 5 % 2)
    path = folder / "counts.txt"
    np.savetxt(path, rows.round(), fmt="%d")
    return path


def scene_for(folder: Path, port: str) -> Path:
    scene = folder / "right.toml"
    scene.write_text(
        f'[tactile]\ndriver = "spi"\nport = "{port}"\n[model]\nname = "cnn1"\n'
        f'[publish]\nendpoint = "ipc://{folder}/graspd"\n'
    )
    return scene


def look(scene: Path, *options: object) -> int:
    """`graspd doctor` in this process."""
    parser = argparse.ArgumentParser()
    doctor.add_arguments(parser)
    return doctor.run(parser.parse_args([str(scene), *map(str, options)]))


def without_numbers(said: str, port: str) -> list[str]:
    """Findings without those that vary; measured numbers are `#`."""
    lines = []
    for line in said.replace(port, "PORT").splitlines():
        if re.match(r"(ok |!  |!! )", line) and not VARIES.search(line):
            line = re.sub(r"drift .* ppm", "drift # ppm", line)
            line = re.sub(r"(?<!firmware )\b\d+\.\d+\b", "#", line)
            line = re.sub(r"\b\d+(?= (link|faulty|absent))", "#", line)
            line = re.sub(r"\b[1-9]\d*(?=,|  ->)", "#", line) if "spi errors" in line else line
            lines.append(line)
    return lines


def quoted(step: str) -> str:
    """The page's quotation under the heading of a step."""
    (found,) = re.findall(rf"^#+ (?:\d\. )?{step}\n.*?```text\n(.*?)```", PAGE, re.DOTALL | re.M)
    return str(found)


@pytest.mark.parametrize("step", STEPS)
def test_the_doctor_says_at_each_step_what_the_page_quotes(
    step: str, tmp_path: Path, start_bridge: StartBridge, capsys: pytest.CaptureFixture[str]
) -> None:
    port, options = str(tmp_path / "absent"), STEPS[step]
    if options is not None:
        feels = counts(tmp_path, 1 if step == "Touch" else None)
        told = (*BOARD, "--period-us", PERIOD_US, "--counts", feels, *options)
        port = start_bridge(*told).path
    code = look(scene_for(tmp_path, port), "--listen", LISTEN_S)
    output = capsys.readouterr().out
    said, page = without_numbers(output, port), without_numbers(quoted(step), PORT)
    # The page may leave out what is fine, except where all is.
    kept = [line for line in said if not line.startswith("ok ") or line in page]
    assert page == (said if step == "All well" else kept), output
    wrong, to_look_at = (sum(line.startswith(mark) for line in page) for mark in ("!! ", "!  "))
    assert quoted(step).splitlines()[-1] == f"{wrong} wrong, {to_look_at} to look at"
    assert f"\n{wrong} wrong, " in output
    assert code == int(wrong > 0)


def test_the_picture_shows_the_pins_of_the_firmware() -> None:
    picture = (BRIDGE / "wiring.svg").read_text()
    (numbers,) = re.findall(r"PIN_SELECT ([\d, ]+) ", (BRIDGE / "pico/config.h").read_text())
    selects = numbers.split(", ")
    for number, pin in enumerate(selects[:3], start=1):
        assert re.search(rf"CS {number}: pin \d+, GP{pin}<", picture), number
    assert re.search(rf"CS 4, CS 5: GP{selects[3]} .*, GP{selects[4]} ", picture)
