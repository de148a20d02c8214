"""Trainings are pure, kept and never run twice, and a session is judged in several variants."""

from __future__ import annotations

import contextlib
import dataclasses
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import joblib
import pandas as pd
import pytest
from joblib.externals.loky.process_executor import TerminatedWorkerError
from sklearn.neural_network import MLPClassifier

pytest.importorskip("torch", reason="needs the extra `train`")

from graspd.models.contract import VectorInput
from graspd.models.training.data.datasets import Grasps
from graspd.models.training.estimators.configs import ForestConfig, MlpConfig, SvmConfig
from graspd.models.training.evaluating import frame
from graspd.models.training.evaluating.broken import KINDS, NUMBERS, broken_study
from graspd.models.training.evaluating.frame import (
    Job,
    LostWorkerError,
    evaluated,
    judged,
    processes,
)
from graspd.models.training.fitting.standards import SESSION_VARIANTS
from graspd.models.training.systems.registry import SYSTEMS, SessionFeatures, System
from tests.models.training.samples import sessions

GRASPS = sessions(200)
SVM = System("svm", VectorInput(), SvmConfig(3.0, 0.01))
SESSION_SVM = System("svm-s", SessionFeatures(), SvmConfig(3.0, 0.003))
SESSION_JOB = Job(SESSION_SVM, "session", 0, 1, 4)
FOREST = System("forest", VectorInput(), ForestConfig(5, None))
JOBS = [Job(FOREST, "cv", 0, fold, 4) for fold in range(4)]
CLUSTER = """
import graspd.models.training.evaluating.frame  # not while the scheduler has to answer
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
    """Run a scheduler and its worker in another process during the block. Yields the address."""
    words = [sys.executable, "-c", CLUSTER]
    with subprocess.Popen(
        words, text=True, stdin=subprocess.PIPE, stdout=subprocess.PIPE
    ) as process:
        try:
            assert process.stdout is not None
            yield process.stdout.readline().strip()
        finally:
            process.kill()


def same(one: pd.DataFrame, other: pd.DataFrame) -> bool:
    """True if two tables of verdicts are equal, except for their `seconds`."""
    assert list(one) == list(other)
    return bool(one.drop(columns="seconds").equals(other.drop(columns="seconds")))


@pytest.fixture(scope="module")
def rows() -> pd.DataFrame:
    return judged(SESSION_JOB, GRASPS)


def test_the_cache_key_has_everything_that_changes_verdicts() -> None:
    job = Job(SVM, "cv", 0, 0)
    others = [
        dataclasses.replace(job, system=dataclasses.replace(SVM, estimator=SvmConfig(3.0, 0.02))),
        dataclasses.replace(job, system=SESSION_SVM),
        dataclasses.replace(job, protocol="objects"),
        dataclasses.replace(job, seed=1),
        dataclasses.replace(job, fold=1),
        dataclasses.replace(job, folds=5),
    ]
    causes = {job.causes("data"), job.causes("other"), *(one.causes("data") for one in others)}
    assert len(causes) == len(others) + 2
    renamed = dataclasses.replace(job, system=dataclasses.replace(SVM, name="other"))
    assert renamed.causes("data") == job.causes("data")


def test_labels_of_the_judged_session_do_not_change_verdicts(rows: pd.DataFrame) -> None:
    slipped = GRASPS.slipped.copy()
    slipped[GRASPS.table_of == 2] ^= True
    assert same(rows, judged(SESSION_JOB, dataclasses.replace(GRASPS, slipped=slipped)))


def test_only_a_session_system_in_session_protocols_has_several_variants(
    rows: pd.DataFrame,
) -> None:
    assert set(rows["variant"]) == set(SESSION_VARIANTS)
    assert set(rows["variant"][rows["age"].notna()]) == {"running", "running-sorted"}
    assert rows["refused"].isna().all()
    assert set(judged(Job(SVM, "session", 0, 1, 4), GRASPS)["variant"]) == {"none"}
    assert set(judged(Job(SESSION_SVM, "cv", 0, 1, 4), GRASPS)["variant"]) == {"training"}


def test_session_calibration_reaches_good_accuracy_despite_drift(rows: pd.DataFrame) -> None:
    right = (rows["margin"] > 0.0) == GRASPS.slipped[rows["grasp"]]
    accuracy = right.groupby(rows["variant"]).mean()
    assert (accuracy[["n50", "all", "running"]] > 0.8).all()  # a tenth of the labels is wrong


def test_days_are_judged_with_refusals_and_session_ages() -> None:
    rows = judged(Job(SYSTEMS["svm-session"], "days", 0, 1, 2), GRASPS)
    assert set(rows["variant"]) == {"running", "running-sorted"}
    assert rows["refused"].notna().all()
    for _, ages in rows.groupby("variant")["age"]:
        assert ages.is_unique  # one table, each grasp learned


def test_an_interrupted_evaluation_continues_and_repeats_no_training(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    ran: list[Job] = []
    stop_after = [3]

    def counted(job: Job, grasps: Grasps) -> pd.DataFrame:
        if len(ran) in stop_after:
            raise KeyboardInterrupt
        ran.append(job)
        return judged(job, grasps)

    monkeypatch.setattr(frame, "judged", counted)
    with pytest.raises(KeyboardInterrupt):
        list(evaluated(JOBS, GRASPS, tmp_path))
    stop_after.clear()
    results = dict(evaluated(JOBS, GRASPS, tmp_path))
    assert ran == list(results) == JOBS
    (kept, *_) = sorted(tmp_path.rglob("output.pkl"))
    kept.write_bytes(kept.read_bytes()[:100])
    again = dict(evaluated(JOBS, GRASPS, tmp_path))
    assert "Exception while loading results" in caplog.text
    assert len(ran) == len(JOBS) + 1
    assert all(same(again[job], results[job]) for job in JOBS)


def test_a_dask_cluster_gives_the_same_rows_as_this_computer(tmp_path: Path) -> None:
    distributed = pytest.importorskip("distributed", reason="needs the extra `cluster`")
    with (
        cluster() as address,
        distributed.Client(address),
        joblib.parallel_config("dask"),
    ):
        found = dict(evaluated(JOBS, GRASPS, tmp_path / "there"))
    here = dict(evaluated(JOBS, GRASPS, tmp_path / "here"))
    assert all(same(found[job], here[job]) for job in JOBS)


def test_joblibs_error_on_a_killed_worker_becomes_lost_worker_error() -> None:
    with pytest.raises(LostWorkerError, match="a process was killed"), processes(1):
        raise TerminatedWorkerError


def test_ctrl_c_within_a_fit_stops_the_training(monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupted(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    # What Ctrl-C meets in the middle of a fit; scikit-learn itself would return what it has so far.
    monkeypatch.setattr(MLPClassifier, "_update_no_improvement_count", interrupted)
    system = System("mlp", VectorInput(), MlpConfig((4,)))
    with pytest.raises(KeyboardInterrupt):
        judged(Job(system, "cv", 0, 0, 4), GRASPS)


def test_dead_electrodes_cost_less_once_replaced_by_estimates() -> None:
    study = broken_study(SYSTEMS["svm-session"], sessions(150), seed=1)
    assert len(study["broken"]) == len(KINDS) * len(NUMBERS)
    assert study["grasps"] == 135
    # A tenth of the labels is wrong, so 90 % is the best that anybody could reach.
    assert study["sound"] > 0.8
    dead = next(b for b in study["broken"] if b["reads"] == "at 0" and b["number"] == 12)
    assert dead["unnoticed"] < dead["known"]
    assert dead["known"] > study["sound"] - 0.05
