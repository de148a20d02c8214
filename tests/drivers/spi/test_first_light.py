"""What `deploy/bridge/BUILD.md` says that the doctor says at each step is what it says, and
whatever is wrong with a bridge gets a cause and advice."""

from __future__ import annotations

import argparse
import contextlib
import functools
import json
import os
import random
import re
import threading
import time
import tty
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import serial

from daemon.commands import doctor
from drivers.spi.messages import DIGEST, FIRMWARE
from drivers.twins import spi
from drivers.twins.faults import LinkFaults
from tests.daemon.processes import graspd
from tests.drivers.spi.bridge_c import BRIDGE, StartBridge
from tests.drivers.twins.signals import GeneratedContact

PAGE = (BRIDGE / "BUILD.md").read_text()
PORT = "/dev/serial/by-id/usb-Raspberry_Pi_Pico_E6614103E7452D2F-if00"
BOARD = ("--board", "E6614103E7452D2F")
PERIOD_US = 100_000
"""Slow, so that a computer that stalls loses no sweep; the page's numbers are of 10 ms."""
LISTEN_S = 2.0
GIVEN_UP_S = 2.6
"""A bridge that does not answer is asked four times, half a second apart."""
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


def test_programs_are_told_the_same(tmp_path: Path, start_bridge: StartBridge) -> None:
    host = start_bridge(*BOARD, "--period-us", PERIOD_US, "--counts", counts(tmp_path, None))
    said = graspd("doctor", scene_for(tmp_path, host.path), "--listen", LISTEN_S, "--json")
    device = json.loads(said.stdout)["spi"]["device"]
    assert device["firmware"] == "0.2"
    assert "newer firmware" not in device
    assert device["clock rate"] == "1000000 Hz"
    least, most = re.findall(r"[+-]\d+", device["clock drift"])
    assert int(least) <= 0 <= int(most)  # it is this computer's own clock
    assert device["sweep"].endswith(" ms at most, of 100.00 ms")
    assert float(device["sweep"].partition(" ")[0]) >= 1.91  # 24 slots of 64 bits and 65 us


@pytest.mark.parametrize(
    ("source", "pins"),
    [
        ("pico/config.h", r"PIN_SELECT ([\d, ]+) "),
        ("rp2040/graspd_bridge/graspd_bridge.ino", r"PIN_SELECT\[\w+\] = {([\d, ]+)}"),
    ],
)
def test_the_picture_shows_the_pins_of_the_firmware(source: str, pins: str) -> None:
    picture = (BRIDGE / "wiring.svg").read_text()
    (numbers,) = re.findall(pins, (BRIDGE / source).read_text())
    selects = numbers.split(", ")
    for number, pin in enumerate(selects[:3], start=1):
        assert re.search(rf"CS {number}: pin \d+, GP{pin}<", picture), number
    assert re.search(rf"CS 4, CS 5: GP{selects[3]} .*, GP{selects[4]} ", picture)


# ---- what may be wrong with a bridge -----------------------------------------------------------


def findings(port: str, folder: Path, capsys: pytest.CaptureFixture[str]) -> list[Any]:
    """What the doctor finds of the bridge at a port."""
    look(scene_for(folder, port), "--listen", GIVEN_UP_S, "--json")
    found = json.loads(capsys.readouterr().out)["findings"]
    return [finding for finding in found if finding["what"].startswith("spi:")]


@contextlib.contextmanager
def at_work(work: Callable[[Callable[[], bool]], object]) -> Iterator[None]:
    """Something goes on meanwhile, until what it is given is true."""
    done = threading.Event()
    thread = threading.Thread(target=work, args=(done.is_set,))
    thread.start()
    try:
        yield
    finally:
        done.set()
        thread.join()


@contextlib.contextmanager
def bridge(
    folder: Path, *, digest: int = DIGEST, faults: LinkFaults | None = None
) -> Iterator[str]:
    """A twin that is not what the driver expects, and its port."""
    sweeps, port = GeneratedContact(3), folder / "bridge"
    faults = faults or LinkFaults()
    twin = spi.SpiTwin(port, sweeps, rate_hz=10.0, digest=digest, faults=faults)
    with twin, at_work(twin.serve):
        yield str(port)


@contextlib.contextmanager
def port_that(answers: Callable[[int, Callable[[], bool]], object] | None) -> Iterator[str]:
    """A port at which something else than a bridge is at work, or nothing at all."""
    master, slave = os.openpty()
    tty.setraw(slave)
    os.set_blocking(master, False)
    try:
        with at_work(functools.partial(answers, master)) if answers else contextlib.nullcontext():
            yield os.ttyname(slave)
    finally:
        os.close(master)
        os.close(slave)


def say_garbage(master: int, stop: Callable[[], bool]) -> None:
    while not stop():
        with contextlib.suppress(BlockingIOError):
            os.write(master, random.Random(1).randbytes(200))
        time.sleep(0.01)


@contextlib.contextmanager
def held() -> Iterator[str]:
    with port_that(None) as port, serial.Serial(port, exclusive=True):
        yield port


WRONG: dict[str, tuple[Callable[[Path], contextlib.AbstractContextManager[str]], str, str]] = {
    "another layout": (
        lambda folder: bridge(folder, digest=DIGEST ^ 1),
        f"the bridge has layout 0x{DIGEST ^ 1:08X} of version 1",
        "flash the firmware of this graspd",
    ),
    "silence": (lambda _: port_that(None), "no answer from /dev/pts/", "not a bridge yet: flash"),
    "garbage": (lambda _: port_that(say_garbage), "no answer from /dev/pts/", "not a bridge yet"),
    "another program": (lambda _: held(), "another program has it open", "systemctl stop"),
    "no port": (
        lambda folder: contextlib.nullcontext(str(folder / "right.toml")),
        "ioctl",
        "the one that the scene names",
    ),
}


@pytest.mark.parametrize("wrong", WRONG)
def test_what_is_wrong_with_a_bridge_gets_a_cause_and_advice(
    wrong: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    at_fault, cause, advice = WRONG[wrong]
    with at_fault(tmp_path) as port:
        found = findings(port, tmp_path, capsys)
    link, *_ = (finding for finding in found if finding["what"].startswith("spi: link "))
    assert link["level"] == "error"
    assert cause in link["what"]
    assert advice in link["advice"]
    assert not [finding for finding in found if finding["level"] == "ok"], "no fault is fine"


def test_older_firmware_is_named_with_how_to_flash_the_newer(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(spi, "FIRMWARE", FIRMWARE - 1)
    with bridge(tmp_path) as port:
        found = findings(port, tmp_path, capsys)
    (newer,) = (finding for finding in found if "newer firmware" in finding["what"])
    assert newer["what"] == "spi: newer firmware 0.2"
    assert (newer["level"], newer["cause"]) == ("warning", "firmware-old")
    assert "flash the firmware of this graspd: deploy/bridge/BUILD.md" in newer["advice"]
