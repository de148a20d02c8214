"""Run many jobs by joblib: in processes, or on a Dask cluster (extra `cluster`)."""

from __future__ import annotations

import asyncio
import logging
import signal
from collections.abc import Iterator, Sequence
from concurrent.futures import CancelledError
from contextlib import closing, contextmanager
from pathlib import Path

import joblib
from joblib.externals.loky import get_reusable_executor

from graspd.models.training.data.datasets import Grasps
from graspd.models.training.evaluating import jobs
from graspd.models.training.evaluating.jobs import Job, JobResult

CONNECT_TIMEOUT_S = 10
WORKERS_TIMEOUT_S = 60
"""Longest wait for a cluster's first worker, s."""


class ClusterError(Exception):
    """The cluster is gone, or lost a job too often. Finished jobs are kept; try again."""


def run_jobs(
    wanted: Sequence[Job],
    grasps: Grasps,
    folder: Path,
    *,
    processes: int = 1,
    dask: str | None = None,
) -> Iterator[tuple[Job, JobResult]]:
    """Yield each job with its result: first the stored ones, then the others as they end.

    Each result is stored in `folder` before it is yielded, so an interrupted run can continue.
    `processes`: number of jobs at a time. `dask`: address of the scheduler of a Dask cluster, which
    then runs the jobs. Its workers need graspd with the extras `train` and `cluster`, but no folder
    and no data. A job whose worker is lost runs again.

    Raises what `jobs.run` raises, `ClusterError`, and `OSError` if the folder cannot be used.
    """
    folder.mkdir(parents=True, exist_ok=True)
    data = grasps.digest()
    missing = []
    for job in wanted:
        stored = jobs.load(folder, job, data)
        if stored is None:
            missing.append(job)
        else:
            yield job, stored
    if not missing:
        return
    with _on_cluster(dask, grasps) if dask else _on_this_machine(processes) as parallel:
        in_process = dask is None and processes > 1
        outcomes = parallel(joblib.delayed(_run)(job, grasps, in_process) for job in missing)
        with closing(outcomes):  # stops what still runs
            for outcome in outcomes:
                if not isinstance(outcome, tuple):  # what joblib makes of a cancelled task
                    raise ClusterError(f"the cluster lost a job: {outcome!r}")
                job, result = outcome
                jobs.save(folder, job, data, result)
                yield job, result


def _run(job: Job, grasps: Grasps, in_process: bool) -> tuple[Job, JobResult]:
    if in_process:
        # A terminal sends Ctrl-C to the workers, too; it is the first process that ends them.
        signal.signal(signal.SIGINT, signal.SIG_IGN)
    return job, jobs.run(job, grasps)


@contextmanager
def _on_this_machine(processes: int) -> Iterator[joblib.Parallel]:
    try:
        yield _parallel("loky", n_jobs=processes)
    finally:
        if processes > 1:
            get_reusable_executor().shutdown(wait=True, kill_workers=True)


@contextmanager
def _on_cluster(address: str, grasps: Grasps) -> Iterator[joblib.Parallel]:
    from distributed import Client, KilledWorker

    # What it has to say, with a traceback, also comes as an exception.
    logging.getLogger("distributed.client").setLevel(logging.CRITICAL)
    try:
        asyncio.run(_knock(address))
        client = Client(  # type: ignore[no-untyped-call]
            address, timeout=CONNECT_TIMEOUT_S, set_as_default=False
        )
    except (OSError, ValueError) as error:
        raise ClusterError(f"no Dask scheduler at {address}: {_line(error)}") from error
    with client:
        try:
            client.wait_for_workers(1, timeout=WORKERS_TIMEOUT_S)
            # Every worker gets the grasps once, not with each job.
            yield _parallel("dask", client=client, scatter=[grasps], pure=False)
        except KilledWorker as error:
            raise ClusterError(f"a job lost one worker after the other: {_line(error)}") from error
        except (TimeoutError, CancelledError) as error:
            raise ClusterError(f"the cluster does not answer: {_line(error)}") from error


async def _knock(address: str) -> None:
    """Connect once: a client that finds no scheduler would leave its thread running."""
    from distributed.comm.core import connect

    comm = await connect(address, timeout=CONNECT_TIMEOUT_S)  # type: ignore[no-untyped-call]
    comm.abort()


def _parallel(backend: str, **options: object) -> joblib.Parallel:
    with joblib.parallel_config(backend, **options):
        # All at once, so that workers that join later get their share.
        return joblib.Parallel(batch_size=1, pre_dispatch="all", return_as="generator_unordered")


def _line(error: Exception) -> str:
    return " ".join(str(error).split())
