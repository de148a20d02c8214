"""One slow job at a time in a thread, whatever becomes of it."""

from __future__ import annotations

import os
import select
import sys
import threading
from collections.abc import Iterator

import pytest

from graspd.daemon.process.worker import SWITCH_S, Worker
from tests.kit.waiting import PATIENCE_S


@pytest.fixture
def worker() -> Iterator[Worker[object]]:
    made: Worker[object] = Worker("slow")
    yield made
    made.close(PATIENCE_S)


def test_a_job_wakes_the_loop_and_gives_one_result(worker: Worker[object]) -> None:
    assert worker.filenos == []
    assert worker.submit(lambda: 7)
    readable, _, _ = select.select(worker.filenos, [], [], PATIENCE_S)
    assert readable == worker.filenos != []
    assert sys.getswitchinterval() == pytest.approx(SWITCH_S)
    assert worker.take() == 7
    assert worker.take() is None
    assert worker.filenos == []


def test_a_job_is_refused_until_the_last_result_is_taken(worker: Worker[object]) -> None:
    go = threading.Event()
    assert worker.submit(go.wait)
    assert worker.take() is None
    assert not worker.submit(lambda: 2)
    go.set()
    assert select.select(worker.filenos, [], [], PATIENCE_S)[0]
    assert not worker.submit(lambda: 2)
    assert worker.take() is True


def test_where_the_system_refuses_a_thread_a_job_is_refused(
    worker: Worker[object], monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def refuse(_thread: threading.Thread) -> None:
        raise RuntimeError("can't start new thread")

    with monkeypatch.context() as patched:
        patched.setattr(threading.Thread, "start", refuse)
        assert not worker.submit(lambda: 1)
    assert "no thread for slow: can't start new thread" in caplog.text
    assert worker.filenos == []
    assert worker.submit(lambda: 1)
    assert worker.take(PATIENCE_S) == 1


def test_a_job_has_no_realtime_priority_or_processors(worker: Worker[object]) -> None:
    processors = os.sched_getaffinity(0)
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(1))
    except PermissionError:
        pytest.skip("SCHED_FIFO is refused here")
    try:
        os.sched_setaffinity(0, {max(processors)})
        assert worker.submit(lambda: (os.sched_getscheduler(0), os.sched_getaffinity(0)))
        found = worker.take(PATIENCE_S)
    finally:
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
        os.sched_setaffinity(0, processors)
    assert found == (os.SCHED_OTHER, processors)
