"""Judge held-out grasps by trained systems: one table, with a row for each verdict.

`joblib.Memory` keeps the verdicts. `joblib.parallel_config` says where trainings run: in
processes, or on a Dask cluster.
"""

from __future__ import annotations

import signal
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass
from pathlib import Path

import joblib
import numpy as np
import pandas as pd
from joblib.externals.loky import get_reusable_executor
from joblib.externals.loky.process_executor import TerminatedWorkerError

from graspd.models.inputs import raw_features
from graspd.models.training.data.datasets import Grasps
from graspd.models.training.data.protocols import FOLDS, EvalProtocol, Split, fold_seed, splits
from graspd.models.training.evaluating.days import judged_days, verdicts
from graspd.models.training.fitting.standards import Variant, later_session
from graspd.models.training.fitting.trained import Trained, train
from graspd.models.training.systems.registry import SessionFeatures, System, digest

FORMAT = 2
"""Version of kept verdicts. Increase it if trainings give other verdicts or columns."""
_ONE_AT_A_TIME = threading.Lock()
"""Lock for torch's random state and number of threads, which all threads share."""


class LostWorkerError(Exception):
    """A process or a cluster's worker was lost. Finished trainings are kept; try again."""


@dataclass(frozen=True, slots=True)
class Job:
    """One fold of one protocol for one system."""

    system: System
    protocol: EvalProtocol
    seed: int
    """Seed of the split and, together with the fold, of the training."""
    fold: int
    folds: int = FOLDS

    def causes(self, data: str) -> tuple[object, ...]:
        """Return everything that the verdicts depend on. `data`: digest of the grasps."""
        split = self.protocol, self.seed, self.fold, self.folds
        return (FORMAT, digest(self.system), data, *split)


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


def judged(job: Job, grasps: Grasps) -> pd.DataFrame:
    """Train on a split, on one thread, and return a row for each verdict on a grasp left out.

    Columns: `variant`; `grasp`, its index in `grasps`; `margin`, the uncalibrated log-odds of slip;
    `refused`, true if the daemon would call it `unknown` (missing except in `days`); `age`, the
    grasps that its running session had before. Columns of the training, the same in all rows:
    `fold_name`, `train_grasps`, `parameters` (numbers that the trained system consists of) and
    `seconds` (with judging).

    The result depends on the arguments alone. Raises `TooFewGraspsError` if the data
    lack that split, `ValueError` if the system cannot learn from it.
    """
    split = splits(job.protocol, grasps, job.seed, job.folds)[job.fold]
    seed = fold_seed(job.seed, job.fold)
    grasps = grasps.of_fingers(job.system.fingers)
    # A forest would otherwise send its trees to the cluster that runs this job.
    with _ONE_AT_A_TIME, joblib.parallel_config("sequential"):
        started_s = time.perf_counter()
        trained = train(job.system, grasps.rows(split.train), seed)
        days = job.protocol == "days"
        several = list(
            judged_days(trained, grasps, split.test, seed)
            if days
            else _judged_at_once(trained, grasps, split, seed)
        )
        seconds = time.perf_counter() - started_s
    return pd.concat(several, ignore_index=True).assign(
        fold_name=split.name,
        train_grasps=len(split.train),
        parameters=trained.fitted.parameters,
        seconds=seconds,
    )


def _judged_at_once(
    trained: Trained, grasps: Grasps, split: Split, seed: int
) -> Iterator[pd.DataFrame]:
    """Judge the test grasps of a split; a session system judges those of a later session in all
    `SESSION_VARIANTS`."""
    test, kind, standards = split.test, trained.system.input, trained.standards
    if split.calibration is None or standards is None or not isinstance(kind, SessionFeatures):
        variant = Variant.NONE if standards is None else Variant.TRAINING
        margins = trained.margins(grasps.counts[test], grasps.table_of[test])
        yield verdicts(variant, test, margins)
        return
    features = raw_features(grasps.counts)
    by_variant, ages = later_session(features, test, split.calibration, standards, seed)
    for variant, by in by_variant.items():
        margins = trained.fitted.margins(by.apply(features[test], kind.clip))
        yield verdicts(variant, test, margins, ages=ages.get(variant))


def evaluated(
    wanted: Sequence[Job], grasps: Grasps, folder: Path
) -> Iterator[tuple[Job, pd.DataFrame]]:
    """Yield each job with its rows: first jobs with kept results, then the others as they end.

    The rows are those of `judged`, with the columns `system`, `protocol`, `seed` and `fold`, the
    digests of the system (`digest`) and of all grasps (`data`), and `object`, `table` and `slipped`
    of the grasp.

    Each result is kept in `folder` before it is yielded, so an interrupted run can continue.
    Unreadable results are judged again. On a cluster all computers must share that folder.
    Raises the errors of `judged`, `LostWorkerError`, and `OSError` if the folder cannot be used.
    """
    folder.mkdir(parents=True, exist_ok=True)
    kept = joblib.Memory(folder, verbose=0).cache(_judged, ignore=["job", "grasps"])
    data, missing = grasps.digest(), []
    for job in wanted:
        if kept.check_call_in_cache(job.causes(data), job, grasps):
            yield job, _described(job, kept(job.causes(data), job, grasps), grasps, data)
        else:
            missing.append(job)
    # All are submitted at once, so that computers that join later get a share.
    parallel = joblib.Parallel(return_as="generator_unordered", pre_dispatch="all", batch_size=1)
    work = (joblib.delayed(_with_job)(kept, job.causes(data), job, grasps) for job in missing)
    with closing(parallel(work)) as outcomes:  # stops running trainings
        for outcome in outcomes:
            if isinstance(outcome, BaseException):  # joblib's result of a cancelled task
                raise outcome
            job, rows = outcome
            yield job, _described(job, rows, grasps, data)


@contextmanager
def processes(number: int) -> Iterator[None]:
    """Run `number` trainings at once, in processes that end with the block; 1: in this process.
    Raises `LostWorkerError` if one is killed."""
    try:
        with joblib.parallel_config("loky", n_jobs=number, initializer=_leave_ctrl_c):
            yield
    except TerminatedWorkerError as error:
        raise LostWorkerError("a process was killed, for want of memory perhaps") from error
    finally:
        if number > 1:
            get_reusable_executor().shutdown(wait=True, kill_workers=True)


def _leave_ctrl_c() -> None:
    # A terminal sends Ctrl-C also to the workers, which must leave it to the first process.
    signal.signal(signal.SIGINT, signal.SIG_IGN)


def _judged(causes: tuple[object, ...], job: Job, grasps: Grasps) -> pd.DataFrame:
    """Return the verdicts of a job; `causes` is the key under which they are kept."""
    return judged(job, grasps)


def _with_job(
    kept: joblib.memory.MemorizedFunc, causes: tuple[object, ...], job: Job, grasps: Grasps
) -> tuple[Job, pd.DataFrame]:
    return job, kept(causes, job, grasps)


def _described(job: Job, rows: pd.DataFrame, grasps: Grasps, data: str) -> pd.DataFrame:
    """Return the rows of a job with columns on job and grasp, which are not kept with them."""
    of_grasp = rows["grasp"].to_numpy()
    names = np.array([file.name for file in grasps.files])
    return rows.assign(
        system=job.system.name,
        protocol=job.protocol,
        seed=job.seed,
        fold=job.fold,
        digest=digest(job.system),
        data=data,
        object=np.array(grasps.objects)[of_grasp],
        table=names[grasps.table_of[of_grasp]],
        slipped=grasps.slipped[of_grasp],
    )
