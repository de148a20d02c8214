"""Median of three fresh values: by its definition, on random streams and on a real one."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from graspd.daemon.judge.hand import FreshMedian

SHAPE = (3, 24)
UNUSABLE = np.array([0, 4095, 0xFFFF])

Counts = NDArray[np.uint16]


class Electrode:
    """Fresh values by definition: none that repeats the one before, but a third equal value."""

    def __init__(self) -> None:
        self.fresh: list[int] = []
        self.last: int | None = None
        self.is_held = False

    def push(self, value: int, *, usable: bool) -> None:
        if not usable:  # what was before the loss counts no more
            self.fresh, self.is_held = [], False
            return
        self.is_held = value == self.last and not self.is_held
        self.last = value
        if not self.is_held:
            self.fresh.append(value)

    @property
    def median(self) -> int:
        """Median of the last three fresh values; the first stands for those that are missing."""
        return sorted((self.fresh[:1] * 2 + self.fresh)[-3:])[1]


def follow(fresh: FreshMedian, sweeps: Counts, usable: NDArray[np.bool_]) -> None:
    """Push sweeps, and compare medians with `Electrode` after each; shapes (sweeps, 3, 24)."""
    electrodes = [Electrode() for _ in range(72)]
    for counts, mask in zip(sweeps, usable, strict=True):
        fresh.push(counts, None if mask.all() else mask)
        for electrode, value, is_usable in zip(electrodes, counts.flat, mask.flat, strict=True):
            electrode.push(int(value), usable=bool(is_usable))
        is_full = np.array([len(each.fresh) >= 3 for each in electrodes])
        assert fresh.is_full(None) == is_full.all()
        assert fresh.is_full(mask) == is_full[mask.ravel()].all()
        for place in np.flatnonzero([bool(each.fresh) for each in electrodes]):
            assert fresh.counts.flat[place] == electrodes[place].median


@pytest.mark.parametrize("share", [1.0, 0.99, 0.7], ids=["all", "nearly all", "some"])
def test_the_median_of_usable_values_follows_from_its_definition(share: float) -> None:
    """One value in three repeats the one before; a reset leaves nothing of what was before."""
    random, fresh = np.random.default_rng(4), FreshMedian(SHAPE)
    assert not fresh.counts.any(), "zero where there is none"
    for _ in range(4):
        usable = random.random((100, *SHAPE)) < share
        sweeps = np.where(usable, random.integers(1, 4, usable.shape), random.choice(UNUSABLE))
        follow(fresh, sweeps.astype(np.uint16), usable)
        fresh.reset()
        assert not fresh.is_full(None)


def test_every_median_of_a_real_stream_follows_from_the_definition(untouched: Counts) -> None:
    follow(FreshMedian(SHAPE), untouched, np.ones(untouched.shape, dtype=np.bool_))


def test_an_electrode_never_usable_is_zero_and_not_waited_for() -> None:
    fresh, usable = FreshMedian(SHAPE), np.ones(SHAPE, dtype=np.bool_)
    usable[1, 5] = False
    for value in range(3):
        fresh.push(np.full(SHAPE, 2000 + value, dtype=np.uint16), usable)
    assert fresh.counts[1, 5] == 0
    assert fresh.is_full(usable)


def test_later_sweeps_do_not_change_a_median_already_returned() -> None:
    fresh, given = FreshMedian(SHAPE), []
    for value in (1, 2, 3, 4, 5):
        fresh.push(np.full(SHAPE, value, dtype=np.uint16), None)
        given.append(fresh.counts)
    assert [int(counts[0, 0]) for counts in given] == [1, 1, 2, 3, 4]
