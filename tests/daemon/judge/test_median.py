"""Median of three fresh values: against numpy, and on a real stream that holds its values."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from graspd.daemon.judge.hand import FreshMedian

SHAPE = (3, 24)
ALL = np.ones(SHAPE, dtype=np.bool_)

Counts = NDArray[np.uint16]


def play(fresh: FreshMedian, sweeps: Counts, usable: NDArray[np.bool_] = ALL) -> Counts:
    """The median after each sweep, shape (sweeps, 3, 24)."""
    medians = np.zeros(sweeps.shape, dtype=np.uint16)
    for place, counts in enumerate(sweeps):
        fresh.push(counts, usable)
        medians[place] = fresh.counts
    return medians


def never_repeating(sweeps: int, seed: int = 0) -> Counts:
    """Noise in which no value is that of the sweep before, shape (sweeps, 3, 24)."""
    noise = np.random.default_rng(seed).integers(1000, 2000, (sweeps, *SHAPE))
    return (2 * noise + np.arange(sweeps)[:, None, None] % 2).astype(np.uint16)


def fresh_values(values: list[int]) -> list[int]:
    """What counts by the definition: a value that repeats the one before does not, but the next."""
    kept: list[int] = []
    held = False
    for place, value in enumerate(values):
        held = place > 0 and value == values[place - 1] and not held
        if not held:
            kept.append(value)
    return kept


def test_first_value_stands_for_those_that_are_missing() -> None:
    sweeps, fresh = never_repeating(3), FreshMedian(SHAPE)
    assert not fresh.counts.any(), "zero where there is none"
    for number, counts in enumerate(sweeps, start=1):
        fresh.push(counts, ALL)
        assert fresh.is_full(ALL) == (number == 3)
        if number < 3:
            np.testing.assert_array_equal(fresh.counts, sweeps[0])


def test_every_median_of_a_real_stream_follows_from_the_definition(untouched: Counts) -> None:
    medians = play(FreshMedian(SHAPE), untouched)
    for finger in range(3):
        for electrode in range(24):
            values = untouched[:, finger, electrode].tolist()
            for sweep in range(20, len(values), 31):
                last = fresh_values(values[: sweep + 1])[-3:]
                assert medians[sweep, finger, electrode] == sorted(last)[1]


def test_unusable_values_never_enter_and_those_before_them_are_forgotten() -> None:
    random = np.random.default_rng(4)
    sweeps = never_repeating(400)
    fresh = FreshMedian(SHAPE)
    kept: dict[tuple[int, int], list[int]] = {(0, 0): [], (1, 11): [], (2, 23): []}
    for counts in sweeps:
        usable = random.random(SHAPE) < 0.7
        read = np.where(usable, counts, random.choice([0, 4095, 0xFFFF], SHAPE)).astype(np.uint16)
        fresh.push(read, usable)
        for place, values in kept.items():
            if not usable[place]:
                values.clear()  # what was before the loss counts no more
                continue
            values.append(int(counts[place]))
            last = fresh_values(values)[-3:]
            if len(last) == 3:
                assert fresh.counts[place] == sorted(last)[1]


def test_a_repeat_of_the_last_usable_value_is_held() -> None:
    fresh, unusable = FreshMedian(SHAPE), ~ALL
    for value, usable in ((10, ALL), (20, ALL), (0, unusable), (20, ALL), (0, unusable)):
        fresh.push(np.full(SHAPE, value, dtype=np.uint16), usable)
    assert not fresh.is_full(ALL)
    assert (fresh.counts == 10).all(), "10, 10 and 20"


def test_a_never_usable_electrode_reads_zero_and_holds_up_nothing() -> None:
    fresh, usable = FreshMedian(SHAPE), ALL.copy()
    usable[1, 5] = False
    medians = play(fresh, never_repeating(5), usable)
    assert (medians[:, 1, 5] == 0).all()
    assert fresh.is_full(usable)
    assert not fresh.is_full(ALL)


def test_nothing_of_before_a_reset_is_left() -> None:
    fresh, anew = FreshMedian(SHAPE), FreshMedian(SHAPE)
    play(fresh, never_repeating(10))
    fresh.reset()
    assert not fresh.is_full(ALL)
    sweeps = never_repeating(10)[9:]  # the very sweep before the reset is not a repetition
    for _ in range(3):
        fresh.push(sweeps[0], ALL)
        anew.push(sweeps[0], ALL)
        np.testing.assert_array_equal(fresh.counts, anew.counts)
        np.testing.assert_array_equal(fresh.counts, sweeps[0])
    assert not fresh.is_full(ALL), "three times the same is two fresh values"


def test_a_median_that_was_handed_out_stays_what_it_was() -> None:
    fresh, sweeps = FreshMedian(SHAPE), never_repeating(10)
    play(fresh, sweeps[:3])
    given = fresh.counts
    kept = given.copy()
    play(fresh, sweeps[3:])
    np.testing.assert_array_equal(given, kept)
    assert (fresh.counts != kept).any()
