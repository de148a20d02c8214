"""Description of training counts, against numpy, and the readings that it refuses."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from graspd.models.electrodes import Electrodes
from graspd.models.training.fitting.novelty import (
    held_out_never_seen,
    made_up_never_seen,
    seen_counts,
)


def random_counts(number: int) -> NDArray[np.uint16]:
    """Correlated readings: one common part moves all electrodes together."""
    random = np.random.default_rng(5)
    common = random.normal(0.0, 200.0, (number, 1, 1))
    own = random.normal(0.0, 10.0, (number, 3, 24))
    counts: NDArray[np.uint16] = (2000.0 + common + own).astype(np.uint16)
    return counts


def test_seen_counts_are_range_mean_and_inverse_covariance() -> None:
    counts = random_counts(500)
    seen = seen_counts(counts)
    assert seen.low[2][23] == counts[:, 2, 23].min()
    assert seen.high[0][5] == counts[:, 0, 5].max()
    np.testing.assert_allclose(np.array(seen.centre), counts.mean(axis=0), rtol=1e-8)
    lower = np.zeros((72, 72))
    for index, row in enumerate(seen.whitening):
        lower[index, : len(row)] = row
    # The inverse covariance, with 5 counts of sensor noise on each electrode.
    covariance = np.cov(counts.reshape(500, 72).T) + 25.0 * np.eye(72)
    np.testing.assert_allclose(lower @ lower.T @ covariance, np.eye(72), atol=1e-5)


def test_readings_only_in_the_held_out_group_are_refused() -> None:
    counts = random_counts(100)
    counts[:2, 0, 0] = 3500
    group_of = np.arange(100) // 50
    # Both odd readings are in the first group, so nothing in the second looks like them.
    assert held_out_never_seen(counts, group_of) >= 0.02
    assert Electrodes(seen_counts(counts)).never_seen(counts)[:2].tolist() == [False, False]


def test_all_but_one_kind_of_made_up_readings_are_refused() -> None:
    counts = random_counts(500)
    fractions = made_up_never_seen(counts, seen_counts(counts), seed=1)
    assert len(fractions) == 4
    assert fractions.pop("middle of the ranges, with noise") < 1.0  # here this is a usual reading
    assert set(fractions.values()) == {1.0}
