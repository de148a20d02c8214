"""Run trainings that judge held-out grasps; store each result by a digest of its causes.

Many run by joblib: in processes, or on a Dask cluster (extra `cluster`).
"""

from __future__ import annotations

import asyncio
import hashlib
import io
import json
import logging
import signal
import threading
import time
import zipfile
from collections.abc import Iterator, Sequence
from concurrent.futures import CancelledError
from contextlib import closing, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import joblib
import numpy as np
from joblib.externals.loky import get_reusable_executor
from numpy.typing import DTypeLike

from graspd.models.inputs import raw_features
from graspd.models.runtime import one_line
from graspd.models.training.arrays import Bools, Floats, Ints
from graspd.models.training.data.datasets import Grasps
from graspd.models.training.data.protocols import FOLDS, EvalProtocol, fold_seed, splits
from graspd.models.training.evaluating.days import judged_days
from graspd.models.training.evaluating.files import write_whole
from graspd.models.training.fitting.standards import NONE, TRAINING, later_session
from graspd.models.training.fitting.trained import train
from graspd.models.training.systems.registry import SessionFeatures, System, digest

FORMAT = 1
"""Version of results; raise it if a job gives another result, or its file changes."""
MAX_FILE_BYTES = 64 * 2**20
"""Largest result file, bytes; 4682 grasps in 8 variants take 0.4 MB."""
CONNECT_TIMEOUT_S = 10
WORKERS_TIMEOUT_S = 60
"""Longest wait for a cluster's first worker, s."""
_ONE_AT_A_TIME = threading.Lock()
"""Lock of torch's random state and number of threads, which the process shares."""

_BY_VARIANT: dict[str, DTypeLike] = {"margins": np.float64, "ages": np.int64, "refused": np.bool_}
"""Types of the arrays that a result has for each variant."""

_log = logging.getLogger(__name__)


class ClusterError(Exception):
    """The cluster is gone, or lost a job too often. Finished jobs are kept; try again."""


@dataclass(frozen=True, slots=True)
class Job:
    """One fold of one protocol for one system."""

    system: System
    protocol: EvalProtocol
    seed: int
    """Seed of the split and, together with the fold, of the training."""
    fold: int
    folds: int = FOLDS

    def key(self, data: str) -> str:
        """Return the SHA-256 of everything that the result depends on. `data`: a digest."""
        parts = [FORMAT, digest(self.system), self.protocol, self.seed, self.fold]
        text = json.dumps([*parts, self.folds, data])
        return hashlib.sha256(text.encode()).hexdigest()

    def file_name(self, data: str) -> str:
        """Return the name of the stored result, unique for job and data. `data`: a digest."""
        readable = f"{self.system.name}.{self.protocol}.{self.seed}.{self.fold}"
        return f"{readable}.{self.key(data)[:16]}.npz"


def jobs_of(
    system: System, protocol: EvalProtocol, grasps: Grasps, seeds: Sequence[int], folds: int
) -> list[Job]:
    """Return the jobs of a system in a protocol: all folds of the first seed, then of the next.
    Raises `TooFewGraspsError` if the grasps do not have the splits."""
    return [
        Job(system, protocol, seed, fold, folds)
        for seed in seeds
        for fold in range(len(splits(protocol, grasps, seed, folds)))
    ]


@dataclass(frozen=True, slots=True, eq=False)
class JobResult:
    """Verdicts of a trained system on the test grasps of a job."""

    test: Ints
    """Indices (n,) of the grasps, ascending."""
    margins: dict[str, Floats]
    """By variant: uncalibrated log-odds of slip (n,)."""
    train_grasps: int
    seconds: float
    """Time of training and judging, s."""
    parameters: int
    """Number of parameters of the trained system."""
    ages: dict[str, Ints] = field(default_factory=dict)
    """Grasps (n,) that the session had before each one, by running variant."""
    refused: dict[str, Bools] = field(default_factory=dict)
    """Grasps (n,) that the daemon would refuse, by variant; only in `days`."""

    def to_bytes(self) -> bytes:
        """Return a .npz file without pickled objects."""
        meta = {
            "format": FORMAT,
            "train_grasps": self.train_grasps,
            "seconds": self.seconds,
            "parameters": self.parameters,
        }
        arrays = {
            f"{kind}.{variant}": values
            for kind in _BY_VARIANT
            for variant, values in getattr(self, kind).items()
        }
        text = np.frombuffer(json.dumps(meta).encode(), np.uint8)
        file = io.BytesIO()
        np.savez(file, allow_pickle=False, test=self.test, meta=text, **arrays)
        return file.getvalue()

    @classmethod
    def from_bytes(cls, data: bytes) -> JobResult:
        """Return the result in `data`, from `to_bytes`. Raises `ValueError`."""
        try:
            with np.load(io.BytesIO(data), allow_pickle=False) as arrays:
                meta = json.loads(arrays["meta"].tobytes())
                if meta["format"] != FORMAT:
                    raise ValueError(f"format {meta['format']}, not {FORMAT}")
                by_variant: dict[str, dict[str, Any]] = {kind: {} for kind in _BY_VARIANT}
                for name in arrays.files:
                    kind, _, variant = name.partition(".")
                    if variant:
                        by_variant[kind][variant] = arrays[name].astype(_BY_VARIANT[kind])
                return cls(
                    test=arrays["test"].astype(np.int64),
                    train_grasps=int(meta["train_grasps"]),
                    seconds=float(meta["seconds"]),
                    parameters=int(meta["parameters"]),
                    **by_variant,
                )
        except (OSError, EOFError, ValueError, TypeError, KeyError, zipfile.BadZipFile) as error:
            raise ValueError(f"is no result of a job: {error}") from error


def run(job: Job, grasps: Grasps) -> JobResult:
    """Train on a split and judge the grasps left out, on one thread.

    Depends on the arguments alone, whatever runs beside it. Raises `TooFewGraspsError` if the data
    do not have that split, `ValueError` if the system cannot learn from it.
    """
    split = splits(job.protocol, grasps, job.seed, job.folds)[job.fold]
    system, seed = job.system, fold_seed(job.seed, job.fold)
    grasps = grasps.of_fingers(system.fingers)
    counts, table_of = grasps.counts[split.test], grasps.table_of[split.test]
    ages: dict[str, Ints] = {}
    refused: dict[str, Bools] = {}
    # A forest would otherwise send its trees back to the cluster that this job came from.
    with _ONE_AT_A_TIME, joblib.parallel_config("sequential"):
        started_s = time.perf_counter()
        trained = train(system, grasps.rows(split.train), seed)
        if job.protocol == "days":
            margins, refused, ages = judged_days(trained, grasps, split.test, seed)
        elif trained.standards is None or not isinstance(system.input, SessionFeatures):
            margins = {NONE: trained.margins(counts, table_of)}
        elif split.calibration is None:
            margins = {TRAINING: trained.margins(counts, table_of)}
        else:
            features, clip = raw_features(grasps.counts), system.input.clip
            by_variant, ages = later_session(
                features, split.test, split.calibration, trained.standards, seed
            )
            margins = {
                variant: trained.fitted.margins(by.apply(features[split.test], clip))
                for variant, by in by_variant.items()
            }
        seconds = time.perf_counter() - started_s
    numbers = len(split.train), seconds, trained.fitted.parameters
    return JobResult(split.test, margins, *numbers, ages, refused)


def load(folder: Path, job: Job, data: str) -> JobResult | None:
    """Return the stored result of a job on data of this digest.
    None: nothing is stored, or what is stored is broken, which is logged."""
    path = folder / job.file_name(data)
    try:
        if path.stat().st_size > MAX_FILE_BYTES:
            raise ValueError("is too large")
        return JobResult.from_bytes(path.read_bytes())
    except FileNotFoundError:
        return None
    except ValueError as error:
        _log.warning("%s %s; it is run again", path, error)
        return None


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
    and no data. A job whose worker is lost runs again, or ends the run with `ClusterError`: what is
    stored by then is not run again.

    Raises what `run` raises, `ClusterError`, and `OSError` if the folder cannot be used.
    """
    folder.mkdir(parents=True, exist_ok=True)
    data = grasps.digest()
    missing = []
    for job in wanted:
        stored = load(folder, job, data)
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
                write_whole(folder / job.file_name(data), result.to_bytes())
                yield job, result


def _run(job: Job, grasps: Grasps, in_process: bool) -> tuple[Job, JobResult]:
    if in_process:
        # A terminal sends Ctrl-C to the workers, too; it is the first process that ends them.
        signal.signal(signal.SIGINT, signal.SIG_IGN)
    return job, run(job, grasps)


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
        raise ClusterError(f"no Dask scheduler at {address}: {one_line(error)}") from error
    with client:
        try:
            client.wait_for_workers(1, timeout=WORKERS_TIMEOUT_S)
            # Every worker gets the grasps once, not with each job.
            yield _parallel("dask", client=client, scatter=[grasps], pure=False)
        except KilledWorker as error:
            raise ClusterError(f"a job lost several workers: {one_line(error)}") from error
        except TimeoutError as error:
            raise ClusterError(f"the cluster does not answer: {one_line(error)}") from error
        except CancelledError as error:
            raise ClusterError(f"the cluster lost a job: {one_line(error)}") from error


async def _knock(address: str) -> None:
    """Connect once: a client that finds no scheduler would leave its thread running."""
    from distributed.comm.core import connect

    comm = await connect(address, timeout=CONNECT_TIMEOUT_S)  # type: ignore[no-untyped-call]
    comm.abort()


def _parallel(backend: str, **options: object) -> joblib.Parallel:
    with joblib.parallel_config(backend, **options):
        # All at once, so that workers that join later get their share.
        return joblib.Parallel(batch_size=1, pre_dispatch="all", return_as="generator_unordered")
