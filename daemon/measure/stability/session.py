"""Session statistics against a closed form in extended precision."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from daemon.measure.stability.steps import StepRow
from drivers.base import COUNT_MAX
from models.session_statistics import HORIZON_GRASPS, SessionState, SessionStatistics

WIDTH = 24
UPDATES = 4000
"""At full weight so many grasps leave 2e-6 of what was before: a billion differ from them by
rounding alone, and what rounding leaves fades just as fast."""
MANY_GRASPS = 10**9
ERROR_MAX = 1e-10
"""Largest relative error of a mean or spread. One update rounds by 1e-16, and 301 of them add up
before they have faded."""
SPIKE = 1e6
SPIKE_AT = 3900
"""Update with the spike, so late that its weight is still there at the end."""
STILL, CLOSE, SPIKED = 0, 1, 2
"""Columns: an electrode that never moves, one at 4000 +- 0.5 counts, one with a spike."""

Statistics = tuple[NDArray[np.longdouble], NDArray[np.longdouble]]
"""Mean and spread, shape (width,) each."""


def session_rows() -> Iterator[StepRow]:
    """The statistics of a session that has lasted for a billion grasps."""
    values = _values()
    spiked = values.copy()
    spiked[SPIKE_AT, SPIKED] = SPIKE
    for name, grasps in (("1e9 updates", values), ("a spike of 1e6", spiked)):
        error = _error(grasps)
        yield StepRow(
            f"session statistics, {name}",
            f"mean and spread to {ERROR_MAX:.0e}",
            f"{error:.1e}",
            error <= ERROR_MAX,
        )
    yield _never_moves()
    yield _not_finite()


def _values() -> NDArray[np.float64]:
    random = np.random.default_rng(0)
    values = random.integers(0, COUNT_MAX + 1, (UPDATES, WIDTH)).astype(np.float64)
    values[:, STILL] = 2000.0
    values[:, CLOSE] = 4000.0 + random.choice((-0.5, 0.5), UPDATES)
    return values


def _started(values: NDArray[np.float64]) -> tuple[SessionStatistics, SessionState]:
    """Statistics that a billion earlier grasps have left, and what they were."""
    prior_mean, prior_spread = np.full(WIDTH, 2000.0), np.full(WIDTH, 300.0)
    state = SessionState(
        weight=HORIZON_GRASPS,
        grasps=MANY_GRASPS,
        mean=tuple(values[0].tolist()),
        squares=(0.0,) * WIDTH,
    )
    statistics = SessionStatistics(prior_mean, prior_spread)
    statistics.restore(state)
    return statistics, state


def _error(values: NDArray[np.float64]) -> float:
    """Largest relative error of any mean or spread after all updates."""
    statistics, state = _started(values)
    for row in values:
        statistics.observe(row)
    mean, spread = _closed_form(values, state)
    return float(
        max(
            np.abs(statistics.mean / mean - 1.0).max(),
            np.abs(statistics.spread / spread - 1.0).max(),
        )
    )


def _closed_form(values: NDArray[np.float64], state: SessionState) -> Statistics:
    """Weighted mean and spread: a grasp weighs 300/301 of what it did, with each after it."""
    horizon = np.longdouble(HORIZON_GRASPS)
    fade = horizon / (horizon + 1)
    weights = fade ** np.arange(len(values), 0, -1).astype(np.longdouble)
    exact = values.astype(np.longdouble)
    first = np.array(state.mean, dtype=np.longdouble)
    first_weight = horizon * fade ** np.longdouble(len(values))
    mean = (first_weight * first + weights @ exact) / horizon
    squares = first_weight * (first - mean) ** 2 + weights @ (exact - mean) ** 2
    prior_mean, prior_spread = np.longdouble(2000), np.longdouble(300)
    total = horizon + 1
    return (prior_mean + horizon * mean) / total, np.sqrt((prior_spread**2 + squares) / total)


def _never_moves() -> StepRow:
    """Its spread is what the prior leaves, 300 counts / sqrt(301), never zero."""
    values = _values()
    statistics, _ = _started(values)
    for row in values:
        statistics.observe(row)
    spread, mean = float(statistics.spread[STILL]), float(statistics.mean[STILL])
    least = 300.0 / math.sqrt(HORIZON_GRASPS + 1.0)
    return StepRow(
        "session statistics, an electrode that never moves",
        f"mean 2000, spread {least:.3f} by the prior",
        f"mean {mean:.6g}, spread {spread:.3f}",
        bool(abs(mean - 2000.0) <= ERROR_MAX and abs(spread / least - 1.0) <= ERROR_MAX),
    )


def _not_finite() -> StepRow:
    values = _values()
    statistics, _ = _started(values)
    before = statistics.state()
    taken = 0
    for value in (np.nan, np.inf, -np.inf):
        wrong = values[0].copy()
        wrong[SPIKED] = value
        taken += statistics.observe(wrong)
    return StepRow(
        "session statistics, NaN and infinity",
        "refused, nothing changes",
        f"{taken} of 3 taken in",
        taken == 0 and statistics.state() == before,
    )
