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
"""A finger that touched has let go when it falls by less than this share of a touch ..."""
RELEASED = 0.25
"""... or by less than this share of how deep it was held: in a long hold the electrodes of a finger
drift apart, so what is left when the hand opens may look like a light touch ..."""
RELEASED_LONG = 0.5
"""... and more so the longer it was: this is the share after `LONG_HOLD_NS`."""
DEPTH_FADES_COUNTS_PER_S = 5.0
"""How fast the depth of a hold follows a lighter touch."""
APART_NS = 50_000_000
"""No finger touches again so soon after it let go: while it opens, its electrodes rise one sweep
after the other, and for a moment look as if it pressed again."""
LONG_HOLD_NS = 60_000_000_000
"""Who has held for longer than this is tared anew afterwards: by then 0.2 counts/s between the
electrodes of a finger (measured on three sensors) make more than half of a touch."""
ALONE_NS = 30_000_000_000
"""A finger that touches for so long without all the others does not grasp: it is tared anew."""
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
        self._touches = [_Touch(limits.counts) for _ in range(fingers)]
        self._baseline = np.zeros(shape)
        self._known = np.zeros(shape, dtype=np.bool_)
        self._last_ns: int | None = None
        self.touching = np.zeros(fingers, dtype=np.bool_)
        self.tared = np.zeros(fingers, dtype=np.bool_)
        """Whether each finger has a baseline. Without one, nobody knows whether it touches."""

    @property
    def baseline(self) -> NDArray[np.float64]:
        """Where each electrode rests, counts, shape (fingers, 24); 0 without a tare."""
        return self._baseline

    @property
    def fall(self) -> NDArray[np.float64]:
        """How deep each finger is pressed, counts, shape (fingers,); see `_Touch.fall`."""
        return np.array([touch.fall for touch in self._touches])

    @property
    def threshold(self) -> NDArray[np.float64]:
        """Fall that makes a touch, counts, shape (fingers,)."""
        return np.array([touch.threshold for touch in self._touches])

    def forget(self) -> None:
        """The sensors may be others, or have been away: all fingers must be tared anew."""
        for finger in range(len(self._tares)):
            self._forget(finger)

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
        numbers = sound.sum(axis=1).tolist()
        falls = np.where(sound, self._baseline - median, np.inf)
        falls.sort(axis=1)  # those that do not count come last
        elapsed_s = 0.0 if self._last_ns is None else max(t_ns - self._last_ns, 0) / 1e9
        self._last_ns = t_ns
        middles = [0.0] * len(numbers)
        for finger, (touch, number) in enumerate(zip(self._touches, numbers, strict=True)):
            # With too few electrodes nobody knows any more: to find out, it must be tared again.
            self.tared[finger] &= number >= SOUND_MIN
            if self.tared[finger]:
                deep = float(falls[finger, number - FALLEN])
                middles[finger] = float(falls[finger, number // 2])
                touch.follow(t_ns, elapsed_s, deep, deep - middles[finger])
            else:
                touch.end()
        all_touch = all(touch.touching for touch in self._touches)
        for finger, touch in enumerate(self._touches):
            anew = touch.must_be_tared_anew(t_ns, middles[finger], accompanied=all_touch)
            self.touching[finger] = touch.touching
            if self.tared[finger] and anew:
                self._forget(finger)
            self._tare(finger, t_ns, counts[finger], usable[finger])

    def _tare(
        self, finger: int, t_ns: int, counts: NDArray[np.uint16], usable: NDArray[np.bool_]
    ) -> None:
        """Take a finger's sweep into its window, unless it may be the beginning of a touch."""
        tare, touch = self._tares[finger], self._touches[finger]
        if self.tared[finger] and touch.fall >= SUSPECT * touch.threshold:
            tare.clear()
        elif tare.add(counts, usable):
            self._settle(finger, tare, t_ns)

    def _forget(self, finger: int) -> None:
        self.tared[finger] = self.touching[finger] = False
        self._known[finger] = False
        self._touches[finger] = _Touch(self._touches[finger].threshold)
        self._tares[finger] = _Tare()

    def _settle(self, finger: int, tare: _Tare, t_ns: int) -> None:
        """Take over what a finger's window says, if it was at rest."""
        rest = tare.rest()
        if rest is None:
            return
        baseline, sigma, known = rest
        elapsed_s = 0.0 if tare.settled_ns is None else max(t_ns - tare.settled_ns, 0) / 1e9
        tare.settled_ns = t_ns
        step = baseline - self._baseline[finger]
        if self.tared[finger]:
            limited = np.clip(step, -DOWN_COUNTS_PER_S * elapsed_s, UP_COUNTS_PER_S * elapsed_s)
            # An electrode that was not known before is taken as it is.
            step = np.where(self._known[finger], limited, step)
        self._baseline[finger] += step
        self._known[finger] = known
        self._touches[finger].threshold = max(self._limits.counts, self._limits.sigmas * sigma)
        self.tared[finger] = True


class _Touch:
    """Whether one finger touches, by how far it has fallen and how it came there."""

    def __init__(self, threshold: float) -> None:
        self.threshold = threshold
        """Fall that makes a touch, counts."""
        self.touching = False
        self.fall = 0.0
        """Counts by which the third deepest electrode is below its baseline, and below the finger's
        median electrode: the smaller of both, and the latter alone where the finger touches
        already, for in a long hold the sensors drift. Zero without a baseline."""
        self._depth = 0.0
        self._lowest = 0.0
        """Smallest fall since it let go: a new touch falls from there, not from zero."""
        self._let_go_ns: int | None = None
        self._since_ns: int | None = None
        self._alone_since_ns: int | None = None
        self._held_long = False

    def end(self) -> None:
        """Where the finger rests is not known."""
        self.touching = False
        self.fall = self._depth = self._lowest = 0.0
        self._since_ns = self._alone_since_ns = None

    def follow(self, t_ns: int, elapsed_s: float, deep: float, relative: float) -> None:
        """Take in the fall of the third deepest electrode, below its baseline and relative."""
        touched = self.touching
        self.fall = relative if touched else min(deep, relative)
        if touched:
            self.touching = self.fall >= self._held(t_ns)
        else:
            apart = self._let_go_ns is None or not 0 <= t_ns - self._let_go_ns < APART_NS
            self.touching = apart and self.fall >= self.threshold + self._lowest
        self._held_long = False
        if self.touching:
            self._since_ns = t_ns if self._since_ns is None else self._since_ns
            self._depth = max(self.fall, self._depth - DEPTH_FADES_COUNTS_PER_S * elapsed_s)
            self._lowest = 0.0
            return
        if touched:
            self._let_go_ns = t_ns
            self._held_long = self._is_long(t_ns)
            self._lowest = self.fall
        self._since_ns = None
        self._depth = 0.0
        self._lowest = min(self._lowest, max(self.fall, 0.0))

    def must_be_tared_anew(self, t_ns: int, middle: float, *, accompanied: bool) -> bool:
        """Whether what is known of where the finger rests is to be trusted no longer.

        `middle` is the fall of its median electrode, `accompanied` whether all fingers touch.
        """
        if not self.touching:
            self._alone_since_ns = None
            # One that rests higher as a whole was tared while it touched, or has drifted far.
            return self._held_long or middle < -self.threshold
        if accompanied:
            self._alone_since_ns = None
        elif self._alone_since_ns is None:
            self._alone_since_ns = t_ns
        return self._alone_since_ns is not None and t_ns - self._alone_since_ns > ALONE_NS

    def _held(self, t_ns: int) -> float:
        """Fall from which on a finger that touches still does."""
        share = RELEASED_LONG if self._is_long(t_ns) else RELEASED
        return max(LET_GO * self.threshold, share * self._depth)

    def _is_long(self, t_ns: int) -> bool:
        return self._since_ns is not None and t_ns - self._since_ns > LONG_HOLD_NS


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
