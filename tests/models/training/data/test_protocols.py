"""Splits: sizes as published, no grasp in training and test, every grasp judged once."""

from __future__ import annotations

import dataclasses
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
from scipy.sparse.csgraph import connected_components
from scipy.spatial.distance import pdist, squareform

from graspd.models.contract import Dataset
from graspd.models.training.data.datasets import (
    Grasps,
    concatenate,
    first_readings,
    read_all,
)
from graspd.models.training.data.protocols import (
    UNKNOWN_OBJECTS,
    EvalProtocol,
    TooFewGraspsError,
    fold_seed,
    folds_of,
    near_copies,
    splits,
)
from tests.models.training.samples import sessions, table

GROUPED: tuple[EvalProtocol, ...] = ("objects", "objects-whole", "session")
# Grasps that each protocol judges, from the paper and the tables' own row counts.
JUDGED: dict[EvalProtocol, int] = {
    "cv": 2549,
    "unknown": 485,
    "objects": 4682,
    "objects-whole": 2549,
    "session": 2133,
}


@pytest.fixture(scope="module")
def real(bts3_dir: Path) -> Grasps:
    return read_all(bts3_dir)


@pytest.mark.parametrize("protocol", JUDGED)
def test_every_grasp_of_a_protocol_is_judged_once_unseen(
    real: Grasps, protocol: EvalProtocol
) -> None:
    made = splits(protocol, real, seed=3)
    judged = np.concatenate([split.test for split in made])
    assert len(judged) == len(set(judged.tolist())) == JUDGED[protocol]
    for split in made:
        assert not set(split.test.tolist()) & set(split.train.tolist())
        assert (np.diff(split.test) > 0).all()
        assert (np.diff(split.train) > 0).all()


def test_cv_splits_palm_down_and_side_into_ten_stratified_folds(real: Grasps) -> None:
    made = splits("cv", real, seed=0)
    assert len(made) == 10
    assert {len(split.test) for split in made} == {254, 255}
    assert all(split.test.max() < 2549 and split.train.max() < 2549 for split in made)
    assert all(127 <= real.slipped[split.test].sum() <= 128 for split in made)


def test_unknown_objects_are_the_papers_485_of_2549(real: Grasps) -> None:
    (split,) = splits("unknown", real, seed=0)
    assert (len(split.train), len(split.test)) == (2064, 485)
    assert {real.objects[row] for row in split.test} == UNKNOWN_OBJECTS
    assert not {real.objects[row] for row in split.train} & UNKNOWN_OBJECTS
    (other,) = splits("unknown", real, seed=7)
    assert np.array_equal(other.test, split.test)


@pytest.mark.parametrize("protocol", GROUPED)
def test_no_object_is_in_both_training_and_test(real: Grasps, protocol: EvalProtocol) -> None:
    for split in splits(protocol, real, seed=1):
        judged = {real.objects[row] for row in split.test}
        assert 4 <= len(judged) <= 5  # 41 objects in 10 groups
        assert not judged & {real.objects[row] for row in split.train}


def test_training_days_and_calibration_objects_are_never_those_judged(real: Grasps) -> None:
    for split in splits("session", real, seed=0):
        assert set(real.table_of[split.train].tolist()) == {0, 1}
        assert set(real.table_of[split.test].tolist()) == {2}
        assert split.calibration is not None
        assert set(real.table_of[split.calibration].tolist()) == {2}
        assert len(split.calibration) + len(split.test) == 2133
        calibrating = {real.objects[row] for row in split.calibration}
        assert not calibrating & {real.objects[row] for row in split.test}


def test_days_train_on_other_tables_and_objects_than_judged(real: Grasps) -> None:
    made = splits("days", real, seed=1)
    days = [(0, 1), (2,), (1, 2), (0, 2)], [(2,), (0, 1), (0,), (1,)]
    for split, trained, judged in zip(
        made, *([day for day in each for _ in range(4)] for each in days), strict=True
    ):
        assert set(real.table_of[split.train].tolist()) == set(trained)
        assert set(real.table_of[split.test].tolist()) == set(judged)
        objects = {real.objects[row] for row in split.test}
        assert not objects & {real.objects[row] for row in split.train}
    counted = Counter(np.concatenate([split.test for split in made]).tolist())
    assert [len(split.name) for split in made] == [9] * 16
    assert Counter(counted.values()) == {1: 2133, 2: 2549}


@pytest.mark.parametrize("protocol", ["cv", "session"])
def test_the_seed_alone_decides_the_split(protocol: EvalProtocol) -> None:
    grasps = sessions(200)
    first, again, other = (splits(protocol, grasps, seed) for seed in (0, 0, 1))
    for one, two in zip(first, again, strict=True):
        assert np.array_equal(one.test, two.test)
    assert len({fold_seed(seed, fold) for seed in range(10) for fold in range(10)}) == 100
    assert any(
        not np.array_equal(one.test, two.test) for one, two in zip(first, other, strict=True)
    )


@pytest.mark.parametrize("protocol", ["objects", "days"])
def test_a_protocol_whose_table_is_missing_is_refused(protocol: EvalProtocol) -> None:
    with pytest.raises(TooFewGraspsError, match="the data lack palm_side"):
        splits(protocol, table("palm_down", 40, 0), seed=0)


@pytest.mark.parametrize("protocol", ["cv", "objects", "objects-whole"])
def test_every_grasp_is_judged_if_all_tables_are_own(protocol: EvalProtocol) -> None:
    grasps = concatenate([table("monday", 100, 0), table("friday", 60, 1)])
    judged = np.concatenate([split.test for split in splits(protocol, grasps, seed=0)])
    assert sorted(judged.tolist()) == list(range(160))


@pytest.mark.parametrize("protocol", ["unknown", "session"])
def test_unknown_and_session_protocols_ignore_lab_tables(protocol: EvalProtocol) -> None:
    alone = splits(protocol, sessions(100), seed=0)
    beside = splits(protocol, concatenate([sessions(100), table("lab", 100, 3)]), seed=0)
    for one, other in zip(alone, beside, strict=True):
        assert np.array_equal(one.train, other.train)
        assert np.array_equal(one.test, other.test)
    with pytest.raises(TooFewGraspsError, match="the data lack palm_"):
        splits(protocol, table("lab", 100, 3), seed=0)


def test_data_without_the_papers_unknown_objects_are_refused() -> None:
    grasps = sessions(100)
    known = [index for index, name in enumerate(grasps.objects) if name not in UNKNOWN_OBJECTS]
    with pytest.raises(TooFewGraspsError, match="lack the objects that the paper leaves out"):
        splits("unknown", grasps.rows(np.array(known)), seed=0)


def test_readings_of_one_grasp_stay_in_one_fold() -> None:
    one = table("lab", 40, 1)
    noise = np.random.default_rng(3).normal(0.0, 3.0, (120, 3, 24))
    grasps = dataclasses.replace(
        one,
        counts=(one.counts.repeat(3, axis=0) + noise).astype(np.uint16),
        slipped=one.slipped.repeat(3),
        objects=tuple(name for name in one.objects for _ in range(3)),
        files=(Dataset("lab", one.files[0].sha256, 120),),
    )
    assert near_copies(one) == 0
    assert near_copies(grasps) == 120
    fold_of = folds_of(grasps, 5, seed=0).reshape(40, 3)
    assert (fold_of == fold_of[:, :1]).all()
    assert set(fold_of.ravel().tolist()) == set(range(5))
    with pytest.raises(TooFewGraspsError, match="one has "):
        folds_of(grasps, 40, seed=0)


@pytest.mark.parametrize("step", [4.0, 12.0])
def test_readings_linked_by_near_readings_form_one_grasp(step: float) -> None:
    """Groups are connected components, by scipy, of pairs with an RMS difference up to 8 counts."""
    random, rows = np.random.default_rng(4), 300
    walk = np.cumsum(random.normal(0.0, step / np.sqrt(2), (rows, 72)), axis=0) % 4096
    counts = random.permutation(walk).astype(np.uint16)
    near = squareform(pdist(counts.astype(float))) <= 8.0 * np.sqrt(72)
    number, labels = connected_components(near)
    first = first_readings(counts.reshape(rows, 3, 24))
    assert len(np.unique(first)) == number
    assert (first == np.unique(labels, return_index=True)[1][labels]).all()
