"""Generated slides: as fast, as noisy and as much along one direction as real ones."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from tests.drivers.twins.slides import HeldNoise, held

STREAMS = 40
# Mean over 24 electrodes of the absolute fitted slope, counts/s, of 306 real streams at 100 Hz, by
# sweeps of 10 ms: quantiles of held touches at 5, 50, 90, 95, 99 %, ...
TOUCH_QUANTILES = (0.05, 0.5, 0.9, 0.95, 0.99)
TOUCHES = {
    5: (80, 110, 138, 147, 165),
    12: (28, 38, 49, 53, 63),
    24: (10, 14, 22, 25, 34),
}
# ... and of slides at 5, 10, 25, 50, 75, 90, 95, 99 %.
SLIDE_QUANTILES = (0.05, 0.1, 0.25, 0.5, 0.75, 0.9, 0.95, 0.99)
SLIDES = {
    5: (90, 98, 113, 133, 163, 216, 277, 520),
    12: (36, 39, 47, 62, 91, 142, 194, 369),
    24: (16, 19, 25, 39, 65, 108, 147, 270),
}


def counts_of(sliding: bool) -> list[NDArray[np.float64]]:
    """Counts of streams of one finger, each of shape (300, 24)."""
    return [
        np.array([counts[0] for _, counts in held([sliding], seed=seed)], dtype=np.float64)
        for seed in range(STREAMS)
    ]


@pytest.fixture(scope="module")
def touches() -> list[NDArray[np.float64]]:
    return counts_of(sliding=False)


@pytest.fixture(scope="module")
def slides() -> list[NDArray[np.float64]]:
    return counts_of(sliding=True)


def mean_slopes(counts: NDArray[np.float64], sweeps: int) -> NDArray[np.float64]:
    """Of every third window of so many sweeps, 10 ms apart, counts/s."""
    windows = np.lib.stride_tricks.sliding_window_view(counts, sweeps, axis=0)[::3]
    columns = windows.reshape(-1, sweeps).T
    slopes = np.polyfit(0.01 * np.arange(sweeps), columns, 1)[0]
    return np.asarray(np.abs(slopes).reshape(len(windows), -1).mean(axis=1), dtype=np.float64)


@pytest.mark.parametrize("sweeps", TOUCHES)
def test_slopes_of_held_touches_are_those_of_real_ones(
    touches: list[NDArray[np.float64]], sweeps: int
) -> None:
    slopes = np.concatenate([mean_slopes(counts, sweeps) for counts in touches])
    quantiles = np.quantile(slopes, TOUCH_QUANTILES)
    np.testing.assert_allclose(quantiles[:-1], TOUCHES[sweeps][:-1], rtol=0.27)
    # One window of a hundred is of a stream or two.
    assert quantiles[-1] == pytest.approx(TOUCHES[sweeps][-1], rel=0.35)


@pytest.mark.parametrize("sweeps", SLIDES)
def test_slopes_of_slides_are_those_of_real_ones(
    slides: list[NDArray[np.float64]], sweeps: int
) -> None:
    slopes = np.concatenate([mean_slopes(counts, sweeps) for counts in slides])
    quantiles = np.quantile(slopes, SLIDE_QUANTILES)
    np.testing.assert_allclose(quantiles[:-1], SLIDES[sweeps][:-1], rtol=0.27)
    # One window of a hundred is of a stream or two.
    assert quantiles[-1] == pytest.approx(SLIDES[sweeps][-1], rel=0.35)


def test_electrodes_of_a_held_touch_range_as_far_as_real_ones(
    touches: list[NDArray[np.float64]],
) -> None:
    # Real ones range over 32 to 44 counts in three seconds.
    ranges = [np.ptp(counts, axis=0).mean() for counts in touches]
    np.testing.assert_allclose(np.quantile(ranges, (0.05, 0.95)), (32.0, 44.0), rtol=0.15)


def test_noise_is_correlated_and_spikes_go_down_alone() -> None:
    # Measured: 2.9 to 4.2 counts (successive differences over the square root of two), correlations
    # of 0.32 at one sweep and 0.03 at two; 0.17 % of values are more than 25 below, none above.
    noise = HeldNoise(3, np.random.default_rng(1))
    sweeps = np.array([noise.sweep(np.asarray(0.0)) for _ in range(4000)])
    assert (sweeps > 25.0).mean() < 1e-5
    assert (sweeps < -25.0).mean() == pytest.approx(0.0017, rel=0.2)
    sweeps[sweeps < -20.0] = 0.0
    deviations = np.diff(sweeps, axis=0).std(axis=(0, 2)) / np.sqrt(2.0)
    assert ((deviations > 2.6) & (deviations < 4.3)).all()
    unit = sweeps / sweeps.std(axis=(0, 2), keepdims=True)
    assert (unit[1:] * unit[:-1]).mean() == pytest.approx(0.32, abs=0.03)
    assert (unit[2:] * unit[:-2]).mean() == pytest.approx(0.03, abs=0.04)
