"""Novelty: describe the training counts, and measure which share of other data is unlike them."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from graspd.biotac import COUNT_MAX
from graspd.models.contract import SeenCounts
from graspd.models.electrodes import Electrodes
from graspd.models.training.arrays import Numbers

MARGIN_COUNTS = 100
"""Margin around the training range, counts, within which a count still passes as seen.

Held-out grasps of the same session pass. It refuses 97 % of the later session palm_45, which the
network judges wrongly.
"""
SESSION_MARGIN_COUNTS = 500
"""Margin of a session model, counts. Its mapping follows drift, but is rough in a young session. It
refuses 6 % of palm_45."""
DISTANCE_MAX = 2.5
"""Largest root-mean-square whitened deviation that still passes as seen.

Held-out grasps have a median of 0.8, and 1 % are above the limit. All readings made up of possible
but unrelated counts are above it.
"""
DISTANCE_MIN = 0.33
"""Smallest root-mean-square whitened deviation that still passes as seen.

The nearest of 3600 real grasps to the mean has 0.37. The mean itself, with the sensors' noise, has
0.14 to 0.34.
"""
NOISE_COUNTS = 5.0
"""Noise that is added to each electrode's spread, counts (3 to 12 measured).

Two electrodes that always moved together in the training may differ by it.
"""
DIGITS = 9
"""Significant decimal digits of the numbers in the contract."""
RANDOM_READINGS = 10_000


def seen_counts(counts: Numbers, margin: int = MARGIN_COUNTS) -> SeenCounts:
    """Return the description of counts (N, fingers, 24). Raises `ValueError` for N < 2.

    `margin`: counts beyond their range that still pass as seen.
    """
    if len(counts) < 2:
        raise ValueError("two readings at least have a covariance")
    flat = counts.reshape(len(counts), -1).astype(np.float64)
    covariance = np.cov(flat.T) + NOISE_COUNTS**2 * np.eye(flat.shape[1])
    whitening = np.linalg.cholesky(np.linalg.inv(covariance))
    return SeenCounts(
        low=tuple(tuple(map(_count, finger)) for finger in np.floor(counts.min(axis=0))),
        high=tuple(tuple(map(_count, finger)) for finger in np.ceil(counts.max(axis=0))),
        margin=margin,
        centre=tuple(tuple(map(_rounded, finger)) for finger in counts.mean(axis=0)),
        whitening=tuple(
            tuple(map(_rounded, row[: index + 1])) for index, row in enumerate(whitening)
        ),
        distance_max=DISTANCE_MAX,
        distance_min=DISTANCE_MIN,
    )


def held_out_never_seen(counts: Numbers, group_of: Numbers, margin: int = MARGIN_COUNTS) -> float:
    """Return the refused fraction of counts (N, fingers, 24), each compared with other groups'
    counts.

    `group_of`: fold or object of each, shape (N,).
    """
    never = np.empty(len(counts), dtype=np.bool_)
    for group in np.unique(group_of):
        inside = group_of == group
        never[inside] = Electrodes(seen_counts(counts[~inside], margin)).never_seen(counts[inside])
    return float(never.mean())


def made_up_never_seen(counts: Numbers, seen: SeenCounts, seed: int) -> dict[str, float]:
    """Return the refused fraction of synthetic readings, by the way they are made.

    `counts`: real counts, shape (N, fingers, 24). `seen`: their description.
    """
    random = np.random.default_rng(seed)
    shape = (RANDOM_READINGS, *counts.shape[1:])
    low, high = np.array(seen.low), np.array(seen.high)
    makers: dict[str, Callable[[], Numbers]] = {
        "uniform in 0..4095": lambda: random.integers(0, COUNT_MAX, shape, endpoint=True),
        "uniform in each electrode's range": lambda: random.integers(
            low, high, shape, endpoint=True
        ),
        "each electrode from another grasp": lambda: random.permuted(counts, axis=0),
        "middle of the ranges, with noise": lambda: (low + high) / 2 + random.normal(0, 3.5, shape),
    }
    check = Electrodes(seen)
    return {
        name: float(check.never_seen(make().astype(np.uint16)).mean())
        for name, make in makers.items()
    }


def _count(value: float) -> int:
    return int(min(max(value, 0.0), COUNT_MAX))


def _rounded(value: float) -> float:
    return float(f"{value:.{DIGITS}g}")
