"""Fingers that hold an object, or along which it slides: generated, by figures of real ones.

The figures are of 306 streams of one sensor at 100 Hz, three seconds each: 44 touches that hold and
262 slides in six directions (Zapata-Impata, Gil, Torres: Sensors 2019, 19(3), 523; data set
BioTacSP-DoS, of which nothing is kept here).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from graspd.biotac import ELECTRODES

NOISE_COUNTS = (3.0, 4.5)
"""Lowest and highest standard deviation of a finger's electrodes, counts. With the wander,
successive sweeps differ by 2.9 to 4.2 times the square root of two."""
ECHO = 0.36
"""Share of a sweep's noise that comes again in the next one: correlations of 0.32 at one sweep and
of 0 at two (measured: 0.32 and 0.03)."""
SPIKE_PROBABILITY = 0.0017
"""Chance per electrode and sweep of a downward spike of more than 25 counts."""
SPIKE_COUNTS = (25.0, 60.0)
"""Lowest and highest depth of a spike, counts."""
RELAXATION_COUNTS_PER_S = 12.0
"""Root mean square of an electrode's speed when the median hold begins, counts/s."""
RELAXATION_SPREAD = 0.6
"""Standard deviation of the logarithm of `RELAXATION_COUNTS_PER_S`, between holds."""
RELAXATION_TAU_S = 0.7
"""Time constant of the motion after a hold begins, s. Not measured; it fits the quantiles of held
touches."""
HOLD_DIRECTIONS = (0.68, 0.32)
"""Shares of a hold's variance along each of two directions of the 24 electrodes."""
WANDER_COUNTS_PER_S = 66.0
"""Root mean square of an electrode's speed as the pressure of a hold wanders, counts/s."""
WANDER_SPREAD, WANDER_MOMENT_SPREAD = 0.3, 0.25
"""Standard deviations of the wander's logarithmic speed, between holds, and between moments of one.
These and the times fit the quantiles of held touches, and the time for which a gate with one limit
counted real ones as moving."""
WANDER_TURN_TAU_S = 0.02
"""Time after which the wander has another direction, s."""
WANDER_TAU_S = 0.06
"""Time after which the wander has gone back, s."""
SLIDE_DIRECTIONS = (0.81, 0.14, 0.05)
"""Shares of a slide's variance along each of three directions."""
STANDSTILL_S = (0.0, 0.2)
"""Shortest and longest time without a slide at the beginning, and again at the end, s."""
SLIDE_WANDER = 1.5
"""Factor by which the pressure of a slide wanders faster than that of a hold."""
SPEED_COUNTS_PER_S = 76.0
"""Root mean square of an electrode's speed in the median slide, counts/s."""
SLIDE_SPREAD, MOMENT_SPREAD = 0.58, 0.5
"""Standard deviations of the logarithm of a slide's speed, between slides and between its
moments. These and the times fit the quantiles of slides."""
MOMENT_TAU_S = 0.2
"""Time after which a wander or slide has another speed, s, as the object sticks and slips."""
TURN_TAU_S = 0.1
"""Time after which a slide has another direction, s."""
STEP_S = 0.005
"""Time between two points of a motion, s, which is straight between them."""
SECONDS = 3.0
"""Length of a stream, s."""


class Hold:
    """Motion of the electrodes of some fingers while an object is held, or slides along them."""

    def __init__(
        self,
        sliding: Sequence[bool],
        rng: np.random.Generator,
        seconds: float = SECONDS,
        rest_s: float = 0.0,
        slide_s: float | None = None,
        slide_spread: float = SLIDE_SPREAD,
    ) -> None:
        """`sliding` says of each finger whether the object slides along it, or is held.

        `seconds`: length of the motion. Nothing moves before `rest_s`. Slides begin at `slide_s`,
        and the object is held until then; None: they begin after a standstill. With a
        `slide_spread` of 0 all have the speed of the median one.
        """
        self._times = np.arange(0.0, seconds + STEP_S, STEP_S)
        ways = [
            (
                *_relaxation(self._times - rest_s, rng),
                *_wander(self._times, rest_s, slide_s, rng, slides=slides),
                *(_slide(self._times, rest_s, slide_s, slide_spread, rng) if slides else ()),
            )
            for slides in sliding
        ]
        self._ways = [[(along, way) for along, way in finger] for finger in ways]

    def deviation(self, t_s: NDArray[np.float64]) -> NDArray[np.float64]:
        """Counts minus those at rest, shape (fingers, 24), as sampled at `t_s`, () or (24,)."""
        moved = [
            sum(np.interp(t_s, self._times, along) * way for along, way in finger)
            for finger in self._ways
        ]
        return np.array(moved)


class HeldNoise:
    """Noise of held electrodes: correlated from sweep to sweep, with spikes downward alone."""

    def __init__(self, fingers: int, rng: np.random.Generator) -> None:
        self._rng = rng
        deviation = rng.uniform(*NOISE_COUNTS, (fingers, 1)) / np.hypot(1.0, ECHO)
        self._deviation = np.broadcast_to(deviation, (fingers, ELECTRODES))
        self._last = rng.normal(0.0, self._deviation)

    def sweep(self, t_s: NDArray[np.float64]) -> NDArray[np.float64]:
        """The noise of the next sweep, counts; the time does not matter."""
        new = self._rng.normal(0.0, self._deviation)
        noise: NDArray[np.float64] = new + ECHO * self._last
        self._last = new
        spiking = self._rng.random(noise.shape) < SPIKE_PROBABILITY
        noise -= spiking * self._rng.uniform(*SPIKE_COUNTS, noise.shape)
        return noise


Way = tuple[NDArray[np.float64], NDArray[np.float64]]
"""Distance along a direction at each time, shape (times,), and the direction, shape (24,)."""


def _relaxation(times: NDArray[np.float64], rng: np.random.Generator) -> Iterator[Way]:
    factor = np.exp(rng.normal(0.0, RELAXATION_SPREAD))
    along = RELAXATION_COUNTS_PER_S * factor * RELAXATION_TAU_S
    along = along * (1.0 - np.exp(-np.maximum(times, 0.0) / RELAXATION_TAU_S))
    for share in HOLD_DIRECTIONS:
        yield np.sqrt(share) * along, _direction(rng)


def _wander(
    times: NDArray[np.float64],
    rest_s: float,
    slide_s: float | None,
    rng: np.random.Generator,
    *,
    slides: bool,
) -> Iterator[Way]:
    speed = WANDER_COUNTS_PER_S * np.exp(
        rng.normal(0.0, WANDER_SPREAD)
        + WANDER_MOMENT_SPREAD * _noise(len(times), MOMENT_TAU_S, rng)
    )
    if slides:
        speed[times >= (rest_s if slide_s is None else slide_s)] *= SLIDE_WANDER
    keeps = np.exp(-STEP_S / WANDER_TAU_S)
    for share in HOLD_DIRECTIONS:
        along = np.sqrt(share) * (times >= rest_s) * speed * STEP_S
        along *= _noise(len(times), WANDER_TURN_TAU_S, rng)
        for index in range(1, len(along)):
            along[index] += keeps * along[index - 1]
        yield along, _direction(rng)


def _slide(
    times: NDArray[np.float64],
    rest_s: float,
    slide_s: float | None,
    spread: float,
    rng: np.random.Generator,
) -> Iterator[Way]:
    begins_s, ends_s = rng.uniform(*STANDSTILL_S, 2)
    begins_s = rest_s + begins_s if slide_s is None else slide_s
    slides = (times >= begins_s) & (times < times[-1] - ends_s)
    speed = SPEED_COUNTS_PER_S * np.exp(
        rng.normal(0.0, spread) + MOMENT_SPREAD * _noise(len(times), MOMENT_TAU_S, rng)
    )
    for share in SLIDE_DIRECTIONS:
        velocity = np.sqrt(share) * slides * speed * _noise(len(times), TURN_TAU_S, rng)
        yield np.cumsum(velocity) * STEP_S, _direction(rng)


def _direction(rng: np.random.Generator) -> NDArray[np.float64]:
    """Draw a direction in which 24 electrodes move; root mean square 1."""
    direction = rng.normal(size=ELECTRODES)
    return np.asarray(direction / np.sqrt((direction**2).mean()), dtype=np.float64)


def _noise(number: int, tau_s: float, rng: np.random.Generator) -> NDArray[np.float64]:
    """Standard Gaussian numbers `STEP_S` apart, correlated over `tau_s`, shape (number,)."""
    keeps = np.exp(-STEP_S / tau_s)
    values = rng.normal(size=number)
    values[1:] *= np.sqrt(1.0 - keeps**2)
    for index in range(1, number):
        values[index] += keeps * values[index - 1]
    return values
