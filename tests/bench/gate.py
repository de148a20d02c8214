"""How gate and finger states follow generated hands: the figures of deploy/JUDGING.md.

`python -m tests.bench.gate [EPISODES]` prints a row for fresh sweeps at 100 Hz. Each figure comes
from EPISODES hands: they hold, or the object slides along their fingers.
"""

from __future__ import annotations

import math
import sys
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from graspd.biotac import ELECTRODES
from graspd.daemon.judge.decision import HandLimits
from graspd.daemon.judge.hand import HandTracker
from graspd.daemon.judge.health import Checked
from graspd.daemon.judge.reasons import FingerState
from graspd.drivers.twins.grasps.whole_grasps import Sampler
from graspd.models.training.evaluating.files import markdown_table
from tests.daemon.fakes import FINGERS
from tests.drivers.twins.slides import SLIDE_SPREAD, HeldNoise, Hold

EPISODES = 60
REST_S, CLOSES_S, HOLDS_S = 1.5, 0.25, 3.0
"""A hand rests, closes and then holds for these times, s."""
CLOSED = round(100 * (REST_S + CLOSES_S))
"""The first sweep of a closed hand."""
SLIDE_AFTER_S = (1.0, 1.3)
"""Range of the time from the hand's closing to the begin of a later slide, s."""
REST_COUNTS, PRESSED_COUNTS = 2500.0, 600.0
"""Counts of an electrode at rest, and most by which a closed hand lowers them."""
NONE, ONE, THREE = (False,) * 3, (True, False, False), (True,) * 3
"""True for each finger along which the object slides."""
HEAD = (
    "a hand holds: the verdict stands",
    "three fingers slide: it stands",
    "slides in which it ever does",
    "a slide begins: withdrawn after, p50 / p90",
    "a finger holds: it says `slide`",
    "a slide along three fingers is named after, p50 / p90",
    "along one",
)


class Closing:
    """Counts of a hand that closes at `REST_S`, added to the motion of `hold`."""

    def __init__(self, hold: Hold, rng: np.random.Generator) -> None:
        self._hold = hold
        self._pressed = rng.uniform(0.0, PRESSED_COUNTS, (len(FINGERS), ELECTRODES))

    def deviation(self, t_s: NDArray[np.float64]) -> NDArray[np.float64]:
        """Counts less the rest, shape (fingers, 24), as sampled at `t_s`, shape () or (24,)."""
        share = np.clip((t_s - REST_S) / CLOSES_S, 0.0, 1.0)
        ramp = share**3 * (10.0 + share * (6.0 * share - 15.0))  # minimum jerk
        return self._hold.deviation(t_s) - ramp * self._pressed


@dataclass(frozen=True, slots=True)
class Felt:
    """What the gate says of one hand, sweep by sweep after it has closed."""

    stands: NDArray[np.bool_]
    """True where the gate lets a verdict stand, shape (sweeps,)."""
    slides: NDArray[np.bool_]
    """True where a finger's state is `slide`, shape (sweeps, fingers)."""
    slides_at: int
    """Sweep at which a later slide begins, counted from closing."""

    @property
    def stood(self) -> int:
        """First sweep at which a verdict stood; the last sweep if none ever did."""
        return int(self.stands.argmax()) if self.stands.any() else len(self.stands) - 1

    @property
    def revoked_ms(self) -> float | None:
        """Time from the slide's begin to the end of the verdict, at most of the hold, ms; None: no
        verdict stood then."""
        stands = self.stands[self.slides_at :]
        if not self.stands[self.slides_at - 1]:
            return None
        return 10.0 * (len(stands) if stands.all() else int(stands.argmin()))

    def named_ms(self, *fingers: int) -> float:
        """Return the time from the slide's begin to `slide` of one of these fingers, ms; infinite
        if none has it."""
        says = self.slides[self.slides_at :, fingers].any(axis=1)
        return 10.0 * int(says.argmax()) if says.any() else math.inf


def feel(
    seed: int,
    sliding: tuple[bool, ...],
    *,
    begins: bool = False,
    slide_spread: float = SLIDE_SPREAD,
) -> Felt:
    """Play a generated hand to the gate, and return what the gate says.

    The object slides along the fingers that are True in `sliding` from the start, or from a drawn
    time after closing if `begins`. `slide_spread`: how much slides differ in speed; 0: not at all.
    """
    rng = np.random.default_rng([seed, 4])
    closed_s = REST_S + CLOSES_S
    slide_s = closed_s + rng.uniform(*SLIDE_AFTER_S)
    begins_s = slide_s if begins else None
    hold = Hold(sliding, rng, closed_s + HOLDS_S, closed_s, begins_s, slide_spread)
    rest = np.full((len(FINGERS), ELECTRODES), REST_COUNTS)
    sampler = Sampler(rest, HeldNoise(len(FINGERS), rng).sweep, held=False)
    course, hand = Closing(hold, rng), HandTracker(FINGERS, HandLimits())
    stands, slides = [], []
    for row in range(round(100 * (closed_s + HOLDS_S))):
        counts = sampler.sample(course.deviation, row / 100.0)
        moment, _ = hand.step(row * 10_000_000, counts, Checked((), None))
        stands.append(moment.settled)
        words = (moment.fingers or {}).values()
        slides.append([word is FingerState.SLIDE for word in words])
    slides_at = round(100 * slide_s) - CLOSED
    return Felt(np.array(stands[CLOSED:]), np.array(slides[CLOSED:]), slides_at)


def cells(episodes: int) -> list[str]:
    """Return the row of the table, each figure of `episodes` hands."""
    seeds = range(episodes)
    holds = [feel(seed, NONE) for seed in seeds]
    slides = [feel(seed, THREE) for seed in seeds]
    begun = [feel(seed, THREE, begins=True) for seed in seeds]
    three, one = (
        [feel(seed, fingers, begins=True, slide_spread=0.0) for seed in seeds]
        for fingers in (THREE, ONE)
    )
    revoked = [each.revoked_ms for each in begun if each.revoked_ms is not None]
    return [
        percent(np.concatenate([hold.stands[hold.stood :] for hold in holds])),
        percent(np.array([slide.stands for slide in slides])),
        percent(np.array([slide.stands.any() for slide in slides])),
        times(revoked),
        percent(np.concatenate([hold.slides[hold.stood :] for hold in holds])),
        times([each.named_ms(0, 1, 2) for each in three]),
        times([each.named_ms(0) for each in one]),
    ]


def percent(says: NDArray[np.bool_]) -> str:
    return f"{100 * says.mean():.2f} %"


def times(found_ms: list[float]) -> str:
    """Return the median and the 90 % quantile of times as text."""
    return f"{np.median(found_ms):.0f} / {np.quantile(found_ms, 0.9):.0f} ms"


def main(episodes: int) -> None:
    """Print the table."""
    sys.stdout.write("\n".join(markdown_table(HEAD, [cells(episodes)])) + "\n")


if __name__ == "__main__":
    main(int(sys.argv[1]) if sys.argv[1:] else EPISODES)
