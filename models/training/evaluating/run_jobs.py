"""Many jobs at once, on this machine or on a Dask cluster; what is finished is never run again."""

from __future__ import annotations

import signal
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from pathlib import Path

import joblib
from joblib.externals.loky import get_reusable_executor

from models.training.data.datasets import Grasps
from models.training.evaluating import jobs
from models.training.evaluating.jobs import Job, JobResult, Outcomes

OnResult = Callable[[int, JobResult], None]
"""Called with the index of each job and its result, as they come."""


def run_jobs(
    wanted: Sequence[Job],
    grasps: Grasps,
    folder: Path,
    *,
    processes: int = 1,
    dask: str | None = None,
    on_result: OnResult | None = None,
) -> list[JobResult]:
    """Results of all jobs in their order: read from `folder` where it has them, else run now.

    Each result is in the folder as soon as it is known, so an interrupted call goes on where it
    was. Runs `processes` jobs at a time, or on the Dask cluster whose scheduler has the address
    `dask`; its workers need graspd with the extras `train` and `cluster`, but no folder and no
    data. A job whose worker is lost runs again. `on_result` is called for stored results, too.

    Raises what `jobs.run` raises, `ClusterError`, and `OSError` if the folder cannot be used.
    """
    folder.mkdir(parents=True, exist_ok=True)
    data = grasps.digest()
    results: dict[int, JobResult] = {}

    def done(index: int, result: JobResult) -> None:
        results[index] = result
        if on_result is not None:
            on_result(index, result)

    for index, job in enumerate(wanted):
        stored = jobs.load(folder, job, data)
        if stored is not None:
            done(index, stored)
    missing = [index for index in range(len(wanted)) if index not in results]
    with _outcomes([wanted[index] for index in missing], grasps, processes, dask) as outcomes:
        for place, content in outcomes:
            index = missing[place]
            result = JobResult.from_bytes(content)
            jobs.save(folder, wanted[index], data, content)
            done(index, result)
    return [results[index] for index in range(len(wanted))]


def _outcomes(
    missing: Sequence[Job], grasps: Grasps, processes: int, dask: str | None
) -> AbstractContextManager[Outcomes]:
    if not missing:
        return nullcontext(iter(()))
    if dask is not None:
        from models.training.evaluating.cluster import on_cluster

        return on_cluster(missing, grasps, dask)
    if processes == 1:
        return nullcontext(
            jobs.run_numbered(place, job, grasps) for place, job in enumerate(missing)
        )
    return _in_processes(missing, grasps, processes)


@contextmanager
def _in_processes(missing: Sequence[Job], grasps: Grasps, processes: int) -> Iterator[Outcomes]:
    parallel = joblib.Parallel(
        n_jobs=processes, backend="loky", batch_size=1, return_as="generator_unordered"
    )
    outcomes = parallel(
        joblib.delayed(_in_worker)(place, job, grasps) for place, job in enumerate(missing)
    )
    try:
        yield outcomes
    finally:
        outcomes.close()  # stops what still runs
        get_reusable_executor().shutdown(wait=True, kill_workers=True)


def _in_worker(place: int, job: Job, grasps: Grasps) -> tuple[int, bytes]:
    # A terminal sends Ctrl-C to the workers, too; it is the first process that ends them.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    return jobs.run_numbered(place, job, grasps)
