"""Tare and contact: the resting count of each electrode, its noise, and which fingers touch.

A touch lowers the counts of several electrodes (BioTac SP manual, section 5). They fall below their
baseline, and below the finger's median electrode. Supply voltage and temperature move all
electrodes alike.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from graspd.biotac import COUNT_MAX, ELECTRODES

WINDOW = 100
"""Untouched sweeps whose median is a baseline: one second at 100 Hz."""
READ_MIN = 60
"""Fewest of the sweeps of a window in which an electrode with a baseline was usable, of `WINDOW`.

Nearly all electrodes have as many on a link that loses 5 % of single samples. An electrode that is
broken for longer has no baseline.
"""
TARE_EVERY = 25
"""Untouched sweeps from one tare to the next."""
TOUCH_COUNTS = 20.0
"""Smallest fall below the baseline that counts as a touch, counts.

In 9.8 s of three untouched sensors no fall was over 10. On the same sensors each fall of three
electrodes by 24 was seen as a touch.
"""
TOUCH_SIGMAS = 5.0
"""Smallest fall of a touch, in units of the finger's noise, `Rest.sigma`."""
FALLEN = 3
"""Rank of the fall that decides: the third deepest. A spike hits one electrode, rarely two."""
SOUND_MIN = 12
"""Fewest usable electrodes, of 24, by which contact of a finger is known."""
LET_GO = 0.6
"""A touching finger lets go when its fall is below this share of a touch's threshold."""
RELEASED = 0.25
"""A touching finger also lets go when its fall is below this share of the depth of its hold.

Electrodes drift apart in a long hold, so an open hand may look as if it touched lightly.
"""
RELEASED_LONG = 0.5
"""Value of `RELEASED` after a hold of `LONG_HOLD_NS`: drift grows with time."""
DEPTH_FADES_COUNTS_PER_S = 5.0
"""Speed at which the remembered depth of a hold falls while the finger presses less."""
APART_NS = 50_000_000
"""Shortest time from letting go to the next touch, ns.

The electrodes of an opening finger rise one sweep after the other, which looks like a touch.
"""
LONG_HOLD_NS = 60_000_000_000
"""Longest hold after whose end a finger keeps its tare, ns.

Electrodes of one finger drift apart by 0.2 counts/s (measured on three sensors). After this time
the drift is more than half of `TOUCH_COUNTS`.
"""
ALONE_NS = 30_000_000_000
"""Longest touch while another finger does not touch, ns; after it the tare is forgotten."""
SUSPECT = 0.5
"""A sweep with a fall above this share of a touch's threshold is not used for the tare."""
SIGMA_MIN_COUNTS = 1.5
"""Smallest assumed noise of an electrode, counts; a quiet one may show no noise at all."""
SIGMA_MAX_COUNTS = 10.0
"""Largest noise of the median electrode of a finger at rest, counts; measured 2.9 to 4.3."""
TREND_MAX_COUNTS = 5.0
"""Largest change of a finger at rest from one half of a window to the other, counts (median of its
electrodes)."""
UP_COUNTS_PER_S, DOWN_COUNTS_PER_S = 5.0, 1.5
"""Largest speeds at which a baseline rises and falls.

Sensors that warm up drift by 0.56 to 0.84 counts/s upward (measured on three). A baseline that
falls faster would follow a slow touch.
"""
MAD_TO_SIGMA = 1.4826
"""Ratio of a Gaussian's standard deviation to its median absolute deviation."""

Floats = NDArray[np.float64]


@dataclass(slots=True, eq=False)
class Touch:
    """Decides whether one finger touches, from its falls below the baseline."""

    threshold: float = TOUCH_COUNTS
    """Smallest fall of a touch, counts."""
    touching: bool = False
    fall: float = 0.0
    """Fall of the third deepest electrode, counts; 0 without a baseline.

    Untouched: below its baseline or below the finger's median electrode, whichever is less.
    Touching: below the median electrode, because sensors drift.
    """
    depth: float = 0.0
    """Deepest fall of the hold, counts; it fades by `DEPTH_FADES_COUNTS_PER_S`."""
    lowest: float = 0.0
    """Smallest fall since the finger let go, counts; the next touch is `threshold` above it."""
    let_go_ns: int | None = None
    """Time at which the last touch ended. None: none has ended yet."""
    since_ns: int | None = None
    """Time at which the touch began. None: the finger does not touch."""
    alone_since_ns: int | None = None
    """Time since which this finger has touched while another did not. None: not the case."""
    held_long: bool = False
    """True at the sweep in which a long hold ends."""
    untouched: int = 0
    """Sweeps since the last fall that may be a touch."""
    tared_ns: int | None = None
    """Time of the last tare. None: never."""

    def end(self) -> None:
        """End any touch. Call while the finger has no baseline."""
        self.touching = False
        self.fall = self.depth = self.lowest = 0.0
        self.since_ns = self.alone_since_ns = None

    def follow(self, t_ns: int, elapsed_s: float, deep: float, relative: float) -> None:
        """Take in the sweep of `t_ns`, `elapsed_s` after the one before.

        `deep`, `relative`: fall of the third deepest electrode below its baseline, and below the
        finger's median electrode, counts.
        """
        touched = self.touching
        is_long = self.since_ns is not None and t_ns - self.since_ns > LONG_HOLD_NS
        if touched:
            self.fall = relative
            share = RELEASED_LONG if is_long else RELEASED
            self.touching = self.fall >= max(LET_GO * self.threshold, share * self.depth)
        else:
            self.fall = min(deep, relative)
            apart = self.let_go_ns is None or not 0 <= t_ns - self.let_go_ns < APART_NS
            self.touching = apart and self.fall >= self.threshold + self.lowest
        self.held_long = False
        if self.touching:
            self.since_ns = t_ns if self.since_ns is None else self.since_ns
            self.depth = max(self.fall, self.depth - DEPTH_FADES_COUNTS_PER_S * elapsed_s)
            self.lowest = 0.0
            return
        if touched:
            self.let_go_ns = t_ns
            self.held_long = is_long
            self.lowest = self.fall
        self.since_ns = self.alone_since_ns = None
        self.depth = 0.0
        self.lowest = min(self.lowest, max(self.fall, 0.0))

    def has_lost_rest(self, t_ns: int, middle: float) -> bool:
        """Return True if the finger must be tared again. Call it while not all fingers touch.

        Reasons for a new tare: a long hold has ended, the whole finger rests above its baseline, or
        it has touched for over `ALONE_NS` while not all fingers do. `middle`: fall of its median
        electrode, counts.
        """
        if not self.touching:
            # A finger that rests higher was tared while it touched, or has drifted far.
            return self.held_long or middle < -self.threshold
        if self.alone_since_ns is None:
            self.alone_since_ns = t_ns
        return t_ns - self.alone_since_ns > ALONE_NS


class Rest(NamedTuple):
    """Tare of one finger; arrays have shape (24,)."""

    baseline: Floats
    """Resting count of each electrode."""
    sigma: float
    """Noise of the finger: median of its electrodes' standard deviations, counts."""
    known: NDArray[np.bool_]
    """True for electrodes whose baseline is known."""


@dataclass(slots=True, eq=False)
class Window:
    """Ring buffer of the last `WINDOW` sweeps; arrays have shape (100, fingers, 24)."""

    counts: NDArray[np.uint16]
    usable: NDArray[np.bool_]
    number: int = 0
    """Number of sweeps added so far."""

    @classmethod
    def of(cls, fingers: int) -> Window:
        """Return an empty window."""
        shape = (WINDOW, fingers, ELECTRODES)
        return cls(np.zeros(shape, dtype=np.uint16), np.zeros(shape, dtype=np.bool_))

    def add(self, counts: NDArray[np.uint16], usable: NDArray[np.bool_] | None) -> None:
        """Take in a sweep, shape (fingers, 24), and which electrodes are usable; None: all.

        The others keep their value of the sweep before.
        """
        place = self.number % WINDOW
        self.counts[place] = (
            counts if usable is None else np.where(usable, counts, self.counts[place - 1])
        )
        self.usable[place] = True if usable is None else usable
        self.number += 1

    def rests(self, fingers: Sequence[int]) -> Iterator[Rest | None]:
        """Yield the tare of each of `fingers` (rows); None: it moved, or few electrodes are sound.

        Call it after at least `WINDOW` sweeps.
        """
        oldest = self.number % WINDOW
        sweeps = np.concatenate((self.counts[oldest:], self.counts[:oldest]))
        # Counts that are contiguous by electrode and 32 bits wide sort in a quarter of the time.
        window = np.ascontiguousarray(sweeps.transpose(1, 2, 0), dtype=np.int32)
        halves = _median(window[..., WINDOW // 2 :]) - _median(window[..., : WINDOW // 2])
        baseline = _median(window)
        # A median may end in .5: doubled, all values are whole numbers.
        twice = np.abs(2 * window - (2.0 * baseline).astype(np.int32)[..., np.newaxis])
        sigmas = MAD_TO_SIGMA * (_median(twice) / 2.0)
        usable = np.count_nonzero(self.usable, axis=0) >= READ_MIN
        sound = (baseline > 0) & (baseline < COUNT_MAX) & (sigmas <= 3.0 * SIGMA_MAX_COUNTS)
        sound &= usable
        for finger in fingers:
            known = usable[finger]
            if np.count_nonzero(sound[finger]) < SOUND_MIN:
                yield None
                continue
            sigma = max(_median(sigmas[finger, known]).item(), SIGMA_MIN_COUNTS)
            trend = abs(_median(halves[finger, known]).item())
            moved = sigma > SIGMA_MAX_COUNTS or trend > TREND_MAX_COUNTS
            yield None if moved else Rest(baseline[finger], sigma, sound[finger])


class Contact:
    """Tares all fingers while they rest, and finds which touch. Constant memory, no clock."""

    def __init__(self, fingers: int) -> None:
        """`fingers`: their number. No finger has a baseline yet."""
        shape = (fingers, ELECTRODES)
        self.touches = [Touch() for _ in range(fingers)]
        self.touching = [False] * fingers
        """True for fingers that touch."""
        self.tared = [False] * fingers
        """True for fingers that have a baseline; contact of the others is not known."""
        self.baseline = np.full(shape, np.inf)
        """Resting count of each electrode, shape (fingers, 24); infinite: not known yet."""
        self.window = Window.of(fingers)
        self._known = [0] * fingers
        """Number of electrodes of each finger whose baseline is known."""
        self._last_ns: int | None = None
        """Time of the last sweep."""

    def forget(self) -> None:
        """Forget every tare. Call when sensors were exchanged, or may have been off."""
        for finger in range(len(self.touches)):
            self._forget(finger)

    def observe(
        self,
        t_ns: int,
        counts: NDArray[np.uint16],
        median: NDArray[np.uint16],
        usable: NDArray[np.bool_] | None,
    ) -> None:
        """Update `touching`, `tared` and `baseline` by the sweep `counts` of `t_ns`.

        `median`: that of each electrode's last three values. Arrays have shape (fingers, 24).
        `usable`: False for electrodes to ignore; None: use all.
        """
        falls, numbers = self._falls(median, usable)
        last_ns = t_ns if self._last_ns is None else min(self._last_ns, t_ns)
        elapsed_s, self._last_ns = (t_ns - last_ns) / 1e9, t_ns
        self.window.add(counts, usable)
        middles = [0.0] * len(numbers)
        all_touch = True
        for finger, touch in enumerate(self.touches):
            number = numbers[finger]
            if self.tared[finger] and number >= SOUND_MIN:
                deep = falls.item(finger, number - FALLEN)
                middles[finger] = falls.item(finger, number // 2)
                touch.follow(t_ns, elapsed_s, deep, deep - middles[finger])
            else:
                # With too few usable electrodes, contact is unknown until the next tare.
                self.tared[finger] = False
                touch.end()
            self.touching[finger] = touch.touching
            all_touch &= touch.touching
        for finger, touch in enumerate(self.touches):
            if all_touch:
                touch.alone_since_ns = None
            elif self.tared[finger] and touch.has_lost_rest(t_ns, middles[finger]):
                self._forget(finger)
        due = []
        for finger, touch in enumerate(self.touches):
            touch.untouched += 1
            if self.tared[finger] and touch.fall >= SUSPECT * touch.threshold:
                touch.untouched = 0  # it may be the beginning of a touch
            elif touch.untouched >= WINDOW and touch.untouched % TARE_EVERY == 0:
                due.append(finger)
        if due:
            for finger, rest in zip(due, self.window.rests(due), strict=True):
                if rest is not None:
                    self._settle(finger, rest, t_ns)

    def _falls(
        self, median: NDArray[np.uint16], usable: NDArray[np.bool_] | None
    ) -> tuple[NDArray[np.float64], list[int]]:
        """Return each finger's falls below its baseline, ascending, shape (fingers, 24), and how
        many are of usable electrodes. The others are infinite, so they come last."""
        falls, numbers = median.astype(np.float64), self._known
        np.subtract(self.baseline, falls, out=falls)
        if usable is not None:
            falls[~usable] = np.inf
            numbers = np.isfinite(falls).sum(axis=1).tolist()
        falls.sort(axis=1)
        return falls, numbers

    def _forget(self, finger: int) -> None:
        self.tared[finger] = self.touching[finger] = False
        self.baseline[finger], self._known[finger] = np.inf, 0
        self.touches[finger] = Touch(self.touches[finger].threshold)

    def _settle(self, finger: int, rest: Rest, t_ns: int) -> None:
        """Adopt `rest` as a finger's tare; a known baseline changes at most at the speed limits."""
        touch, former, baseline = self.touches[finger], self.baseline[finger], rest.baseline
        last_ns = t_ns if touch.tared_ns is None else min(touch.tared_ns, t_ns)
        elapsed_s, touch.tared_ns = (t_ns - last_ns) / 1e9, t_ns
        if self.tared[finger]:
            lowest = former - DOWN_COUNTS_PER_S * elapsed_s
            highest = former + UP_COUNTS_PER_S * elapsed_s
            # The baseline of an electrode that had none is not limited.
            limited = np.minimum(np.maximum(baseline, lowest), highest)
            baseline = np.where(np.isfinite(former), limited, baseline)
        self.baseline[finger] = np.where(rest.known, baseline, np.inf)
        self._known[finger] = int(np.count_nonzero(rest.known))
        touch.threshold = max(TOUCH_COUNTS, TOUCH_SIGMAS * rest.sigma)
        self.tared[finger] = True


def _median(values: NDArray[np.number]) -> Floats:
    """Sort in place along the last axis; return the medians, in a fifth of `np.median`'s time."""
    values.sort()
    number = values.shape[-1]
    low, high = values[..., (number - 1) // 2], values[..., number // 2]
    return np.asarray(low / 2.0 + high / 2.0)
