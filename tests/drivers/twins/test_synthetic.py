"""Synthetic grasps: reproducible, in the real range, and told apart as the real ones are."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from drivers.recordings.csv_player import DEMO_DAY, DEMO_TABLE
from drivers.twins.grasps import synthetic

RANGE_MARGIN_COUNTS = 250


def load(path: Path) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Counts (grasps, 72) and labels, read without the code under test."""
    with path.open(newline="") as file:
        rows = list(csv.reader(file))[1:]
    return np.array([row[2:] for row in rows], dtype=float), np.array([int(row[1]) for row in rows])


def z_scores(counts: NDArray[np.float64]) -> NDArray[np.float64]:
    fingers = counts.reshape(-1, 3, 24)
    centred = fingers - fingers.mean(axis=2, keepdims=True)
    scaled: NDArray[np.float64] = centred / fingers.std(axis=2, keepdims=True)
    return scaled.reshape(-1, 72)


@pytest.fixture(scope="module")
def whole(bts3_dir: Path) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    down, side = load(bts3_dir / "palm_down.csv"), load(bts3_dir / "palm_side.csv")
    return np.vstack([down[0], side[0]]), np.hstack([down[1], side[1]])


def test_the_demo_is_made_again_byte_for_byte(tmp_path: Path) -> None:
    out = tmp_path / "demo.csv"
    synthetic.main(["--out", str(out)])
    assert out.read_bytes() == DEMO_TABLE.read_bytes()


def test_the_demo_day_is_made_again_byte_for_byte_and_called_synthetic(tmp_path: Path) -> None:
    out = tmp_path / "day.csv"
    synthetic.main(["--day", "--out", str(out)])
    assert out.read_bytes() == DEMO_DAY.read_bytes()
    counts, slipped = load(DEMO_DAY)
    assert counts.shape == (300, 72)
    assert slipped.sum() == 150
    assert counts.min() >= 1
    assert counts.max() <= 4094
    with DEMO_DAY.open(newline="") as file:
        assert all(row["object"].startswith("synthetic") for row in csv.DictReader(file))


def test_the_demo_is_small_labelled_and_called_synthetic() -> None:
    assert DEMO_TABLE.stat().st_size < 120_000
    with DEMO_TABLE.open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 200
    assert sum(row["slipped"] == "1" for row in rows) == 100
    assert all(row["object"].startswith("synthetic") for row in rows)


def test_the_demo_stays_in_the_real_range(
    whole: tuple[NDArray[np.float64], NDArray[np.int64]],
) -> None:
    counts, _ = load(DEMO_TABLE)
    assert (counts >= whole[0].min(axis=0) - RANGE_MARGIN_COUNTS).all()
    assert (counts <= whole[0].max(axis=0) + RANGE_MARGIN_COUNTS).all()


def test_no_synthetic_grasp_is_a_real_one(
    whole: tuple[NDArray[np.float64], NDArray[np.int64]],
) -> None:
    counts, _ = load(DEMO_TABLE)
    nearest = [np.abs(whole[0] - grasp).max(axis=1).min() for grasp in counts]
    assert min(nearest) > 100, "counts, at the electrode that differs most"


def test_a_classifier_of_real_grasps_judges_synthetic_ones_about_as_well_as_real_ones(
    whole: tuple[NDArray[np.float64], NDArray[np.int64]],
) -> None:
    reason = "the `train` extra is not installed"
    f1_score = pytest.importorskip("sklearn.metrics", reason=reason).f1_score
    classifier = (
        pytest.importorskip("sklearn.svm", reason=reason)
        .SVC(C=5.0)
        .fit(z_scores(whole[0]), whole[1])
    )
    drawn = synthetic.draw(synthetic.read_model(), np.random.default_rng(1), 4000)
    score = f1_score(drawn.slipped, classifier.predict(z_scores(drawn.counts.astype(float))))
    # Cross-validated on the real grasps the same classifier reaches 0.91.
    assert 0.85 < score < 0.97
    counts, slipped = load(DEMO_TABLE)
    demo_score = f1_score(slipped, classifier.predict(z_scores(counts)))
    # The demo is 200 such draws: four standard errors of 0.017.
    assert demo_score == pytest.approx(score, abs=0.07)
