"""What counts a model has seen, and how much lies outside of them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from models.contract import SeenCounts
from models.training.datasets import COUNT_MAX

MARGIN_COUNTS = 100
"""Beyond the training range still taken for seen: wide enough for held-out grasps of the same
session (about 1 % are refused), narrow enough that drifted electrodes are not: of the later
session palm_45, which the network judges wrongly, 97 % are refused."""
RANDOM_READINGS = 10_000


def seen_counts(counts: NDArray[np.uint16]) -> SeenCounts:
    """Range of each electrode over counts (N, fingers, 24)."""
    return SeenCounts(
        low=tuple(tuple(map(int, finger)) for finger in counts.min(axis=0)),
        high=tuple(tuple(map(int, finger)) for finger in counts.max(axis=0)),
        margin=MARGIN_COUNTS,
    )


def never_seen(counts: NDArray[np.uint16], seen: SeenCounts) -> NDArray[np.bool_]:
    """Shape (N,): True where any of the counts (N, fingers, 24) is further out than the margin."""
    values = counts.astype(np.int64)
    below = values < np.array(seen.low) - seen.margin
    above = values > np.array(seen.high) + seen.margin
    outside: NDArray[np.bool_] = np.any(below | above, axis=(1, 2))
    return outside


def held_out_never_seen(counts: NDArray[np.uint16], fold_of: NDArray[np.int64]) -> float:
    """Fraction of counts (N, fingers, 24) outside the range of the other folds."""
    outside = np.empty(len(counts), dtype=np.bool_)
    for fold in np.unique(fold_of):
        inside = fold_of == fold
        outside[inside] = never_seen(counts[inside], seen_counts(counts[~inside]))
    return float(outside.mean())


def random_never_seen(seen: SeenCounts, seed: int) -> float:
    """Fraction of uniformly random readings (every count in 0..4095) that lie outside."""
    shape = (RANDOM_READINGS, *np.shape(seen.low))
    random = np.random.default_rng(seed).integers(0, COUNT_MAX, shape, np.uint16, endpoint=True)
    return float(never_seen(random, seen).mean())
