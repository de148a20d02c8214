"""The limits of motion, beside what real held touches show."""

from __future__ import annotations

import numpy as np
import pytest

from graspd.daemon.judge.stillness import Tails, creep, fast_limit
from graspd.daemon.judge.windows import Noise

SIGMA_COUNTS, CORRELATION = 3.5, 0.32
"""Of real held touches: by the differences of sweeps, over the root of 2; at one sweep."""


@pytest.mark.parametrize(("sweeps", "counts_per_s"), [(8, 83.0), (12, 53.0), (24, 25.0)])
def test_the_limit_of_slopes_is_what_19_of_20_real_touches_kept_to(
    sweeps: int, counts_per_s: float
) -> None:
    """Of 44 held touches at 100 Hz, in windows of 80, 120 and 240 ms."""
    times_s = 0.01 * (np.arange(sweeps) - (sweeps - 1) / 2)
    variance = np.array([SIGMA_COUNTS**2 / (1.0 - CORRELATION)])
    noise = Noise.of(variance, np.array([[CORRELATION], [0.03]]))
    by_noise = noise.slope[sweeps] / np.sqrt((times_s**2).sum())
    (limit,) = fast_limit(Tails.of(1, 0.05, early=True).alone, by_noise.tolist())
    assert limit * by_noise[0] == pytest.approx(counts_per_s, rel=0.1)


def test_a_held_touch_creeps_as_measured() -> None:
    # Mean absolute slopes of held touches over 240 ms: 14 counts/s in the median, 25 in 5 %, of
    # which noise makes 12.6, and root mean squares are 1.25 times mean absolute values.
    assert creep(0.0) == pytest.approx(1.25 * np.sqrt(14.0**2 - 12.6**2), rel=0.05)
    assert creep(1.645) == pytest.approx(1.25 * np.sqrt(25.0**2 - 12.6**2), rel=0.2)
