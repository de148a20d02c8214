"""Motion of the electrodes: how fast, over which time, and what swings in step with the window."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from daemon.judge.stillness import SWEEPS, Stillness

WINDOW_NS = 80_000_000
ALL = np.ones((3, 24), dtype=np.bool_)

Sweep = NDArray[np.float32]


def swept(stillness: Stillness, t_s: float, counts: float) -> float | None:
    """Feed one sweep in which the middle finger reads `counts`; its rate, counts/s."""
    median = np.full((3, 24), 2000, dtype=np.float32)
    median[1] = round(2000 + counts)
    t_ns = round(t_s * 1e9)
    stillness.add(t_ns, median)
    rate = stillness.rate(t_ns, median, ALL)
    return None if rate is None else float(rate[1])


@pytest.mark.parametrize("rate_hz", [11.0, 50.0, 71.43, 100.0, 1000.0, 10_000.0])
def test_a_steady_slope_has_its_slope(rate_hz: float) -> None:
    stillness = Stillness(WINDOW_NS, 3)
    rates = [swept(stillness, n / rate_hz, 1000.0 * n / rate_hz) for n in range(round(rate_hz))]
    # By hand: 1000 counts/s; counts are rounded, and a sweep may be a step older than the window.
    assert rates[-1] == pytest.approx(1000.0, rel=0.08)


@pytest.mark.parametrize("swing_hz", [12.5, 11.9, 25.0])
@pytest.mark.parametrize("rate_hz", [71.43, 100.0, 1000.0])
def test_what_swings_in_step_with_the_window_moves(swing_hz: float, rate_hz: float) -> None:
    stillness = Stillness(WINDOW_NS, 3)
    rates = [
        swept(stillness, n / rate_hz, 60.0 * np.sin(2 * np.pi * swing_hz * n / rate_hz))
        for n in range(round(rate_hz))
    ]
    # At every moment some other moment of the window is at least 60 counts away: 750 counts/s;
    # at 71 Hz six sweeps of a window may miss the farthest.
    assert min(rate for rate in rates[12:] if rate is not None) > 400.0


def test_nothing_is_known_before_a_window_has_passed_and_after_a_reset() -> None:
    stillness = Stillness(WINDOW_NS, 3)
    found = [swept(stillness, n / 100, 0.0) for n in range(12)]
    assert found == [None] * 8 + [0.0] * 4
    stillness.reset()
    assert swept(stillness, 0.2, 0.0) is None


def test_electrodes_that_are_not_usable_do_not_move() -> None:
    stillness = Stillness(WINDOW_NS, 3)
    usable = ALL.copy()
    usable[1, :12] = False
    median = np.full((3, 24), 2000, dtype=np.float32)
    stillness.add(0, median)
    moved = median.copy()
    moved[1, :12] += 1000
    moved[1, 12:] += 8
    rate = stillness.rate(WINDOW_NS, moved, usable)
    assert rate is not None
    np.testing.assert_allclose(rate, [0.0, 100.0, 0.0])  # 8 counts in 80 ms


def test_every_rate_is_that_of_the_definition_at_any_pace() -> None:
    random = np.random.default_rng(2)
    stillness, past, t_ns = Stillness(WINDOW_NS, 3), list[tuple[int, Sweep]](), 0
    compared = 0
    for _ in range(2000):
        t_ns += int(random.choice([1, 4, 6, 10, 14, 30])) * 1_000_000
        median = random.integers(0, 4096, (3, 24)).astype(np.float32)
        usable = random.random((3, 24)) < random.choice([0.8, 1.0])
        stillness.add(t_ns, median)
        rate = stillness.rate(t_ns, median, usable)
        if not past or t_ns - past[-1][0] >= WINDOW_NS // SWEEPS:
            past.append((t_ns, median))
        older = [at for at, _ in past if t_ns - at >= WINDOW_NS]
        assert (rate is None) == (not older)
        if rate is None:
            continue
        expected = np.zeros(3)
        for at, then in past:
            if at >= older[-1]:
                for finger, chosen in enumerate(usable):
                    distance = np.abs(median - then)[finger][chosen].mean()
                    per_s = distance / max(t_ns - at, WINDOW_NS) * 1e9
                    expected[finger] = max(expected[finger], per_s)
        np.testing.assert_allclose(rate, expected, rtol=1e-6)
        compared += 1
    assert compared > 1900


def test_memory_is_bounded_however_fast_readings_come() -> None:
    stillness = Stillness(WINDOW_NS, 3)
    for n in range(5000):
        swept(stillness, n / 100_000, 0.0)
    assert len(stillness.memory.times_ns) <= SWEEPS + 2
