"""Motion of the electrodes: how fast, over which time, and what swings in step with the window."""

from __future__ import annotations

import numpy as np
import pytest

from daemon.judge.stillness import SWEEPS, Stillness

WINDOW_NS = 80_000_000
ALL = np.ones((3, 24), dtype=np.bool_)


def swept(stillness: Stillness, t_s: float, counts: float) -> float | None:
    """Feed one sweep in which the middle finger reads `counts`; its rate, counts/s."""
    median = np.full((3, 24), 2000, dtype=np.uint16)
    median[1] = round(2000 + counts)
    t_ns = round(t_s * 1e9)
    stillness.add(t_ns, median)
    rate = stillness.rate(t_ns, median, ALL)
    return None if rate is None else float(rate[1])


@pytest.mark.parametrize("rate_hz", [11.0, 50.0, 71.43, 100.0, 1000.0, 10_000.0])
def test_a_steady_slope_has_its_slope(rate_hz: float) -> None:
    stillness = Stillness(WINDOW_NS)
    rates = [swept(stillness, n / rate_hz, 1000.0 * n / rate_hz) for n in range(round(rate_hz))]
    # By hand: 1000 counts/s; counts are rounded, and a sweep may be a step older than the window.
    assert rates[-1] == pytest.approx(1000.0, rel=0.08)


@pytest.mark.parametrize("swing_hz", [12.5, 11.9, 25.0])
@pytest.mark.parametrize("rate_hz", [71.43, 100.0, 1000.0])
def test_what_swings_in_step_with_the_window_moves(swing_hz: float, rate_hz: float) -> None:
    stillness = Stillness(WINDOW_NS)
    rates = [
        swept(stillness, n / rate_hz, 60.0 * np.sin(2 * np.pi * swing_hz * n / rate_hz))
        for n in range(round(rate_hz))
    ]
    # At every moment some other moment of the window is at least 60 counts away: 750 counts/s;
    # at 71 Hz six sweeps of a window may miss the farthest.
    assert min(rate for rate in rates[12:] if rate is not None) > 400.0


def test_nothing_is_known_before_a_window_has_passed_and_after_a_reset() -> None:
    stillness = Stillness(WINDOW_NS)
    found = [swept(stillness, n / 100, 0.0) for n in range(12)]
    assert found == [None] * 8 + [0.0] * 4
    stillness.reset()
    assert swept(stillness, 0.2, 0.0) is None


def test_electrodes_that_are_not_usable_do_not_move() -> None:
    stillness = Stillness(WINDOW_NS)
    usable = ALL.copy()
    usable[1, :12] = False
    median = np.full((3, 24), 2000, dtype=np.uint16)
    stillness.add(0, median)
    moved = median.copy()
    moved[1, :12] += 1000
    moved[1, 12:] += 8
    rate = stillness.rate(WINDOW_NS, moved, usable)
    assert rate is not None
    np.testing.assert_allclose(rate, [0.0, 100.0, 0.0])  # 8 counts in 80 ms


def test_memory_is_bounded_however_fast_readings_come() -> None:
    stillness = Stillness(WINDOW_NS)
    for n in range(5000):
        swept(stillness, n / 100_000, 0.0)
    assert len(stillness._past) <= SWEEPS + 2
