"""Fixtures for all tests: where the real recordings are, and that nothing is left behind."""

from __future__ import annotations

import gc
import os
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest
from hypothesis import HealthCheck, settings

# Before anybody imports onnxruntime: its telemetry opens descriptors whenever it likes.
os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")
# Tests run side by side; threads of OpenMP that wait for each other would take the cores.
os.environ.setdefault("OMP_NUM_THREADS", "1")

settings.register_profile(
    "side by side", deadline=None, suppress_health_check=[HealthCheck.too_slow]
)
settings.load_profile("side by side")

ROOT = Path(__file__).parents[1]

IN_REAL_TIME = {
    *("test_against_daemon", "test_both_ask", "test_bridge_process", "test_can_bridge"),
    *("test_can_link", "test_can_slcan", "test_can_socket", "test_can_twin"),
    *("test_commands", "test_cpp_against_daemon", "test_export", "test_fewer_fingers"),
    *("test_hardware_commands", "test_joints", "test_keys", "test_lift", "test_logs"),
    *("test_systemd", "test_outages", "test_outcomes", "test_palm", "test_process"),
    *("test_publisher", "test_questions", "test_link_log", "test_readme"),
    *("test_realtime", "test_record_and_replay", "test_recorder", "test_runner"),
    *(
        "test_curve",
        "test_peers",
        "test_soak",
        "test_sockets",
        "test_spi_bridge",
        "test_spi_twin",
        "test_subscribers",
    ),
    *("test_run_jobs", "test_watch_browser", "test_watch_command", "test_watch_web"),
}
"""Files whose tests work with processes, links and clocks as they are. A shared computer stalls now
and then, so they are tried three times; what is wrong fails each time, and what fails once is
listed."""


def data_dir() -> Path | None:
    """Folder of the real recordings, or None where there is none."""
    given = os.environ.get("GRASPD_DATA")
    candidates = [Path(given)] if given else [ROOT / "data", ROOT.parent / "shared" / "data"]
    return next((path for path in candidates if (path / "bts3").is_dir()), None)


@pytest.fixture(scope="session")
def bts3_dir() -> Path:
    """Folder with palm_down.csv, palm_side.csv and palm_45.csv of the real data set."""
    folder = data_dir()
    if folder is None:
        pytest.skip("no real recordings: get them with `graspd data`, or set $GRASPD_DATA")
    return folder / "bts3"


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Let tests in real time be tried again."""
    for item in items:
        if item.path.stem in IN_REAL_TIME:
            item.add_marker(pytest.mark.flaky(reruns=2))


def pytest_collection_finish() -> None:
    """Take what the imports made out of the garbage collector's sight: it runs after every test."""
    gc.collect()
    gc.freeze()


@pytest.fixture(autouse=True)
def nothing_is_left_behind() -> Iterator[None]:
    """Fail a test that leaves threads or descriptors behind."""
    threads = threading.active_count()
    descriptors = _open_descriptors()
    yield
    gc.collect()
    assert threading.active_count() <= threads, "a thread was left running"
    left = _open_descriptors() - descriptors
    assert not left, f"descriptors were left open: {sorted(left)}"


def _open_descriptors() -> set[str]:
    links = set()
    for entry in os.scandir("/proc/self/fd"):
        try:
            links.add(f"{entry.name} -> {os.readlink(entry.path)}")
        except FileNotFoundError:
            continue  # the descriptor of this very listing
    return links
