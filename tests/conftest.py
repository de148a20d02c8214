"""Fixtures for all tests: where the real recordings are, and that nothing is left behind."""

from __future__ import annotations

import contextlib
import gc
import logging
import os
import signal
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest
from hypothesis import HealthCheck, settings

from tests.daemon.processes import before_others
from tests.kit.waiting import wait_until

# A shell's background jobs ignore SIGINT, those of nohup SIGHUP, and so would all that tests start.
signal.signal(signal.SIGINT, signal.default_int_handler)
signal.signal(signal.SIGHUP, signal.SIG_DFL)
# Before anybody imports onnxruntime: its telemetry opens descriptors whenever it likes.
os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")
# Tests run side by side; threads of OpenMP that wait for each other would take the cores.
os.environ.setdefault("OMP_NUM_THREADS", "1")

settings.register_profile(
    "side by side", deadline=None, suppress_health_check=[HealthCheck.too_slow]
)
settings.load_profile("side by side")

ROOT = Path(__file__).parents[1]

BEGUN_FIRST = (
    "emulated/test_timing.py",
    "stability/test_models.py",
    "models/training/reports/test_error_vs_time.py",
    "daemon/doctor/test_link_faults.py",
    "daemon/judge/test_standing.py",
    "daemon/judge/test_every_key.py",
    "daemon/judge/test_grasps_to_the_lift.py",
    "daemon/commands/test_replay_command.py",
    "daemon/commands/test_hardware_commands.py",
    "daemon/record/test_record_and_replay.py",
    "daemon/record/test_link_log.py",
    "daemon/watch/test_watch_browser.py",
    "deploy/test_install.py",
    "models/training/making/test_making_export.py",
    "models/training/commands/test_evaluate.py",
    "models/training/commands/test_train.py",
    "models/training/evaluating/test_frame.py",
    "test_process_replay.py",
    "test_readme.py",
    "test_without_posix.py",
)
"""Test files that take longest. They are begun first: as all tests of a file run in one process, a
long file that is begun last would run alone."""


def data_dir() -> Path | None:
    """Return the folder of the real recordings, or None if there is none."""
    given = os.environ.get("GRASPD_DATA")
    candidates = [Path(given)] if given else [ROOT / "data", ROOT.parent / "shared" / "data"]
    return next((path for path in candidates if (path / "bts3").is_dir()), None)


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add the option `--left`, which `.ci/run` uses."""
    parser.addoption("--left", metavar="FILE", help="leave out what passed by this `pytest -rap`")


@pytest.fixture(scope="session")
def bts3_dir() -> Path:
    """Return the folder with the palm_down, palm_side and palm_45 .csv of the real data set."""
    folder = data_dir()
    if folder is None:
        pytest.skip("no real recordings: get them with `graspd data`, or set $GRASPD_DATA")
    return folder / "bts3"


@pytest.fixture(autouse=True, scope="module")
def what_is_there_is_kept() -> None:
    """Exclude all objects that exist before a module from garbage collection, which runs after each
    test: those of the modules before would cost most of its time."""
    gc.collect()
    gc.freeze()


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Sort the files of `BEGUN_FIRST` to the front; with `--left`, leave out passed tests."""
    if said := config.getoption("left"):
        passed = set(Path(said).read_text().splitlines())
        items[:] = [item for item in items if f"PASSED {item.nodeid}" not in passed]
    rank = {ROOT / "tests" / name: at for at, name in enumerate(BEGUN_FIRST)}
    items.sort(key=lambda item: rank.get(item.path, len(rank)))


@pytest.fixture
def comes_first() -> Iterator[None]:
    """Raise the priority of a test that is itself one end of a link which runs in real time."""
    with before_others():
        yield


@pytest.fixture(autouse=True)
def nothing_is_left_behind() -> Iterator[None]:
    """Fail a test that leaves threads, descriptors or the log's level behind."""
    level = logging.getLogger("graspd").level
    threads = threading.active_count()
    descriptors = _open_descriptors()
    yield
    gc.collect()
    # A thread may be about to end.
    wait_until(lambda: threading.active_count() <= threads, says="a thread was left running")
    left = _open_descriptors() - descriptors
    assert not left, f"descriptors were left open: {sorted(left)}"
    assert logging.getLogger("graspd").level == level


def _open_descriptors() -> set[str]:
    links = set()
    for entry in os.scandir("/proc/self/fd"):
        with contextlib.suppress(FileNotFoundError):  # closed meanwhile
            links.add((entry.name, os.readlink(entry.path)))
    listing = f"/proc/{os.getpid()}/fd"
    return {f"{name} -> {path}" for name, path in links if path != listing}
