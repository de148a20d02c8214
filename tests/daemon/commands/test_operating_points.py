"""The motions that `graspd check` says can be told from noise, beside those that are."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.signal import lfilter

from graspd.daemon.commands.check import operating_points
from graspd.daemon.judge.motion_limits import Tails
from graspd.daemon.judge.stillness import Motion

SIGMA_COUNTS, CORRELATION = 3.5, 0.32
"""Of real held touches: by the differences of sweeps, over the root of 2; at one sweep."""
FINGER = np.ones((1, 24), dtype=np.bool_)


def moving(
    counts_per_s: float, seconds: float, rate_hz: float, rest_s: float, seed: int
) -> NDArray[np.uint16]:
    """A finger in noise as measured, which moves steadily after a rest; the speed is the mean."""
    random = np.random.default_rng(seed)
    echo = (1.0 - np.sqrt(1.0 - 4.0 * CORRELATION**2)) / (2.0 * CORRELATION)
    white = SIGMA_COUNTS / np.sqrt(1.0 - CORRELATION) / np.hypot(1.0, echo)
    number = round((rest_s + seconds) * rate_hz)
    noise = lfilter([1.0, echo], [1.0], random.normal(0.0, white, (number, 24)), axis=0)
    speeds = random.normal(size=24)
    speeds *= counts_per_s / np.abs(speeds).mean()
    way = np.maximum(np.arange(number) / rate_hz - rest_s, 0.0)
    counts: NDArray[np.uint16] = np.rint(2000.0 + noise + np.outer(way, speeds)).astype(np.uint16)
    return counts[:, np.newaxis]


def seen(counts_per_s: float, rate_hz: float, *, early: bool, false_alarms: float) -> list[float]:
    """Share of sweeps in which the short and the long window show such a motion."""
    rest_s, seconds, found = 3.0, 1.5, []
    for seed in range(16 if rate_hz < 200.0 else 4):
        motion = Motion(1, false_alarms, early=early)
        stream = moving(counts_per_s, seconds, rate_hz, rest_s, seed)
        for index, counts in enumerate(stream):
            motion.add(round(index / rate_hz * 1e9), counts, FINGER)
            if index / rate_hz > rest_s + 0.3 and index % 5 == 0:
                found.append(
                    (motion.fast[0] > motion.strict.fast[0], motion.slow[0] > motion.strict.slow[0])
                )
    shares: list[float] = np.mean(found, axis=0).tolist()
    return shares


@pytest.mark.parametrize(
    ("rate_hz", "early", "false_alarms"),
    [(1000 / 14, False, 0.05), (100.0, True, 0.05), (100.0, False, 0.01), (1000.0, True, 0.05)],
)
def test_a_motion_at_the_operating_point_is_seen_in_every_other_sweep(
    rate_hz: float, early: bool, false_alarms: float
) -> None:
    tails = Tails.of(1, false_alarms, early=early)
    for place, point in enumerate(operating_points(tails, round(1e9 / rate_hz))):
        shares = [
            seen(factor * point.counts_per_s, rate_hz, early=early, false_alarms=false_alarms)[
                place
            ]
            for factor in (0.6, 1.0, 1.6)
        ]
        assert shares[0] < 0.25
        assert 0.25 < shares[1] < 0.75
        assert shares[2] > 0.9
