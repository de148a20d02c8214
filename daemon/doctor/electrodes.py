"""Statistics of every electrode over a few seconds, and their faults."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from graspd.biotac import COUNT_MAX, ELECTRODES
from graspd.daemon.doctor.finding import Cause, Finding, Level, Trouble, fine
from graspd.drivers.base import ElectrodeFault, TactileReading

RAIL_COUNTS = 20
"""Largest distance of a mean from 0 or 4095, counts, at which an electrode counts as at a rail;
0.3 % of loaded electrodes come this low."""
QUIET_COUNTS = 40.0
"""Largest standard deviation of an untouched electrode, counts; 3 to 12 were measured."""
TOUCH_ELECTRODES = 5
"""Fewest electrodes of a finger that a touch moves. If fewer move, they are restless."""
STILL_READINGS = 10
"""Fewest readings, all with equal counts, to call an electrode frozen; noise is about 3 counts."""
RESTLESS_READINGS = 30
"""Fewest readings to call an electrode restless. With fewer, one spike would be enough."""
FAULTY_FRACTION = 0.5
"""Share of faulty readings above which an electrode counts as missing, not as unreliable."""
NAMED_MAX = 6
"""Most electrodes that a finding names; of more it says only how many they are."""
WORDS = ElectrodeFault.PARITY | ElectrodeFault.ERROR_WORD | ElectrodeFault.NOT_A_COUNT
DEAD = Trouble(
    Cause.ELECTRODE_DEAD,
    "The electrode is dead: it is at the end of its range, without noise. Refill or replace the "
    "sensor if it is the same on another day.",
    Level.ERROR,
)
FROZEN = Trouble(
    Cause.ELECTRODE_FROZEN,
    "Its count never changes, and others do. Look longer (--listen 20). If it stays, power-cycle "
    "the sensor.",
    Level.ERROR,
)
NEAR_RAIL = Trouble(
    Cause.ELECTRODE_RAIL, "It has noise, so it is alive. Empty the hand, and look again."
)
RESTLESS = Trouble(
    Cause.ELECTRODE_RESTLESS,
    "It jumps while its neighbours are still. Look again with the hand untouched and its motors "
    "off: a loose contact stays.",
)
WORDS_ADVICE = (
    "Words are damaged between sensor and board. Look longer (--listen 20). If it stays one "
    "sensor, check its cable and the edges of the clock."
)

Mask = NDArray[np.bool_]


class ElectrodeStatistics:
    """Running mean, spread and faults of every electrode, in constant memory (Welford)."""

    def __init__(self, fingers: Sequence[str]) -> None:
        self.fingers = tuple(fingers)
        shape = (len(fingers), ELECTRODES)
        self.readings = 0
        self.faulty = np.zeros(shape, dtype=np.int64)
        """Readings with a fault, shape (fingers, 24)."""
        self.fault_bits = np.zeros(shape, dtype=np.uint8)
        self.mean = np.zeros(shape)
        """Mean counts over readings without a fault, shape (fingers, 24)."""
        self._sound = np.zeros(shape, dtype=np.int64)
        self._squares = np.zeros(shape)
        self._previous = np.full(shape, np.nan)
        """Counts of the last reading; NaN for its faulty electrodes."""
        self._steps = np.zeros(shape, dtype=np.int64)
        self._step_squares = np.zeros(shape)

    def add(self, reading: TactileReading) -> None:
        """Take in one reading of these fingers."""
        self.readings += 1
        faulty = reading.faults != 0
        self.faulty += faulty
        self.fault_bits |= reading.faults
        self._sound += ~faulty
        step = np.where(faulty, 0.0, reading.counts - self.mean)
        self.mean += step / np.maximum(self._sound, 1)
        self._squares += step * np.where(faulty, 0.0, reading.counts - self.mean)
        counts = np.where(faulty, np.nan, reading.counts)
        change = counts - self._previous
        self._steps += ~np.isnan(change)
        self._step_squares += np.nan_to_num(change * change)
        self._previous = counts

    @property
    def deviation(self) -> NDArray[np.float64]:
        """Standard deviation over readings without a fault, counts, shape (fingers, 24)."""
        return np.sqrt(self._squares / np.maximum(self._sound, 1), dtype=np.float64)

    @property
    def noise(self) -> NDArray[np.float64]:
        """Standard deviation by steps from one reading to the next, counts, shape (fingers, 24); a
        slow touch does not raise it."""
        variance = self._step_squares / np.maximum(self._steps, 1) / 2.0
        return np.sqrt(variance, dtype=np.float64)

    def findings(self) -> list[Finding]:
        """Return the findings about the electrodes, finger by finger."""
        findings: list[Finding] = []
        for finger, name in enumerate(self.fingers if self.readings else ()):
            findings += self._of(finger, name)
        return findings

    def _of(self, finger: int, name: str) -> list[Finding]:
        missing = self.faulty[finger] > FAULTY_FRACTION * self.readings
        faults = ElectrodeFault(int(np.bitwise_or.reduce(self.fault_bits[finger])))
        mean, deviation = self.mean[finger], self.deviation[finger]
        enough = self._sound[finger] >= STILL_READINGS
        rail = ~missing & ((mean <= RAIL_COUNTS) | (mean >= COUNT_MAX - RAIL_COUNTS))
        still = ~missing & enough & (deviation == 0.0)
        if (missing | rail & still).all():
            return [_absent(name, missing, faults)]
        if still.all():
            advice = "Reset the board. Check that no relay or recording repeats old data."
            what = f"{name}: all counts are frozen"
            return [Finding(Level.ERROR, what, Cause.REPEATED, advice)]
        # A dead electrode is both at a rail and without noise.
        found = [_missing(name, missing, faults)] if missing.any() else []
        found += _named(name, rail & still, "stuck at a rail", DEAD)
        found += _named(name, still & ~rail, "frozen", FROZEN)
        found += _named(name, rail & ~still & enough, "near the end of the range", NEAR_RAIL)
        unreliable = (self.faulty[finger] > 0) & ~missing
        if unreliable.any():
            found.append(_unreliable(name, unreliable, faults))
        moving = ~missing & (deviation > QUIET_COUNTS)
        if np.count_nonzero(moving) >= TOUCH_ELECTRODES:
            moved = np.count_nonzero(moving)
            found.append(fine(f"{name} is touched or moves: {moved} of its electrodes do"))
        elif self.readings >= RESTLESS_READINGS:
            jumping = moving & (self.noise[finger] > QUIET_COUNTS)
            found += _named(name, jumping, "restless", RESTLESS)
        return found


def _absent(name: str, missing: Mask, faults: ElectrodeFault) -> Finding:
    if missing.any() and faults == ElectrodeFault.HELD:
        advice = "The board sends old values. Reset it, and check that its clock runs."
        return Finding(Level.ERROR, f"{name}: old values repeat", Cause.REPEATED, advice)
    why = _in_words(faults) if missing.any() else "each is at the end of its range, without noise"
    advice = "Check the finger's plug, its chip select and its supply."
    what = f"{name}: no electrode can be read ({why})"
    return Finding(Level.ERROR, what, Cause.SENSOR_ABSENT, advice)


def _missing(name: str, which: Mask, faults: ElectrodeFault) -> Finding:
    advice = "Check that the board's sequence has it. Lost frames are another finding."
    what = f"{_names(name, which)} never or rarely sampled ({_in_words(faults)})"
    if faults & WORDS:
        return Finding(Level.ERROR, what, Cause.SENSOR_WORDS, WORDS_ADVICE)
    return Finding(Level.ERROR, what, Cause.ELECTRODE_UNREAD, advice)


def _unreliable(name: str, which: Mask, faults: ElectrodeFault) -> Finding:
    what = f"{_names(name, which)} now and then faulty ({_in_words(faults)})"
    if faults & WORDS:
        return Finding(Level.WARNING, what, Cause.SENSOR_WORDS, WORDS_ADVICE)
    if faults & ElectrodeFault.HELD:
        advice = "The board repeats values at times. Check how long its sweep takes."
        return Finding(Level.WARNING, what, Cause.REPEATED, advice)
    advice = "Samples are lost. Check the load of the bus and of this computer."
    return Finding(Level.WARNING, what, Cause.ELECTRODE_UNREAD, advice)


def _named(finger: str, which: Mask, what: str, trouble: Trouble) -> list[Finding]:
    return [trouble.finding(f"{_names(finger, which)} {what}")] if which.any() else []


def _in_words(bits: ElectrodeFault) -> str:
    names = [fault.name or "" for fault in ElectrodeFault if fault & bits]
    return ", ".join(name.lower().replace("_", " ") for name in names) or "no fault"


def _names(finger: str, which: Mask) -> str:
    """Return the names of the electrodes in `which`, such as `ff_7`; over six, their number."""
    numbers = np.flatnonzero(which) + 1
    if len(numbers) > NAMED_MAX:
        return f"{finger}: {len(numbers)} electrodes"
    return ", ".join(f"{finger}_{number}" for number in numbers)
