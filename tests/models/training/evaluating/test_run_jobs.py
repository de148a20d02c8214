"""Sweeps: here, in processes, on a cluster that loses a worker, and after an interruption."""

from __future__ import annotations

import contextlib
import json
import logging
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("torch", reason="the train extra is not installed")
pytest.importorskip("skl2onnx", reason="the train extra is not installed")

import joblib
from joblib.externals.loky import get_reusable_executor

from models.contract import VectorInput
from models.training.data.datasets import Grasps
from models.training.estimators.classical import ForestConfig
from models.training.evaluating import jobs
from models.training.evaluating.jobs import ClusterError, Job, JobResult
from models.training.evaluating.run_jobs import run_jobs
from models.training.systems.system import System
from tests.models.training.evaluation_samples import sessions

GRASPS = sessions(120)
ROOT = Path(__file__).parents[4]
START_S = 100.0
"""How long a scheduler or a worker may take to start on a busy machine."""


@pytest.fixture(scope="module", autouse=True)
def helpers_of_joblib_run() -> None:
    """Joblib's resource tracker stays for the life of the process, with its pipes."""
    joblib.Parallel(n_jobs=2, backend="loky")(joblib.delayed(abs)(value) for value in (1, 2))
    get_reusable_executor().shutdown(wait=True)


def forest(trees: int) -> System:
    return System(f"forest-{trees}", "A random forest.", VectorInput(), ForestConfig(trees, None))


def some_jobs(number: int, trees: int = 5) -> list[Job]:
    return [Job(forest(trees), "cv", seed, fold, 4) for seed in range(number) for fold in range(4)][
        :number
    ]


def assert_same(ours: list[JobResult], theirs: list[JobResult]) -> None:
    for one, other in zip(ours, theirs, strict=True):
        assert np.array_equal(one.test, other.test)
        assert one.margins.keys() == other.margins.keys()
        for variant, margins in one.margins.items():
            assert np.array_equal(margins, other.margins[variant])


def test_two_processes_give_what_one_gives_bit_for_bit(tmp_path: Path) -> None:
    wanted = some_jobs(6)
    alone = run_jobs(wanted, GRASPS, tmp_path / "one")
    both = run_jobs(wanted, GRASPS, tmp_path / "two", processes=2)
    assert_same(both, alone)
    names = {path.name for path in (tmp_path / "one").iterdir()}
    assert names == {path.name for path in (tmp_path / "two").iterdir()}
    assert len(names) == 6


def test_results_come_in_the_order_of_the_jobs(tmp_path: Path) -> None:
    wanted = some_jobs(4)
    forth = run_jobs(wanted, GRASPS, tmp_path)
    back = run_jobs(wanted[::-1], GRASPS, tmp_path)
    assert_same(forth, back[::-1])
    assert_same(forth, [jobs.run(job, GRASPS) for job in wanted])


def test_an_interrupted_sweep_goes_on_and_runs_nothing_twice(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    wanted, run = some_jobs(5), jobs.run
    ran: list[Job] = []
    stop_after = [3]

    def counted(job: Job, grasps: Grasps) -> JobResult:
        if len(ran) in stop_after:
            raise KeyboardInterrupt
        ran.append(job)
        return run(job, grasps)

    monkeypatch.setattr(jobs, "run", counted)
    with pytest.raises(KeyboardInterrupt):
        run_jobs(wanted, GRASPS, tmp_path)
    assert len(list(tmp_path.iterdir())) == 3
    stop_after.clear()
    results = run_jobs(wanted, GRASPS, tmp_path)
    assert ran == wanted
    assert_same(results, [run(job, GRASPS) for job in wanted])


def test_every_job_is_told_once_stored_or_run(tmp_path: Path) -> None:
    wanted = some_jobs(4)
    run_jobs(wanted[:2], GRASPS, tmp_path)
    told: list[int] = []
    results = run_jobs(wanted, GRASPS, tmp_path, on_result=lambda index, _: told.append(index))
    assert sorted(told) == [0, 1, 2, 3]
    assert len(told) == len(results) == 4


def test_a_broken_result_is_run_again_with_a_warning(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    wanted = some_jobs(2)
    first = run_jobs(wanted, GRASPS, tmp_path)
    path = tmp_path / wanted[1].file_name(GRASPS.digest())
    path.write_bytes(path.read_bytes()[:-100])
    with caplog.at_level(logging.WARNING):
        assert_same(run_jobs(wanted, GRASPS, tmp_path), first)
    assert [record.getMessage().endswith("it is run again") for record in caplog.records] == [True]
    caplog.clear()
    run_jobs(wanted, GRASPS, tmp_path)
    assert not caplog.records


def test_a_cluster_that_is_not_there_is_said_so(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    ours = pytest.importorskip("models.training.evaluating.cluster", reason="no extra: cluster")
    monkeypatch.setattr(ours, "CONNECT_TIMEOUT_S", 1)
    with pytest.raises(ClusterError, match=r"no Dask scheduler at tcp://127\.0\.0\.1:9"):
        run_jobs(some_jobs(1), GRASPS, tmp_path, dask="tcp://127.0.0.1:9")


def test_a_cluster_that_loses_a_worker_loses_no_result(tmp_path: Path) -> None:
    pytest.importorskip("distributed", reason="no extra: cluster")
    wanted = some_jobs(12, trees=40)
    alone = run_jobs(wanted, GRASPS, tmp_path / "alone")
    killed: list[int] = []
    with cluster(tmp_path, workers=2) as (address, _, workers):

        def kill_one(index: int, _result: JobResult) -> None:
            if not killed:
                workers[0].kill()
                killed.append(index)

        ours = run_jobs(wanted, GRASPS, tmp_path / "ours", dask=address, on_result=kill_one)
        assert workers[0].wait(START_S) == -signal.SIGKILL
        assert workers[1].poll() is None
    assert len(killed) == 1
    assert_same(ours, alone)
    stored = [jobs.load(tmp_path / "ours", job, GRASPS.digest()) for job in wanted]
    assert_same([result for result in stored if result is not None], alone)


def test_a_cluster_that_dies_leaves_what_was_finished(tmp_path: Path) -> None:
    pytest.importorskip("distributed", reason="no extra: cluster")
    wanted = some_jobs(12, trees=30)
    told: list[int] = []
    with cluster(tmp_path, workers=1) as (address, scheduler, _):

        def kill_scheduler(index: int, _result: JobResult) -> None:
            told.append(index)
            if len(told) == 3:
                scheduler.kill()

        with pytest.raises(ClusterError, match="the cluster does not answer"):
            run_jobs(wanted, GRASPS, tmp_path / "ours", dask=address, on_result=kill_scheduler)
    stored = len(list((tmp_path / "ours").iterdir()))
    assert 3 <= stored == len(told) < 12
    finished = run_jobs(wanted, GRASPS, tmp_path / "ours")
    assert_same(finished, [jobs.run(job, GRASPS) for job in wanted])


Process = subprocess.Popen[bytes]


@contextlib.contextmanager
def cluster(folder: Path, workers: int) -> Iterator[tuple[str, Process, list[Process]]]:
    """Address, scheduler and workers, each a process of its own, on loopback."""
    import distributed

    place = folder / "scheduler.json"
    with contextlib.ExitStack() as stack:
        scheduler = stack.enter_context(
            started(
                *("dask_scheduler", "--host", "127.0.0.1", "--port", "0", "--no-dashboard"),
                *("--dashboard-address", "127.0.0.1:0", "--scheduler-file", str(place)),
                folder=folder,
            )
        )
        address = _address(place)
        options = (
            "--nthreads",
            "1",
            "--no-nanny",
            "--no-dashboard",
            "--local-directory",
            str(folder),
        )
        running = [
            stack.enter_context(started("dask_worker", address, *options, folder=folder))
            for _ in range(workers)
        ]
        with distributed.Client(  # type: ignore[no-untyped-call]
            address, timeout=START_S, set_as_default=False
        ) as client:
            client.wait_for_workers(workers, timeout=START_S)
        yield address, scheduler, running


@contextlib.contextmanager
def started(module: str, *arguments: str, folder: Path) -> Iterator[Process]:
    environment = os.environ | {
        "OMP_NUM_THREADS": "1",
        "PYTHONPATH": str(Path(__file__).parents[4]),
    }
    with (folder / "cluster.log").open("ab") as log:
        process = subprocess.Popen(
            [sys.executable, "-m", f"distributed.cli.{module}", *arguments],
            cwd=folder,
            env=environment,
            stdout=log,
            stderr=log,
        )
    try:
        yield process
    finally:
        process.kill()
        process.wait(START_S)


def _address(place: Path) -> str:
    deadline_s = time.monotonic() + START_S
    while time.monotonic() < deadline_s:
        with contextlib.suppress(FileNotFoundError, json.JSONDecodeError):
            address = json.loads(place.read_text())["address"]
            assert isinstance(address, str)
            return address
        time.sleep(0.05)
    pytest.fail("the scheduler did not start")
