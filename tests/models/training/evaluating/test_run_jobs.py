"""Sweeps: here, on a cluster, and after an interruption."""

from __future__ import annotations

import contextlib
import subprocess
import sys
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
CLUSTER = """
from distributed import LocalCluster
with LocalCluster(
    n_workers=1, threads_per_worker=2, processes=False, protocol="tcp://", host="127.0.0.1",
    dashboard_address=None,
) as cluster:
    print(cluster.scheduler_address, flush=True)
    input()
"""


@contextlib.contextmanager
def cluster() -> Iterator[str]:
    """The address of a scheduler and its worker, in a process of their own."""
    words = [sys.executable, "-c", CLUSTER]
    with subprocess.Popen(
        words, text=True, stdin=subprocess.PIPE, stdout=subprocess.PIPE
    ) as process:
        try:
            assert process.stdout is not None
            yield process.stdout.readline().strip()
        finally:
            process.kill()


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


def test_a_cluster_gives_what_this_computer_gives(tmp_path: Path) -> None:
    pytest.importorskip("distributed", reason="needs the extra `cluster`")
    wanted = some_jobs(4)
    with cluster() as address:
        found = dict(run_jobs(wanted, GRASPS, tmp_path, dask=address))
    assert_same(found, {job: jobs.run(job, GRASPS) for job in wanted})


def test_a_job_that_the_cluster_lost_ends_the_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    distributed = pytest.importorskip("distributed", reason="needs the extra `cluster`")

    def lost(*_: object) -> None:
        raise distributed.client.FutureCancelledError("key", "already forgotten")

    monkeypatch.setattr(jobs, "_run", lost)
    with (
        cluster() as address,
        pytest.raises(ClusterError, match="the cluster lost a job"),
    ):
        list(run_jobs(some_jobs(2), GRASPS, tmp_path, dask=address))
