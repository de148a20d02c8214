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
        self._baseline = np.zeros(shape)
        self._known = np.zeros(shape, dtype=np.bool_)
        self._threshold = np.full(fingers, limits.counts)
        self._depth = np.zeros(fingers)
        self._let_go_ns: list[int | None] = [None] * fingers
        self._lowest = np.zeros(fingers)
        """Smallest fall since each finger let go: a new touch falls from there, not from zero."""
        self._touches_since_ns: list[int | None] = [None] * fingers
        self._alone_since_ns: list[int | None] = [None] * fingers
        self._last_ns: int | None = None
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
        number = sound.sum(axis=1)
        # With too few electrodes nobody knows any more: to find out, it must be tared again.
        self.tared &= number >= SOUND_MIN
        self.fall, middle = self._falls(median, sound, number)
        self._follow_touches(t_ns)
        for finger, tare in enumerate(self._tares):
            if self.tared[finger] and self._must_tare_anew(finger, middle[finger], t_ns):
                self._forget(finger)
            if self.tared[finger] and self.fall[finger] >= SUSPECT * self._threshold[finger]:
                tare.clear()
            elif tare.add(counts[finger], usable[finger]):
                self._settle(finger, tare, t_ns)

    def _falls(
        self, median: NDArray[np.uint16], sound: NDArray[np.bool_], number: NDArray[np.int64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Each finger's `fall`, and the fall of its median electrode, counts."""
        falls = np.where(sound, self._baseline - median, np.inf)
        falls.sort(axis=1)  # those that do not count come last
        fall, middle = np.zeros(len(falls)), np.zeros(len(falls))
        for finger in np.flatnonzero(self.tared):
            deep = falls[finger, number[finger] - FALLEN]
            middle[finger] = falls[finger, number[finger] // 2]
            relative = deep - middle[finger]
            fall[finger] = relative if self.touching[finger] else min(deep, relative)
        return fall, middle

    def _follow_touches(self, t_ns: int) -> None:
        """Which fingers touch now, how deep, since when, and which without the others."""
        elapsed_s = 0.0 if self._last_ns is None else max(t_ns - self._last_ns, 0) / 1e9
        self._last_ns = t_ns
        long = [
            since is not None and t_ns - since > LONG_HOLD_NS for since in self._touches_since_ns
        ]
        share = np.where(long, RELEASED_LONG, RELEASED)
        held = self.fall >= np.maximum(LET_GO * self._threshold, share * self._depth)
        apart = [at is None or not 0 <= t_ns - at < APART_NS for at in self._let_go_ns]
        begins = (self.fall >= self._threshold + self._lowest) & apart
        touched = self.touching
        self.touching = self.tared & np.where(touched, held, begins)
        for let_go in np.flatnonzero(touched & ~self.touching):
            self._let_go_ns[let_go] = t_ns
        # While it touches the fall is only that of a share of the electrodes: it starts anew.
        lowest = np.where(touched, self.fall, self._lowest)
        self._lowest = np.where(self.touching, 0.0, np.minimum(lowest, np.maximum(self.fall, 0.0)))
        faded = self._depth - DEPTH_FADES_COUNTS_PER_S * elapsed_s
        self._depth = np.where(self.touching, np.maximum(self.fall, faded), 0.0)
        alone = self.touching & ~self.touching.all()
        for finger in range(len(self.touching)):
            if not alone[finger]:
                self._alone_since_ns[finger] = None
            elif self._alone_since_ns[finger] is None:
                self._alone_since_ns[finger] = t_ns

    def _must_tare_anew(self, finger: int, middle: float, t_ns: int) -> bool:
        """Whether what is known of where the finger rests is to be trusted no longer."""
        since_ns = self._touches_since_ns[finger]
        if self.touching[finger]:
            self._touches_since_ns[finger] = t_ns if since_ns is None else since_ns
            alone_ns = self._alone_since_ns[finger]
            return alone_ns is not None and t_ns - alone_ns > ALONE_NS
        self._touches_since_ns[finger] = None
        if since_ns is not None and t_ns - since_ns > LONG_HOLD_NS:
            return True
        # A finger that rests higher as a whole was tared while it touched, or has drifted far.
        return middle < -float(self._threshold[finger])

    def _forget(self, finger: int) -> None:
        self.tared[finger] = self.touching[finger] = False
        self._known[finger] = False
        self._depth[finger] = 0.0
        self._lowest[finger] = 0.0
        self._touches_since_ns[finger] = self._alone_since_ns[finger] = None
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
