"""Readings on which models are compared: flat, stiff, extreme, impossible and random ones."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from graspd.biotac import COUNT_MAX, ELECTRODES
from graspd.models.contract import SeenCounts

RANDOM_READINGS = 300
"""Readings of each random kind. A model and its reference take up to 1 ms for one."""
DENORMAL = 5e-310
"""Value below the smallest normal double, 2.2e-308."""

Raw = NDArray[np.uint16]
Counts = NDArray[np.generic]
"""Shape (N, fingers, 24): uint16 for raw counts, float64 for what no sensor sends."""


def likely_grasps(seen: SeenCounts, seed: int = 0) -> Raw:
    """Return `RANDOM_READINGS` grasps drawn from the mean and covariance of a model's training."""
    centre = np.array(seen.centre)
    normal = np.random.default_rng(seed).normal(size=(RANDOM_READINGS, centre.size))
    # The covariance is inv(L @ L.T), so inv(L).T gives normal numbers that covariance.
    deviations = np.linalg.solve(seen.whitening_matrix().T, normal.T).T
    counts = np.rint(centre.ravel() + deviations).clip(1, COUNT_MAX - 1).astype(np.uint16)
    grasps: Raw = counts.reshape(-1, *centre.shape)
    return grasps


def equal(likely: Raw) -> Counts:
    """Return readings with all electrodes equal, at four levels."""
    return np.stack([np.full_like(likely[0], level) for level in (1, 2, 2000, COUNT_MAX - 1)])


def two_levels(lows: tuple[int, ...], step: float) -> Callable[[Raw], Counts]:
    """Return a case: a reading for each low, every other electrode `step` higher (sigma: half)."""

    def make(likely: Raw) -> Counts:
        counts = np.stack([np.full(likely.shape[1:], low, dtype=np.float64) for low in lows])
        counts[..., ::2] += step
        return counts.astype(np.uint16) if step >= 1.0 else counts

    return make


def one_far_off(likely: Raw) -> Counts:
    """Return readings with one electrode of every finger far off: each in turn, at three levels."""
    counts = np.repeat(two_levels((2000,), 1)(likely), 3 * ELECTRODES, axis=0)
    for electrode in range(ELECTRODES):
        counts[3 * electrode : 3 * electrode + 3, :, electrode] = [[1], [1000], [COUNT_MAX - 1]]
    return counts


def unequal(factor: float) -> Callable[[Raw], Counts]:
    """Return a case: the last finger spreads by 1500 counts * `factor`, others by 1.5 counts."""

    def make(likely: Raw) -> Counts:
        counts = two_levels((2000, 3000), 3)(likely).astype(np.float64)
        signs = np.where(np.arange(ELECTRODES) % 2, 1.0, -1.0)
        counts[:, -1] = (2000.0 if factor == 1.0 else 0.0) + 1500.0 * factor * signs
        return counts.astype(np.uint16) if factor == 1.0 else counts

    return make


def one_finger_dead(likely: Raw) -> Counts:
    """Return readings in which all electrodes of the first finger are equal."""
    dead = likely[:20].copy()
    dead[:, 0] = 2000
    return dead


def all_at(level: int) -> Callable[[Raw], Counts]:
    """Return a case with all electrodes at this level."""
    return lambda likely: np.full_like(likely[:1], level)


def alternating(likely: Raw) -> Counts:
    """Return readings with the electrodes at 0 and 4095 in turns."""
    counts = np.zeros_like(likely[:2])
    counts[0, :, ::2] = counts[1, :, 1::2] = COUNT_MAX
    return counts


def one_at_a_rail(likely: Raw) -> Counts:
    """Return readings with one electrode of the first finger, each in turn, at 0 and at 4095."""
    counts = likely[: 2 * ELECTRODES].copy()
    for electrode in range(ELECTRODES):
        counts[2 * electrode : 2 * electrode + 2, 0, electrode] = (0, COUNT_MAX)
    return counts


def one_reads(value: float) -> Callable[[Raw], Counts]:
    """Return a case: one electrode, each in turn, has this value, which no sensor sends."""

    def make(likely: Raw) -> Counts:
        counts = likely[:ELECTRODES].astype(np.float64)
        for reading in range(ELECTRODES):
            counts[reading, reading % likely.shape[1], reading] = value
        return counts

    return make


def all_read(value: float) -> Callable[[Raw], Counts]:
    """Return a case: all electrodes have this value."""
    return lambda likely: np.full(likely[:1].shape, value)


def random_counts(likely: Raw) -> Counts:
    """Return readings of random 12-bit counts."""
    random = np.random.default_rng(0)
    return random.integers(0, COUNT_MAX + 1, likely.shape).astype(np.uint16)


LIKELY, RANDOM = "counts like the training's", "random 12-bit counts"
NEVER_JUDGED: dict[str, Callable[[Raw], Counts]] = {
    "all electrodes equal": equal,
    "sigma of 1 count": two_levels((1, 2000, 4090), 2),
    "sigma of 0.01 counts": two_levels((1, 2000, 4090), 0.02),
    "sigma of 1e-12 counts": two_levels((1, 2000, 4090), 2e-12),
    "counts 4000 +- 0.5": two_levels((4000,), 1),
    "counts 4000 +- 2": two_levels((3998,), 4),
    "fingers' spreads 1e3 apart": unequal(1.0),
    "one finger dead": one_finger_dead,
    "all 0": all_at(0),
    "all 4095": all_at(COUNT_MAX),
    "alternating 0 and 4095": alternating,
    "an electrode reads nan": one_reads(np.nan),
    "an electrode reads inf": one_reads(np.inf),
    "an electrode reads -inf": one_reads(-np.inf),
    "an electrode reads 1e+200": one_reads(1e200),
    "all electrodes read denormal": all_read(DENORMAL),
    "all electrodes read negative zero": all_read(-0.0),
}
"""Cases whose readings must all be refused."""
READINGS: dict[str, Callable[[Raw], Counts]] = NEVER_JUDGED | {
    "one electrode far off": one_far_off,
    "fingers' spreads 1e6 apart": unequal(1e3),
    "one electrode at a rail": one_at_a_rail,
    "an electrode reads denormal": one_reads(DENORMAL),
    "an electrode reads negative zero": one_reads(-0.0),
    RANDOM: random_counts,
    LIKELY: np.copy,
}
"""Cases by name: each makes its readings from likely grasps of a hand."""
