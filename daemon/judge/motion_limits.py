"""The limits of motion within which a finger holds still, in units of its noise."""

from __future__ import annotations

import math
from collections.abc import Sequence
from operator import le
from statistics import NormalDist
from typing import NamedTuple

from graspd.biotac import ELECTRODES
from graspd.daemon.judge.windows import MEAN_ABS

SLOPE_SPREAD = math.sqrt((math.pi / 2.0 - 1.0) / ELECTRODES)
"""Standard deviation of the mean of 24 absolute values of a Gaussian, over its mean."""
CREEP_COUNTS_PER_S, CREEP_SPREAD = 7.5, 0.67
"""Creep of a held touch, which relaxes: median of its electrodes' root mean square speed, counts/s,
and standard deviation of that speed's logarithm. Both were measured on 44 held touches of one
sensor, in windows of 50 to 240 ms."""
FAST_SHARE = 0.1
"""Share of the false alarms that the short window may cause if the long one is used too."""
LOOSE_SHARE = 0.1
"""Share of `false_alarms` in which noise and creep alone pass the loose limit. The pressure of a
real hold wanders as well; with it the limit is passed in `false_alarms` of the time."""


class Tails(NamedTuple):
    """Allowed motion of a finger that holds, in standard deviations above the usual motion."""

    slow: float
    """In the long window."""
    fast: float
    """In the short window, if the long one is used too."""
    alone: float
    """In the short window, if it decides alone."""

    @classmethod
    def of(cls, fingers: int, false_alarms: float, *, early: bool) -> Tails:
        """Return the tails for a share of `false_alarms`, above 0 and below 0.5.

        `early`: the short window may decide alone. Raises `ValueError` for another share.
        """
        if not 0.0 < false_alarms < 0.5:
            raise ValueError(f"false_alarms is {false_alarms}, must be between 0 and 0.5")
        finger = 1.0 - (1.0 - false_alarms) ** (1.0 / fingers)
        slow, fast = (-NormalDist().inv_cdf(share) for share in (finger, FAST_SHARE * finger))
        return cls(slow, fast, slow if early else fast)


class SlowNoise(NamedTuple):
    """Spread of the counts that noise alone gives in the long window, by finger."""

    extent: float
    """Sum of the squares of the window's times, counted from their mean, s**2."""
    squares: list[float]
    """Sum over the window of an electrode's squared deviations from its mean, counts**2."""
    spreads: list[float]
    """`Noise.spread` for the window's number of steps."""


class MotionLimits:
    """Largest motion of each finger, in units of its noise, and whether all fingers are within."""

    def __init__(self, fingers: int, tails: Tails) -> None:
        self._alone, self._beside = _usual(tails.alone), _usual(tails.fast)
        self._tail, self._creep = tails.slow, creep(tails.slow) ** 2 - CREEP_COUNTS_PER_S**2
        self._ones = [1.0] * fingers
        self.forget()

    def forget(self) -> None:
        """Clear the limits: no motion is known, so no finger is within."""
        self.fast = self.slow = self._ones
        """Largest motion of each finger over the short and over the long window."""
        self.early = self.sure = False
        """`early`: all fingers are within `fast`. `sure`: within both; with `early` judging `fast`
        is the looser limit of `Tails.fast` then, as the short window does not decide alone."""

    def lay(
        self,
        fast: Sequence[float],
        fast_noise: Sequence[float],
        slow: Sequence[float] = (),
        slow_noise: SlowNoise | None = None,
    ) -> None:
        """Set the limits by each finger's noise; `early`, `sure`: whether all motion is within.

        `fast`, `slow`: motion in units of noise. `fast_noise`: mean absolute slopes that noise
        makes, counts/s. `slow_noise`: None before the long window is full.
        """
        self.fast = _fast_limits(self._alone, fast_noise)
        self.early = all(map(le, fast, self.fast))
        if slow_noise is None:
            self.slow, self.sure = self._ones, False
            return
        self.slow = self._slow_limits(slow_noise)
        self.sure = all(map(le, slow, self.slow))
        if self.sure and self._beside != self._alone:
            beside = _fast_limits(self._beside, fast_noise)
            if all(map(le, fast, beside)):
                self.fast, self.early = beside, True
        self.sure &= self.early

    def _slow_limits(self, slow_noise: SlowNoise) -> list[float]:
        extent, squares, spreads = slow_noise
        limits = []
        for noise, spread in zip(squares, spreads, strict=True):
            stretch = extent / noise
            usual = 1.0 + CREEP_COUNTS_PER_S**2 * stretch
            # Noise and creep are independent, so the squares of their deviations add up.
            above = math.hypot(self._tail * spread * usual, self._creep * stretch)
            limits.append(math.sqrt(usual + above))
        return limits


def creep(tail: float) -> float:
    """Return the speed of a held touch, counts/s, `tail` standard deviations above the median."""
    return CREEP_COUNTS_PER_S * math.exp(CREEP_SPREAD * tail)


def _usual(tail: float) -> tuple[float, float]:
    """Return two mean absolute slopes of a finger, `tail` standard deviations above the usual one:
    by noise, in units of the noise, and by creep, counts/s."""
    return math.exp(SLOPE_SPREAD * tail), MEAN_ABS * creep(tail)


def _fast_limits(tail: tuple[float, float], fast_noise: Sequence[float]) -> list[float]:
    usual, creeps = tail
    return [math.hypot(usual, creeps / noise) for noise in fast_noise]
