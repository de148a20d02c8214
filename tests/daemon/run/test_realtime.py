"""Realtime mode: set where the system allows it, else one warning; undone at the end."""

from __future__ import annotations

import ctypes
import gc
import logging
import os
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from graspd.daemon import scene
from graspd.daemon.assembly.plan import Plan
from graspd.daemon.judge.reasons import GateState
from graspd.daemon.run.realtime import RealtimeMode
from graspd.daemon.run.rehearsal import rehearse
from graspd.daemon.scene.scene import Realtime
from tests.kit.messages import GOLDEN_STATUS
from tests.kit.programs import ran
from tests.threads import at_work

WORLD = """
import ctypes, os, resource, sys
from graspd.daemon.run.realtime import RealtimeMode
from graspd.daemon.scene.scene import Realtime
"""
NOBODY = 65534

needs_root = pytest.mark.skipif(os.geteuid() != 0, reason="needs root to have and to lose rights")


@pytest.fixture
def as_before() -> Iterator[None]:
    processors = os.sched_getaffinity(0)
    yield
    gc.enable()
    os.sched_setaffinity(0, processors)
    os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
    ctypes.CDLL(None).munlockall()


def in_a_process(text: str, folder: Path) -> str:
    """Return the output of the Python code `text`, run in a process that may give up rights."""
    home = {"HOME": str(folder)}
    command = [sys.executable, "-c", WORLD + text]
    return ran(*command, cwd=Path(__file__).parents[3], env=os.environ | home, check=True).stdout


def fifo_may_be_had() -> bool:
    """Return True if SCHED_FIFO is allowed; some containers refuse it even to root."""
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(1))
    except OSError:
        return False
    os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
    return True


def test_only_the_loops_thread_gets_priority_all_are_pinned(as_before: None) -> None:
    if not fifo_may_be_had():
        pytest.skip("SCHED_FIFO is refused here")
    processor = max(os.sched_getaffinity(0))
    with RealtimeMode(Realtime(priority=7, cpus=(processor,))) as mode:
        assert [what for what in mode.lacking if not what.startswith("locked memory")] == []
        assert os.sched_getscheduler(0) & ~os.SCHED_RESET_ON_FORK == os.SCHED_FIFO
        assert os.sched_getparam(0).sched_priority == 7
        for thread in map(int, os.listdir("/proc/self/task")):
            assert os.sched_getaffinity(thread) == {processor}
        assert not gc.isenabled()
        later: list[int] = []
        with at_work(lambda _stop: later.append(os.sched_getscheduler(0))):
            pass
        assert later == [os.SCHED_OTHER]
    assert os.sched_getscheduler(0) & ~os.SCHED_RESET_ON_FORK == os.SCHED_OTHER
    assert len(os.sched_getaffinity(0)) >= 1
    assert gc.isenabled()


def test_memory_is_locked_where_that_is_allowed(tmp_path: Path) -> None:
    said = in_a_process(
        """
with RealtimeMode(Realtime(priority=None)) as mode:
    kib = [int(line.split()[1]) for line in open("/proc/self/status") if "VmLck" in line]
    print(len(mode.lacking), *kib)
""",
        tmp_path,
    )
    lacking, locked_kib = map(int, said.split())
    if lacking:
        pytest.skip("memory may not be locked here")
    assert locked_kib > 0


def test_an_absent_processor_is_named_in_the_warning(
    as_before: None, caplog: pytest.LogCaptureFixture
) -> None:
    with RealtimeMode(Realtime(priority=None, cpus=(1000,))) as mode:
        assert any(what.startswith("realtime.cpus") for what in mode.lacking)
    assert [record.levelno for record in caplog.records] == [logging.WARNING]
    assert "realtime.cpus" in caplog.text


@needs_root
def test_without_rights_one_warning_says_what_to_grant(tmp_path: Path) -> None:
    said = in_a_process(
        f"""
import logging
logging.basicConfig(stream=sys.stdout, format="%(message)s")
resource.setrlimit(resource.RLIMIT_RTPRIO, (0, 0))
resource.setrlimit(resource.RLIMIT_MEMLOCK, (65536, 65536))
os.setgroups([]); os.setresgid({NOBODY}, {NOBODY}, {NOBODY})
os.setresuid({NOBODY}, {NOBODY}, {NOBODY})
with RealtimeMode(Realtime(priority=50)) as mode:
    hold = bytearray(1 << 26)  # far above the limit: must not be refused
print("lives on")
""",
        tmp_path,
    )
    warning, end = said.splitlines()
    assert "LimitRTPRIO=50" in warning
    assert "LimitMEMLOCK=infinity" in warning
    assert end == "lives on"


def test_in_realtime_mode_garbage_is_collected_at_each_status(as_before: None) -> None:
    collected = []

    class Loop:
        def __init__(self) -> None:
            self.me = self

        def __del__(self) -> None:
            collected.append(True)

    with RealtimeMode(Realtime(priority=None)) as mode:
        Loop()
        assert collected == []
        mode.on_status(GOLDEN_STATUS)
        assert collected == [True]


def test_the_rehearsal_goes_through_a_whole_grasp() -> None:
    tactile = {"driver": "spi", "port": "/nowhere"}
    pipeline = rehearse(Plan.of(scene.parse({"tactile": tactile}, Path("any.toml"))))
    assert pipeline.hand.grasp == 1
    assert pipeline.hand.state in (GateState.RELEASED, GateState.IDLE)
    assert pipeline.session is not None
    assert pipeline.session.grasps == 1
