"""What came over a link is kept with its times; the real decoder gives the same verdicts again."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import can
import numpy as np
import pytest

from graspd.daemon.record.mcap_reader import header_of
from graspd.drivers.base import ElectrodeFault, TactileReading
from graspd.drivers.recordings.can_log import CanLog
from graspd.drivers.recordings.csv_player import DEMO_RECORDING
from graspd.drivers.recordings.serial_log import SerialLog
from tests.bench.live import Subscriber
from tests.daemon.commands.test_hardware_commands import GROUP, SCENES, filled, twin
from tests.daemon.processes import TIMEOUT_S, graspd, start, wait_for
from tests.daemon.record.recorded import compared, files, messages
from tests.drivers.one_sweep import tactile
from tests.ports import can_id

FAULTS = ("--drop", "0.0005", "--bit-flip", "0.0005", "--seed", "5")
READINGS = 600
"""That are recorded; two grasps are among them."""
SAME_TIME_NS = 50_000
"""Times of a live run and of its replay differ by 30 us where no PING was answered late."""


def scene(kind: str, folder: Path) -> Path:
    path = folder / "scene.toml"
    path.write_text(
        f"[tactile]\n{filled(SCENES[kind], folder)}\n"
        f'[model]\nname = "cnn1"\n[session]\nkeep = false\n'
        f'[publish]\nendpoint = "ipc://{folder}/graspd"\n'
        '[record]\ndirectory = "record"\nraw = true\n[gate]\nmax_age_ms = 10000\n'
    )
    return path


def record(kind: str, folder: Path) -> tuple[Path, Path]:
    """The recording of a twin that plays the demo grasps under faults, and the link log."""
    with start("run", scene(kind, folder)) as daemon:
        wait_for(folder / "graspd")
        with (
            twin(kind, folder, "--recording", str(DEMO_RECORDING), *FAULTS) as hardware,
            Subscriber(f"ipc://{folder}/graspd") as subscriber,
        ):
            seen: set[int] = set()
            while len(seen) < READINGS and hardware.poll() is None:
                verdict = subscriber.verdict(TIMEOUT_S)
                assert verdict is not None
                seen.add(verdict.t_mono_ns)
            hardware.terminate()
            hardware.communicate(timeout=TIMEOUT_S)
        daemon.terminate()
        _, said = daemon.communicate(timeout=TIMEOUT_S)
    assert daemon.returncode == 0, said
    (recording,) = files(folder)
    (log,) = set((folder / "record").iterdir()) - {recording}
    return recording, log


@pytest.fixture(scope="module")
def of_can(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """The recording of a board and its link log; the scene is in the folder above them."""
    return record("can", tmp_path_factory.mktemp("can"))


def played_again(folder: Path, log: Path) -> list[dict[str, Any]]:
    """What a replay of a link log says of each reading."""
    result = graspd("replay", "--json", log, "--scene", folder / "scene.toml")
    assert result.returncode == 0, result.stderr
    return [json.loads(line) for line in result.stdout.splitlines()]


def pairs(folder: Path) -> list[tuple[dict[str, Any], dict[str, Any]]]:
    """Record a bridge: the verdict of a replay and the one that was given, of each reading.

    They end where a computer that stood still left readings out, which the log has, or was late,
    and where it answered so late that the bridge's clock, known by other pings, is not the same.
    """
    recording, log = record("spi", folder)
    assert log.suffix == ".serial"
    kept = messages(recording)
    times = {content["t_mono_ns"] for what, content in kept if what == "tactile"}
    before: dict[int, dict[str, Any]] = {}
    whole = 0
    for what, content in kept:
        if what == "verdict" and content["t_mono_ns"] in times:
            before.setdefault(content["t_mono_ns"], content)
        elif what == "status":
            if content["skipped_readings"]:
                break
            whole = len(before)
    both = list(zip(played_again(folder, log), before.values(), strict=False))[:whole]
    given_ns = [content["t_mono_ns"] for what, content in kept if what == "tactile"]
    decoded_ns = made_ns(log)
    compared_times = min(len(decoded_ns), len(given_ns))
    apart_ns = np.subtract(decoded_ns[:compared_times], given_ns[:compared_times])
    moved = np.abs(apart_ns - apart_ns[0]) > SAME_TIME_NS
    late = ["stale" in new["reasons"] + old["reasons"] for new, old in both]
    ends = (at for at, is_late in enumerate(late) if is_late or moved[at])
    return both[: next(ends, whole)]


def made_ns(log: Path) -> list[int]:
    """Times of the readings of a serial log, as its decoder gives them."""
    with SerialLog([log], ("ff", "mf", "th")) as driver:
        made: list[int] = []
        while not driver.exhausted:
            made += [reading.made_ns for reading in tactile(driver.read_ready())]
    return made


def test_serial_bytes_through_the_real_decoder_give_the_verdicts_that_were_given(
    tmp_path: Path,
) -> None:
    found: list[tuple[dict[str, Any], dict[str, Any]]] = []
    for attempt in range(5):
        folder = tmp_path / str(attempt)
        folder.mkdir()
        if len(found := pairs(folder)) > 400:
            break
    assert len(found) > 400
    same = 0
    for new, old in ((compared(new), compared(old)) for new, old in found):
        for said in (new, old):
            # Whether it was called stable before its lift, which `risk` counts, is a matter of
            # time. So is which steps of 5 ms a speed is of, as times differ by microseconds.
            for name in ("risk", "still_ms", "motion", "motion_limits"):
                said.pop(name)
        same += new == old
    assert same > 0.97 * len(found)


def test_candump_text_through_the_real_decoder_gives_the_readings_that_there_were(
    of_can: tuple[Path, Path],
) -> None:
    recording, log = of_can
    offset_ns = header_of(recording).wall_minus_monotonic_ns
    decoded: dict[int, TactileReading] = {}
    readings = 0
    fingers = ("ff", "mf", "th")
    with CanLog([log], fingers, arbitration_id=can_id(GROUP), sequence="electrodes") as driver:
        while not driver.exhausted:
            for reading in driver.read_ready():
                assert isinstance(reading, TactileReading)
                decoded[reading.made_ns // 1000] = reading
                readings += 1
    known = [content for what, content in messages(recording) if what == "tactile"]
    # A machine that is too busy to look at the bus for 100 ms takes it for silent, and cuts sweeps.
    whole = [
        each for each in known if not np.any(np.array(each["faults"]) & ElectrodeFault.MISSING)
    ]
    assert len(whole) > 100
    same = 0
    for content in whole:
        found = decoded.get((content["t_mono_ns"] + offset_ns) // 1000)
        if found is not None and found.counts.ravel().tolist() == content["counts"]:
            same += found.faults.ravel().tolist() == content["faults"]
    assert same > 0.95 * len(whole)
    result = graspd("replay", "--json", log, "--scene", log.parents[1] / "scene.toml")
    assert result.returncode == 0, result.stderr
    assert len(result.stdout.splitlines()) == readings


def test_candump_text_is_what_other_programs_read(of_can: tuple[Path, Path]) -> None:
    _, log = of_can
    assert log.name.endswith(".can.log")
    with can.CanutilsLogReader(log) as reader:
        frames = list(reader)
    assert len(frames) > 5000
    assert {frame.arbitration_id for frame in frames} == {can_id(GROUP)}
    stamps = [frame.timestamp for frame in frames]
    assert stamps == sorted(stamps)
    # Of the wall clock; a file's time is that of the kernel's last tick.
    assert stamps[-1] <= log.stat().st_mtime + 0.02
