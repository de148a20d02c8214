"""Jobs on a Dask cluster, through joblib's Dask backend (extra: cluster)."""

from __future__ import annotations

import asyncio
import logging
import uuid
from collections.abc import Iterator, Sequence
from concurrent.futures import CancelledError
from contextlib import contextmanager

import joblib
from distributed import Client, KilledWorker, WorkerPlugin, get_worker
from distributed.comm.core import connect
from joblib._dask import DaskDistributedBackend

from models.training.data.datasets import Grasps
from models.training.evaluating import jobs
from models.training.evaluating.jobs import ClusterError, Job, Outcomes

CONNECT_TIMEOUT_S = 10
WORKERS_TIMEOUT_S = 60
"""How long a cluster may take to show its first worker."""


class GraspsPlugin(WorkerPlugin):
    """The grasps, handed to each worker when it joins: they outlive every worker."""

    def __init__(self, name: str, grasps: Grasps) -> None:
        self.name = name
        self.grasps = grasps


class _Backend(DaskDistributedBackend):  # type: ignore[misc]
    """Joblib runs the jobs of a cluster of one thread here instead: say that there are two."""

    def effective_n_jobs(self, n_jobs: int) -> int:
        """How many jobs to have at a time, at least two."""
        found: int = super().effective_n_jobs(n_jobs)
        return max(2, found)


@contextmanager
def on_cluster(missing: Sequence[Job], grasps: Grasps, address: str) -> Iterator[Outcomes]:
    """Run the jobs on all workers of the scheduler at this address.

    Raises `ClusterError` if it or its workers are not there, or a job costs several workers.
    """
    name = f"graspd-{uuid.uuid4().hex}"
    with _client(address) as client:
        client.register_plugin(GraspsPlugin(name, grasps))
        try:
            backend = _Backend(
                client=client, wait_for_workers_timeout=WORKERS_TIMEOUT_S, pure=False
            )
            with joblib.parallel_config(backend):
                yield _outcomes(missing, name)
        finally:
            if client.status == "running":
                client.unregister_worker_plugin(name)  # type: ignore[no-untyped-call]


@contextmanager
def _client(address: str) -> Iterator[Client]:
    # What it has to say, with a traceback, also comes as an exception.
    logging.getLogger("distributed.client").setLevel(logging.CRITICAL)
    try:
        asyncio.run(_knock(address))
        client = Client(  # type: ignore[no-untyped-call]
            address, timeout=CONNECT_TIMEOUT_S, set_as_default=False
        )
    except (OSError, ValueError) as error:
        raise ClusterError(f"no Dask scheduler at {address}: {_line(error)}") from error
    try:
        yield client
    finally:
        client.close()  # type: ignore[no-untyped-call]


async def _knock(address: str) -> None:
    """A client that finds nobody would leave its thread running."""
    comm = await connect(  # type: ignore[no-untyped-call]
        address, timeout=CONNECT_TIMEOUT_S
    )
    comm.abort()


def _outcomes(missing: Sequence[Job], name: str) -> Outcomes:
    # All at once, so that workers that join later get their share.
    parallel = joblib.Parallel(batch_size=1, pre_dispatch="all", return_as="generator_unordered")
    try:
        outcomes = parallel(
            joblib.delayed(_on_worker)(place, job, name) for place, job in enumerate(missing)
        )
        for outcome in outcomes:
            if not isinstance(outcome, tuple):  # what joblib makes of a task that was cancelled
                raise ClusterError(f"the cluster lost a job: {outcome!r}")
            yield outcome
    except KilledWorker as error:
        raise ClusterError(f"a job lost one worker after the other: {_line(error)}") from error
    except (TimeoutError, CancelledError) as error:
        raise ClusterError(f"the cluster does not answer: {_line(error)}") from error


def _line(error: Exception) -> str:
    return " ".join(str(error).split())


def _on_worker(place: int, job: Job, name: str) -> tuple[int, bytes]:
    plugin = get_worker().plugins[name]
    if not isinstance(plugin, GraspsPlugin):
        raise TypeError(f"{name} is not the grasps")
    return jobs.run_numbered(place, job, plugin.grasps)
