"""Statistics of a session that has lasted for a billion grasps, against a closed form."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray

from graspd.models.session_statistics import HORIZON_GRASPS, SessionState, SessionStatistics

WIDTH = 24
UPDATES = 4000
"""At full weight 2e-6 of what was before is left after them, and of its rounding too."""
ERROR_MAX = 1e-10
"""Largest relative error of a mean or spread. One update rounds by 1e-16, and 301 of them add up
before they have faded."""
SPIKE_AT = 3900
"""Update with the spike, so late that its weight is still there at the end."""
STILL, CLOSE, SPIKED = 0, 1, 2
"""Columns: an electrode that never moves, one at 4000 +- 0.5 counts, one with a spike."""
PRIOR_MEAN, PRIOR_SPREAD = 2000.0, 300.0


@pytest.mark.parametrize(("name", "spike"), [("1e9 updates", None), ("a spike of 1e6", 1e6)])
def test_mean_and_spread_are_those_of_the_closed_form(
    note: Callable[..., None], name: str, spike: float | None
) -> None:
    random = np.random.default_rng(0)
    values = random.integers(0, 4096, (UPDATES, WIDTH)).astype(np.float64)
    values[:, STILL] = 2000.0
    values[:, CLOSE] = 4000.0 + random.choice((-0.5, 0.5), UPDATES)
    if spike is not None:
        values[SPIKE_AT, SPIKED] = spike
    statistics = SessionStatistics(np.full(WIDTH, PRIOR_MEAN), np.full(WIDTH, PRIOR_SPREAD))
    first = tuple(values[0].tolist())
    statistics.restore(SessionState(HORIZON_GRASPS, 10**9, first, (0.0,) * WIDTH))
    for row in values:
        statistics.observe(row)
    mean, spread = closed_form(values)
    mean_error = np.abs(statistics.mean / mean - 1.0).max()
    error = float(max(mean_error, np.abs(statistics.spread / spread - 1.0).max()))
    note(
        step=f"session statistics, {name}",
        expected=f"mean and spread to {ERROR_MAX:.0e}",
        found=f"{error:.1e}",
    )
    assert error <= ERROR_MAX


def closed_form(
    values: NDArray[np.float64],
) -> tuple[NDArray[np.longdouble], NDArray[np.longdouble]]:
    """Weighted mean and spread: a grasp weighs 300/301 of what it did, with each after it."""
    horizon = np.longdouble(HORIZON_GRASPS)
    fade = horizon / (horizon + 1)
    weights = fade ** np.arange(len(values), 0, -1).astype(np.longdouble)
    exact = values.astype(np.longdouble)
    first, first_weight = exact[0], horizon * fade ** np.longdouble(len(values))
    mean = (first_weight * first + weights @ exact) / horizon
    squares = first_weight * (first - mean) ** 2 + weights @ (exact - mean) ** 2
    total = horizon + 1
    return (PRIOR_MEAN + horizon * mean) / total, np.sqrt((PRIOR_SPREAD**2 + squares) / total)
