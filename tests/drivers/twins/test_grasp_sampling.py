"""Sampling and noise of whole grasps, against the untouched recording of a palm.

Its figures (`biotacs-noise`, 100 Hz): robust sigma 2.9 to 4.3 counts, 0.75 to 1.22 % spikes of 25
to 150 counts, all downward, drift 0.56 to 0.84 counts/s, pairs unchanged in 2 of 7 rows.
"""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from numpy.typing import NDArray

from graspd.drivers.twins.grasps.grasp_script import Durations, EndPoint
from graspd.drivers.twins.grasps.tactile_noise import MeasuredNoise
from graspd.drivers.twins.grasps.whole_grasps import GraspRow, WholeGrasps
from tests.drivers.twins.signals import played

REST = np.full((3, 24), 3000.0)
UNPRESSED = EndPoint(REST.astype(np.uint16), False, "nothing")
LONG_REST = Durations(first_rest_s=(60.0, 60.0))
PAIRS = [(0,), *((first, first + 1) for first in range(1, 23, 2)), (23,)]
"""Electrodes sampled by one request, from 0: E1 (with TDC), E2/E3 ... E22/E23, E24."""


def counts_of(moments: list[GraspRow]) -> NDArray[np.float64]:
    return np.array([moment.counts for moment in moments], dtype=np.float64)


def untouched() -> NDArray[np.float64]:
    """A minute of rest, shape (6000, 3, 24)."""
    grasps = WholeGrasps(REST, [UNPRESSED], durations=LONG_REST, seed=3)
    return counts_of(list(itertools.islice(grasps, 6000)))


def test_held_values_are_sampled_one_request_a_millisecond_in_the_order_of_the_palm() -> None:
    numbers = np.broadcast_to(np.arange(1000.0)[:, np.newaxis, np.newaxis], (1000, 3, 24))
    for seed in range(20):
        grasps = WholeGrasps(
            np.ones((3, 24)),
            [EndPoint(np.ones((3, 24), dtype=np.uint16), False, "")],
            held=True,
            noise=played(numbers),
            seed=seed,
        )
        rows = counts_of(list(itertools.islice(grasps, 100)))
        if rows[0, 0, 0] < 800:  # the loop does not begin again within these rows
            break
    for row, counts in enumerate(rows):
        for place, pair in enumerate(PAIRS, 1):
            rounds_ago = (10 * row - place) // 14 + 1
            assert (counts[:, list(pair)] == rows[0, 0, 0] + rounds_ago).all()


def test_fresh_values_repeat_no_more_than_noise_does() -> None:
    repeats = np.diff(untouched(), axis=0) == 0.0
    # Two whole numbers of sigma 3.5 are equal with a chance of 1 / (2 sqrt(pi) 3.5) = 0.0806.
    assert repeats.mean() == pytest.approx(0.0806, abs=0.003)
    assert not any(repeats[:, :, pair].all(axis=(1, 2)).any() for pair in PAIRS[1:-1])


def test_noise_has_the_measured_width_drift_and_spikes() -> None:
    counts = untouched()
    times = np.arange(len(counts)) * 0.01
    slopes = np.polyfit(times, counts.reshape(len(counts), -1), 1)[0]
    assert slopes.mean() == pytest.approx(0.7, abs=0.01)
    residuals = counts - 3000.0 - 0.7 * times[:, np.newaxis, np.newaxis]
    sigma = 1.4826 * np.median(np.abs(residuals), axis=0)
    assert ((sigma > 2.9) & (sigma < 4.3)).all()
    assert residuals.max() < 6 * 3.5
    spikes = residuals < -6 * 3.5
    assert 0.0075 < spikes.mean() < 0.0122
    assert residuals.min() > -(150 + 6 * 3.5)
    assert spikes.sum(axis=2).max() == 1, "one electrode of a finger at a time"
    assert not (spikes[1:] & spikes[:-1]).any(), "isolated in time"


def test_drift_ends_with_the_warm_up() -> None:
    noise = MeasuredNoise(3, np.random.default_rng(0))
    assert np.median(noise.sweep(np.asarray(1e7))) == pytest.approx(210.0, abs=3.0)


def test_no_electrode_drifts_out_of_its_range() -> None:
    rest, after_s = REST.copy(), Durations(first_rest_s=(1e4, 1e4))
    rest[0, 2] = 3975.0  # where the third electrode of the synthetic first finger rests
    unpressed = EndPoint(rest.astype(np.uint16), False, "nothing")
    grasps = WholeGrasps(rest, [unpressed], rate_hz=0.1, durations=after_s)
    counts = counts_of(list(itertools.islice(grasps, 900)))
    assert counts.max() < 4094, "cut off"
    assert counts[100:, 0, 2].std() > 2.9
    assert np.median(counts[100:, 0, 2]) == pytest.approx(4045.0, abs=1.0)
    assert np.median(counts[100:, 1]) == pytest.approx(3210.0, abs=1.0)
