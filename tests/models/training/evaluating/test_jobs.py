"""Jobs are pure, their files are whole or not there, and a session is calibrated honestly."""

from __future__ import annotations

import dataclasses
import logging
from pathlib import Path

import numpy as np
import pytest
from sklearn.neural_network import MLPClassifier

pytest.importorskip("torch", reason="needs the extra `train`")

from graspd.models.contract import VectorInput
from graspd.models.inputs import SessionBuilder, raw_features
from graspd.models.training.estimators.configs import MlpConfig, SvmConfig
from graspd.models.training.evaluating import jobs
from graspd.models.training.evaluating.jobs import Job, JobResult
from graspd.models.training.fitting.standards import (
    SESSION_VARIANTS,
    Standards,
    TrainingStandards,
    later_session,
)
from graspd.models.training.systems.registry import SessionFeatures, System
from tests.models.training.samples import sessions

GRASPS = sessions(200)
SVM = System("svm", "A machine.", VectorInput(), SvmConfig(3.0, 0.01))
SESSION_SVM = System("svm-s", "A machine, calibrated.", SessionFeatures(), SvmConfig(3.0, 0.003))
SESSION_JOB = Job(SESSION_SVM, "session", 0, 1, 4)


@pytest.fixture(scope="module")
def judged() -> JobResult:
    return jobs.run(SESSION_JOB, GRASPS)


def test_everything_that_changes_the_result_changes_the_key() -> None:
    job = Job(SVM, "cv", 0, 0)
    others = [
        dataclasses.replace(job, system=dataclasses.replace(SVM, estimator=SvmConfig(3.0, 0.02))),
        dataclasses.replace(job, system=SESSION_SVM),
        dataclasses.replace(job, protocol="objects"),
        dataclasses.replace(job, seed=1),
        dataclasses.replace(job, fold=1),
        dataclasses.replace(job, folds=5),
    ]
    keys = {job.key("data"), job.key("other data"), *(other.key("data") for other in others)}
    assert len(keys) == len(others) + 2
    renamed = dataclasses.replace(job, system=dataclasses.replace(SVM, description="Another."))
    assert renamed.key("data") == job.key("data")


def test_the_labels_of_the_test_grasps_are_not_looked_at(judged: JobResult) -> None:
    slipped = GRASPS.slipped.copy()
    slipped[GRASPS.table_of == 2] ^= True
    other = jobs.run(SESSION_JOB, dataclasses.replace(GRASPS, slipped=slipped))
    for variant, margins in judged.margins.items():
        assert np.array_equal(margins, other.margins[variant]), variant


def test_only_a_session_system_is_judged_in_several_ways(judged: JobResult) -> None:
    assert set(judged.margins) == set(SESSION_VARIANTS)
    assert set(judged.ages) == {"running", "running-sorted"}
    assert list(jobs.run(Job(SVM, "session", 0, 1, 4), GRASPS).margins) == ["none"]
    assert list(jobs.run(Job(SESSION_SVM, "cv", 0, 1, 4), GRASPS).margins) == ["training"]


def test_calibration_repairs_a_drifted_session(judged: JobResult) -> None:
    truth = GRASPS.slipped[judged.test]
    accuracy = {name: ((m > 0) == truth).mean() for name, m in judged.margins.items()}
    assert accuracy["n50"] > 0.8  # a tenth of the labels is wrong
    assert accuracy["all"] > 0.8
    assert accuracy["running"] > 0.8


def test_no_damage_of_a_file_goes_unseen(judged: JobResult) -> None:
    data = judged.to_bytes()
    for cut in range(0, len(data), 997):
        with pytest.raises(ValueError, match="is no result of a job"):
            JobResult.from_bytes(data[:cut])
    random = np.random.default_rng(6)
    for place in random.integers(len(data), size=150):
        torn = bytearray(data)
        torn[place] ^= 0x55
        try:
            back = JobResult.from_bytes(bytes(torn))
        except ValueError:
            continue
        # What the archive does not protect is its own padding and dates.
        assert all(np.array_equal(back.margins[n], judged.margins[n]) for n in judged.margins)


def test_a_stored_result_is_found_unless_it_is_broken(
    judged: JobResult, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    assert jobs.load(tmp_path, SESSION_JOB, "data") is None
    (tmp_path / SESSION_JOB.file_name("data")).write_bytes(judged.to_bytes())
    found = jobs.load(tmp_path, SESSION_JOB, "data")
    assert found is not None
    assert np.array_equal(found.test, judged.test)
    assert all(np.array_equal(found.margins[name], judged.margins[name]) for name in judged.margins)
    assert all(np.array_equal(found.ages[name], judged.ages[name]) for name in judged.ages)
    assert (found.parameters, found.seconds) == (judged.parameters, judged.seconds)
    assert found.train_grasps == judged.train_grasps
    assert jobs.load(tmp_path, SESSION_JOB, "other data") is None
    (path,) = tmp_path.iterdir()
    assert path.name.startswith("svm-s.session.0.1.")
    path.write_bytes(b"")
    with caplog.at_level(logging.WARNING):
        assert jobs.load(tmp_path, SESSION_JOB, "data") is None
    assert "it is run again" in caplog.text


def test_features_are_standardised_as_the_daemon_does() -> None:
    features = raw_features(GRASPS.counts[:50])
    standards = Standards.of(features)
    builder = SessionBuilder(3, clip=3.0)
    builder.use(standards.mean, standards.spread)
    expected = builder.build_batch(GRASPS.counts[:50])[0]
    assert np.array_equal(standards.apply(features, 3.0), expected)


def test_a_constant_feature_is_not_divided_by_zero() -> None:
    standards = Standards.of(np.full((5, 2), 7.0))
    assert standards.apply(np.full((1, 2), 7.5), 3.0).tolist() == [[0.5, 0.5]]


def test_training_rows_are_standardised_by_their_own_table() -> None:
    features = np.array([[0.0], [2.0], [100.0], [104.0]])
    table_of = np.array([0, 0, 2, 2])
    training = TrainingStandards.of(features, table_of)
    standard = training.each(table_of).apply(features, 3.0)
    assert standard.ravel().tolist() == [-1.0, 1.0, -1.0, 1.0]
    # The prior: mean of all four rows; spread within the tables, sqrt((1 + 1 + 4 + 4) / 4).
    assert training.prior.mean.tolist() == [51.5]
    assert training.prior.spread == pytest.approx([np.sqrt(2.5)])
    with pytest.raises(KeyError):
        training.each(np.array([1, 1, 1, 1]))


def test_a_running_session_judges_by_earlier_grasps() -> None:
    random = np.random.default_rng(1)
    features = random.normal(50.0, 4.0, (60, 3))
    training = TrainingStandards.of(features[:20], np.zeros(20, dtype=np.int64))
    test, pool = np.arange(25, 30), np.setdiff1d(np.arange(20, 60), np.arange(25, 30))
    standards, ages = later_session(features, test, pool, training, seed=0)
    assert ages["running-sorted"].tolist() == [5, 6, 7, 8, 9]
    by = standards["running-sorted"]
    statistics = training.statistics()
    for row in range(20, 29):
        statistics.observe(features[row])
    np.testing.assert_allclose(by.mean[4], statistics.mean)
    np.testing.assert_allclose(by.spread[4], statistics.spread)
    mixed = ages["running"]
    assert len(set(mixed.tolist())) == 5
    assert mixed.tolist() != [5, 6, 7, 8, 9]


def test_the_pool_alone_calibrates_a_session() -> None:
    features = np.random.default_rng(1).normal(50.0, 4.0, (60, 3))
    training = TrainingStandards.of(features[:20], np.zeros(20, dtype=np.int64))
    test, pool = np.arange(20, 30), np.arange(30, 60)
    changed = features.copy()
    changed[test] += 1000.0
    ours, theirs = (later_session(each, test, pool, training, 0)[0] for each in (features, changed))
    for variant in ("none", "n5", "n10", "n20", "n50", "all"):
        np.testing.assert_array_equal(ours[variant].mean, theirs[variant].mean)
    np.testing.assert_allclose(ours["all"].mean, features[pool].mean(axis=0))


def test_an_interrupted_training_is_no_result(monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupted(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    # What Ctrl-C meets in the middle of a fit; scikit-learn itself would return what it has so far.
    monkeypatch.setattr(MLPClassifier, "_update_no_improvement_count", interrupted)
    system = System("mlp", "A perceptron.", VectorInput(), MlpConfig((4,)))
    with pytest.raises(KeyboardInterrupt):
        jobs.run(Job(system, "cv", 0, 0, 4), GRASPS)
