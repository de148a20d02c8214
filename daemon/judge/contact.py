"""Tare and contact: where each electrode rests, how much it wavers, and which finger touches.

A touch presses the skin towards the electrodes under it and lowers their counts (BioTac SP manual,
section 5). So a finger touches when several electrodes fall below where they rest, and further than
the finger as a whole: what moves all electrodes alike is the supply or the temperature.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from drivers.base import COUNT_MAX, ELECTRODES

WINDOW = 100
"""Untouched sweeps that a baseline is the median of: one second at 100 Hz."""
TARE_EVERY = 25
"""A full window is looked at again after so many more sweeps."""
FALLEN = 3
"""The third deepest fall counts: spikes are of one electrode, rarely of two, at a time."""
SOUND_MIN = 12
"""Usable electrodes, of 24, below which nobody knows whether a finger touches."""
LET_GO = 0.6
"""A finger that touched has let go when it falls by less than this share of what a touch takes."""
SUSPECT = 0.5
"""A fall above this share of what a touch takes may be the beginning of one: not for the tare."""
SIGMA_MIN_COUNTS = 1.5
"""Of an electrode; counts are whole numbers, so a quiet one may show none at all."""
SIGMA_MAX_COUNTS = 10.0
"""A finger whose median electrode wavers more is not at rest; measured 2.9 to 4.3 counts."""
TREND_MAX_COUNTS = 5.0
"""A finger whose median electrode moves more within a window is not at rest."""
UP_COUNTS_PER_S, DOWN_COUNTS_PER_S = 5.0, 1.5
"""How fast a baseline follows at most. Warm-up drift is 0.56 to 0.84 counts/s upward (measured on
three sensors); following a fall any faster would tare a slow touch away."""
MAD_TO_SIGMA = 1.4826
"""Standard deviation of a Gaussian over its median absolute deviation."""


@dataclass(frozen=True, slots=True)
class ContactLimits:
    """What a touch is: the larger of both, for the third deepest electrode of a finger."""

    counts: float = 20.0
    """Fall below the baseline, counts. In 9.8 s of three untouched sensors it was 10 at most; from
    24 on a touch of three electrodes was always seen there (thresholds were 20 to 22)."""
    sigmas: float = 5.0
    """The same in standard deviations of the finger's median electrode."""


class Contact:
    """Follows the baselines of all fingers and says which touch. Constant memory, no clock."""

    def __init__(self, fingers: int, limits: ContactLimits = ContactLimits()) -> None:
        """Start without a baseline."""
        shape = (fingers, ELECTRODES)
        self._limits = limits
        self._tares = [_Tare() for _ in range(fingers)]
        self._baseline = np.zeros(shape)
        self._known = np.zeros(shape, dtype=np.bool_)
        self._threshold = np.full(fingers, limits.counts)
        self.fall = np.zeros(fingers)
        """Counts by which each finger's third deepest electrode is below its baseline, and below
        the finger's median electrode: the smaller of both, and the latter alone where the finger
        touches already, for in a long hold the sensors drift. Zero without a baseline."""
        self.touching = np.zeros(fingers, dtype=np.bool_)
        self.tared = np.zeros(fingers, dtype=np.bool_)
        """Whether each finger has a baseline. Without one, nobody knows whether it touches."""

    @property
    def baseline(self) -> NDArray[np.float64]:
        """Where each electrode rests, counts, shape (fingers, 24); 0 without a tare."""
        return self._baseline

    @property
    def threshold(self) -> NDArray[np.float64]:
        """Fall that makes a touch, counts, shape (fingers,)."""
        return self._threshold

    def observe(
        self,
        t_ns: int,
        counts: NDArray[np.uint16],
        median: NDArray[np.uint16],
        usable: NDArray[np.bool_],
    ) -> None:
        """Take in one sweep and its `FreshMedian`, shape (fingers, 24), read at `t_ns`.

        Electrodes that are not `usable` count for nothing.
        """
        sound = usable & self._known
        number = np.count_nonzero(sound, axis=1)
        self.fall = self._fall(median, sound, number)
        enough = self.tared & (number >= SOUND_MIN)
        needed = np.where(self.touching, LET_GO, 1.0) * self._threshold
        self.touching = enough & (self.fall >= needed)
        may_touch = self.fall >= SUSPECT * self._threshold
        # With too few electrodes nobody knows any more: to find out, it must be tared again.
        self.tared &= enough
        for finger, tare in enumerate(self._tares):
            if self.tared[finger] and may_touch[finger]:
                tare.clear()
            elif tare.add(counts[finger], usable[finger]):
                self._settle(finger, tare, t_ns)

    def _fall(
        self, median: NDArray[np.uint16], sound: NDArray[np.bool_], number: NDArray[np.int64]
    ) -> NDArray[np.float64]:
        falls = np.where(sound, self._baseline - median, np.inf)
        falls.sort(axis=1)  # those that do not count come last
        fall = np.zeros(len(falls))
        for finger in np.flatnonzero(number >= SOUND_MIN):
            deep = falls[finger, number[finger] - FALLEN]
            relative = deep - falls[finger, number[finger] // 2]
            fall[finger] = relative if self.touching[finger] else min(deep, relative)
        return fall

    def _settle(self, finger: int, tare: _Tare, t_ns: int) -> None:
        """Take over what a finger's window says, if it was at rest."""
        rest = tare.rest()
        if rest is None:
            return
        baseline, sigma, known = rest
        elapsed_s = 0.0 if tare.settled_ns is None else max(t_ns - tare.settled_ns, 0) / 1e9
        tare.settled_ns = t_ns
        step = baseline - self._baseline[finger]
        new = known & ~self._known[finger]
        if self.tared[finger] and np.median(step[known]) <= self._threshold[finger]:
            step = np.clip(step, -DOWN_COUNTS_PER_S * elapsed_s, UP_COUNTS_PER_S * elapsed_s)
            step[new] = (baseline - self._baseline[finger])[new]
        # Else it had no baseline, or rests higher as a whole, as no touch makes it: the hand was
        # opened, or held something for so long that its sensors drifted.
        self._baseline[finger] += step
        self._known[finger] = known
        self._threshold[finger] = max(self._limits.counts, self._limits.sigmas * sigma)
        self.tared[finger] = True


class _Tare:
    """The last untouched sweeps of one finger."""

    def __init__(self) -> None:
        self._window = np.zeros((WINDOW, ELECTRODES), dtype=np.uint16)
        self._unusable = np.zeros((WINDOW, ELECTRODES), dtype=np.bool_)
        self.settled_ns: int | None = None
        """When a baseline was last taken from it."""
        self.clear()

    def clear(self) -> None:
        """Something touches: begin again afterwards."""
        self._number = 0

    def add(self, counts: NDArray[np.uint16], usable: NDArray[np.bool_]) -> bool:
        """Take in a sweep, shape (24,); True when it is time to look at the window."""
        place = self._number % WINDOW
        self._window[place] = counts
        self._unusable[place] = ~usable
        self._number += 1
        return self._number >= WINDOW and self._number % TARE_EVERY == 0

    def rest(self) -> tuple[NDArray[np.float64], float, NDArray[np.bool_]] | None:
        """Baseline (24,), median electrode's sigma and which are known; None if it moved."""
        known = ~self._unusable.any(axis=0)
        if np.count_nonzero(known) < SOUND_MIN:
            return None
        window = np.roll(self._window, -(self._number % WINDOW), axis=0).astype(np.float64)
        baseline = np.median(window, axis=0)
        sigmas = MAD_TO_SIGMA * np.median(np.abs(window - baseline), axis=0)
        halves = np.median(window[WINDOW // 2 :], axis=0) - np.median(window[: WINDOW // 2], axis=0)
        sigma = max(float(np.median(sigmas[known])), SIGMA_MIN_COUNTS)
        if sigma > SIGMA_MAX_COUNTS or abs(np.median(halves[known])) > TREND_MAX_COUNTS:
            return None
        known &= (baseline > 0) & (baseline < COUNT_MAX) & (sigmas <= 3.0 * SIGMA_MAX_COUNTS)
        return (baseline, sigma, known) if np.count_nonzero(known) >= SOUND_MIN else None
