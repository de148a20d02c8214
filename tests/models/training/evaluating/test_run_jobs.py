"""Sweeps: here, on a cluster that loses a worker, and after an interruption."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("torch", reason="needs the extra `train`")

from graspd.models.contract import VectorInput
from graspd.models.training.data.datasets import Grasps
from graspd.models.training.estimators.configs import ForestConfig
from graspd.models.training.evaluating import jobs
from graspd.models.training.evaluating.jobs import ClusterError, Job, JobResult, run_jobs
from graspd.models.training.systems.registry import System
from tests.models.training.samples import sessions

GRASPS = sessions(120)
ROOT = Path(__file__).parents[4]
START_S = 100.0
"""How long a scheduler or a worker may take to start on a busy machine."""


def forest(trees: int) -> System:
    return System(f"forest-{trees}", "A random forest.", VectorInput(), ForestConfig(trees, None))


def some_jobs(number: int, trees: int = 5) -> list[Job]:
    return [Job(forest(trees), "cv", seed, fold, 4) for seed in range(number) for fold in range(4)][
        :number
    ]


def assert_same(ours: dict[Job, JobResult], theirs: dict[Job, JobResult]) -> None:
    assert ours.keys() == theirs.keys()
    for job, one in ours.items():
        other = theirs[job]
        assert np.array_equal(one.test, other.test)
        assert one.margins.keys() == other.margins.keys()
        for variant, margins in one.margins.items():
            assert np.array_equal(margins, other.margins[variant])


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
        list(run_jobs(wanted, GRASPS, tmp_path))
    assert len(list(tmp_path.iterdir())) == 3
    stop_after.clear()
    results = dict(run_jobs(wanted, GRASPS, tmp_path))
    assert ran == wanted
    assert_same(results, {job: run(job, GRASPS) for job in wanted})


def test_a_cluster_may_lose_a_worker_and_then_its_scheduler(tmp_path: Path) -> None:
    pytest.importorskip("distributed", reason="needs the extra `cluster`")
    wanted, more = some_jobs(8, trees=40), some_jobs(8, trees=30)
    found: dict[Job, JobResult] = {}
    with cluster(tmp_path) as (address, scheduler, workers):
        results = run_jobs(wanted, GRASPS, tmp_path / "ours", dask=address)
        next(results)
        workers[0].kill()
        # Dask runs a lost job again, or cancels it: then the next run has what is stored.
        with contextlib.suppress(ClusterError):
            found.update(results)
        assert workers[0].wait(START_S) == -signal.SIGKILL
        found.update(run_jobs(wanted, GRASPS, tmp_path / "ours", dask=address))
        assert workers[1].poll() is workers[2].poll() is None
        results = run_jobs(more, GRASPS, tmp_path / "more", dask=address)
        next(results)
        scheduler.kill()
        with pytest.raises(ClusterError, match=r"the cluster (does not answer|lost a job)"):
            list(results)
    assert_same(found, {job: jobs.run(job, GRASPS) for job in wanted})
    assert_same(dict(run_jobs(wanted, GRASPS, tmp_path / "ours")), found)
    assert 1 <= len(list((tmp_path / "more").iterdir())) < 8


Process = subprocess.Popen[bytes]


@contextlib.contextmanager
def cluster(folder: Path) -> Iterator[tuple[str, Process, list[Process]]]:
    """Address, scheduler and three workers, each a process of its own, on loopback."""
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
        options = ("--nthreads", "1", "--no-nanny", "--no-dashboard")
        running = [
            stack.enter_context(started("dask_worker", address, *options, folder=folder))
            for _ in range(3)
        ]
        with distributed.Client(  # type: ignore[no-untyped-call]
            address, timeout=START_S, set_as_default=False
        ) as client:
            client.wait_for_workers(3, timeout=START_S)
        yield address, scheduler, running


@contextlib.contextmanager
def started(module: str, *arguments: str, folder: Path) -> Iterator[Process]:
    environment = os.environ | {"OMP_NUM_THREADS": "1", "PYTHONPATH": str(ROOT)}
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
