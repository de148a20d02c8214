"""`Motion` against a second implementation, which takes all sweeps at once, in float64.

It shares no code and no number with the first; Gaussian tails are scipy's. Noise and windows are
as in deploy/JUDGING.md and in the docstrings of `windows`. It finds an error that a replay does
not find: a step that is the sum of its sweeps in place of their mean.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.special import ndtri

from graspd.daemon.judge.stillness import Motion

MS = 1_000_000
FALSE_ALARMS = 0.03
MEAN_ABS = np.sqrt(2.0 / np.pi)

Floats = NDArray[np.float64]


@dataclass
class Found:
    """Motion of each finger by both windows, with the strict limits. `beside_limit`: that of `fast`
    where the long window decides too."""

    fast: Floats
    fast_limit: Floats
    beside_limit: Floats
    slow: Floats
    slow_limit: Floats


def steps_of(times_ns: NDArray[np.int64], counts: Floats) -> tuple[Floats, Floats]:
    """Return times, s, and mean counts of steps of 5 ms or more; the first sweep is a step."""
    groups, last_ns = [[0]], times_ns[0]
    begun: list[int] = []
    for index in range(1, len(times_ns)):
        begun.append(index)
        if times_ns[index] - last_ns >= 5 * MS:
            groups.append(begun)
            begun, last_ns = [], times_ns[index]
    means = np.array([counts[group].mean(axis=0) for group in groups])
    return np.array([times_ns[group].mean() / 1e9 for group in groups]), means


def noise_of(steps: Floats) -> tuple[Floats, Floats]:
    """Return the noise's variance, shape (fingers,), and correlations after one and two steps."""
    numbers = np.arange(3, len(steps))
    numbers = numbers[: len(numbers) // 24 * 24].reshape(-1, 24)[-16:]
    squares = np.array(
        [
            [
                np.square(steps[block] - steps[block - apart]).mean(axis=(0, 2))
                for apart in (1, 2, 3)
            ]
            for block in numbers
        ]
    )
    low = np.sort(squares, axis=0)[len(squares) // 4]  # the lower quartile, which is 95 % of a mean
    variance = np.clip(low[2] / 2.0 / 0.95, 0.5**2, 10.0**2)
    correlations = 1.0 - low[:2] / np.maximum(low[2], 2.0 * 0.5**2)
    return variance, np.clip(correlations, 0.0, 1.0)


def found_in(times_ns: NDArray[np.int64], counts: Floats, *, early: bool) -> Found:
    """Return the fingers' motion at the last of these sweeps, shape (sweeps, fingers, 24)."""
    times, steps = steps_of(times_ns, counts)
    variance, (near, far) = noise_of(steps)
    fingers = counts.shape[1]
    share = 1.0 - (1.0 - FALSE_ALARMS) ** (1.0 / fingers)
    tail, rare = -ndtri(share), -ndtri(0.1 * share)

    def window(seconds: float) -> tuple[Floats, Floats]:
        within = times > times[-1] - seconds + 1e-9
        within[-3:] = True
        return times[within] - times[within].mean(), steps[within]

    t, moved = window(0.1)
    n, extent = len(t), np.square(t).sum()
    ranks = np.arange(n) - (n - 1) / 2.0
    echo = [(ranks[lag:] * ranks[:-lag]).sum() / np.square(ranks).sum() for lag in (1, 2)]
    louder = np.maximum(1.0 + 2.0 * (echo[0] * near + echo[1] * far), 0.1)
    by_noise = MEAN_ABS * np.sqrt(variance * louder / extent)
    slopes = np.einsum("n,nfe->fe", t, moved - moved[0]) / extent

    def fast_limit(at: float) -> Floats:
        usual = np.exp(at * np.sqrt((np.pi / 2.0 - 1.0) / 24))
        creep = MEAN_ABS * 7.5 * np.exp(0.67 * at)
        return np.asarray(np.hypot(usual, creep / by_noise))

    t, spread = window(0.24)
    n = len(t)
    quieter = 1.0 - 2.0 * ((n - 1) * near + (n - 2) * far) / (n * (n - 1.0))
    expected = variance * np.maximum(quieter, 0.1)
    creeps = np.square(t).sum() / (n - 1) / expected
    usual, most = 7.5**2 * creeps, (7.5 * np.exp(0.67 * tail)) ** 2 * creeps
    deviation = np.sqrt(2.0 * (1.0 + 2.0 * (near**2 + far**2)) / (24 * (n - 1)))
    return Found(
        fast=np.abs(slopes).mean(axis=1) / by_noise,
        fast_limit=fast_limit(tail if early else rare),
        beside_limit=fast_limit(rare),
        slow=np.sqrt(spread.var(axis=0, ddof=1).mean(axis=1) / expected),
        slow_limit=np.sqrt(1.0 + usual + np.hypot(tail * deviation * (1.0 + usual), most - usual)),
    )


def fingers_of(number: int, rate_hz: float) -> Floats:
    """Return sweeps of five fingers: with hardly any noise, little, white and correlated noise, and
    a tremble larger than noise may be. Their noise changes, and for a while all move."""
    random = np.random.default_rng(11)
    white = random.normal(0.0, 1.0, (number + 1, 5, 24))
    louder = 1.0 + 0.5 * np.sin(np.arange(number) / rate_hz * 0.9)[:, None]
    sweeps = 2000.0 + white[1:] * np.array([0.2, 0.45, 2.0, 1.6, 0.3])[:, None] * louder[:, None]
    sweeps[:, 3] += 0.8 * white[:-1, 3]
    trembles = np.sin(2.0 * np.pi * np.arange(number) / 12 + random.uniform(0, 6, (24, 1))).T
    sweeps[:, 4] += 34.0 * trembles
    begin, end = int(0.8 * number), int(0.9 * number)
    moves = np.clip(np.arange(number) - begin, 0, end - begin) / rate_hz
    sweeps += moves[:, None, None] * np.linspace(5.0, 60.0, 24)
    return np.asarray(np.rint(sweeps))


@pytest.mark.parametrize("early", [True, False])
@pytest.mark.parametrize(("rate_hz", "seconds"), [(1000 / 14, 9.0), (100.0, 8.0), (1000.0, 2.5)])
def test_motion_agrees_with_a_second_implementation(
    rate_hz: float, seconds: float, early: bool
) -> None:
    number = round(rate_hz * seconds)
    jitter_ns = np.random.default_rng(7).integers(-300_000, 300_000, number)
    times_ns = np.round(np.arange(number) / rate_hz * 1e9).astype(np.int64) + jitter_ns + MS
    counts = fingers_of(number, rate_hz)
    motion = Motion(5, FALSE_ALARMS, early=early)
    usable = np.ones((5, 24), dtype=np.bool_)
    looks, settled = set(range(number // 2, number, 23)), []
    for index, sweep in enumerate(counts.astype(np.uint16)):
        motion.add(int(times_ns[index]), sweep, usable)
        if index not in looks or not motion.known:
            continue
        steps = len(steps_of(times_ns[: index + 1], counts[: index + 1])[0])
        if steps != len(steps_of(times_ns[:index], counts[:index])[0]) + 1:
            continue  # in the middle of a step
        wanted = found_in(times_ns[: index + 1], counts[: index + 1], early=early)
        np.testing.assert_allclose(motion.fast, wanted.fast, rtol=2e-3, atol=1e-3)
        np.testing.assert_allclose(motion.slow, wanted.slow, rtol=2e-3, atol=1e-3)
        is_slow = (wanted.slow <= wanted.slow_limit).all()
        is_sure = is_slow and (wanted.fast <= wanted.beside_limit).all()
        fast_limit = wanted.beside_limit if is_sure else wanted.fast_limit
        is_early = (wanted.fast <= fast_limit).all()
        np.testing.assert_allclose(motion.strict.fast, fast_limit, rtol=1e-3)
        np.testing.assert_allclose(motion.strict.slow, wanted.slow_limit, rtol=1e-3)
        settled.append((bool(is_early), bool(is_sure)))
        assert (motion.strict.early, motion.strict.sure) == settled[-1]
    assert len(settled) > 8
