"""Check whether a reading can be used, and which of its electrodes are broken."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from graspd.biotac import COUNT_MAX, ELECTRODES
from graspd.daemon.judge.reasons import Reason
from graspd.drivers.base import ElectrodeFault, TactileReading
from graspd.models.electrodes import too_many

REASON_OF_FAULT: dict[ElectrodeFault, Reason] = {
    ElectrodeFault.MISSING: Reason.SENSOR_MISSING,
    ElectrodeFault.NOT_A_COUNT: Reason.NOT_A_COUNT,
    ElectrodeFault.PARITY: Reason.PARITY,
    ElectrodeFault.ERROR_WORD: Reason.ERROR_WORD,
    ElectrodeFault.HELD: Reason.HELD,
    ElectrodeFault.CUT_OFF: Reason.CUT_OFF,
}
"""Reason for each fault that a driver can flag."""
REPAIRABLE = int(
    ElectrodeFault.MISSING
    | ElectrodeFault.NOT_A_COUNT
    | ElectrodeFault.PARITY
    | ElectrodeFault.ERROR_WORD
)
"""Bits of faults that concern one electrode. Any other bit makes the whole reading unusable."""

UNCHANGED_MAX = 16
"""Readings in a row that repeat an electrode's count, after which it counts as dead.

The noise of a live one is 3 to 4 counts (standard deviation). It keeps its count about once in ten
readings, never 16 times in a row.
"""
JUMP_COUNTS = 150
"""A larger step is a jump, counts. Spikes of a live electrode are 25 to 150 counts high."""
STILL_COUNTS = 30
"""Largest step of an electrode that keeps still, counts."""
STILL = 20
"""Fewest electrodes of a finger, of 24, that must keep still for a step of another to be a jump.

A finger that touches moves many electrodes. In a table each reading is another grasp, and nearly
all differ.
"""
JUMPS_MAX = 2.0
"""Largest number of recent jumps, faded, of a sound electrode; more are a loose contact."""
JUMPS_FADE = 0.9
"""Factor by which earlier jumps count less with each reading."""
JUMPS_FORGOTTEN = 1e-9
"""Weight below which a past jump is forgotten; it is reached after 200 readings."""
LIMITS = COUNT_MAX - 2, 2 * JUMP_COUNTS, 0
"""Limits of three 16-bit differences; see `_compare`. Negative ones wrap round, so they are large.

Above the first, `count - 1` is at a rail. Above the second, `step + JUMP_COUNTS` is a jump. Above
the third, the step is not 0.
"""
SWEEPS = 128
"""Number of sweeps of each finger that are remembered. Longer cycles of old data are not found."""
EQUAL_MIN = 20
"""Fewest electrodes of 24, equal or not read, by which a sweep repeats an earlier one.

In 1.4 million pairs of real sweeps of a finger, at most 14 electrodes were equal.
"""
READ_MIN = 12
"""Fewest equal electrodes of a repeated sweep that were read both times."""
NO_COUNT = 0x8000
"""Value in place of a count that was not read; by 16-bit differences far from every count."""


@dataclass(frozen=True, slots=True, eq=False)
class Checked:
    """Result of checking a reading."""

    reasons: tuple[Reason, ...]
    """Reasons against using the reading; empty if it can be used."""
    broken: NDArray[np.bool_] | None
    """True for electrodes whose counts mean nothing, shape (fingers, 24). None: all are sound."""


SOUND = Checked((), None)


class Health:
    """Finds broken electrodes and repeated sweeps by comparing each reading with those before."""

    def __init__(self, fingers: int, *, stream: bool = True) -> None:
        """`stream`: False if each reading is another grasp, so that one may recur."""
        self._stream = stream
        self._shape = shape = (fingers, ELECTRODES)
        self._previous = np.full(shape, NO_COUNT, dtype=np.uint16)
        """Last count of each electrode that was read, shape (fingers, 24), as what follows."""
        self._number = 0
        """Number of readings until now."""
        self._changed = np.zeros(shape, dtype=np.int64)
        """Number of the reading in which the count of each electrode changed last."""
        self._jumps = np.zeros(shape)
        """Number of jumps of each electrode, each weighted by `JUMPS_FADE` per reading since."""
        self._has_jumped = False
        """True if `_jumps` is not all zero."""
        self._faults = np.zeros(shape, dtype=np.uint8)
        """Faults that the driver flagged in the last reading."""
        self._past = np.full((ELECTRODES, fingers, SWEEPS), NO_COUNT, dtype=np.uint16)
        """Sweeps of each finger; `NO_COUNT` where none was read."""
        self._no_faults = self._faults.tobytes()
        # Constants of full shape, and buffers: numpy takes half the time.
        self._one, self._jump, *limits = (
            np.full(shape, number, dtype=np.uint16) for number in (1, JUMP_COUNTS, *LIMITS)
        )
        self._limits = np.stack(limits)
        self._above = np.empty_like(self._limits)
        self._equal = np.empty((ELECTRODES, fingers, SWEEPS), dtype=np.bool_)
        self._equals = np.empty((fingers, SWEEPS), dtype=np.uint8)

    def check(self, reading: TactileReading) -> Checked:
        """Take in the next reading; return whether it can be used, and its broken electrodes."""
        counts = reading.counts
        if counts.shape != self._shape:
            return Checked((Reason.MODEL_MISMATCH,), np.ones(self._shape, dtype=np.bool_))
        self._faults = reading.faults
        sound, faults = None, 0
        # Nearly all readings are sound, which a few cheap operations find out.
        if reading.faults.tobytes() == self._no_faults:
            railed = self._compare(counts)
        else:
            # Flagged counts were not read, so they neither jump nor repeat a sweep.
            sound = reading.faults == 0
            faults = int(np.bitwise_or.reduce(reading.faults, axis=None))
            railed = self._compare(np.where(sound, counts, self._previous)) & sound
            self._changed[~sound] += 1  # neither ends nor lengthens a run of equal counts
        broken = railed | self._worn_out()
        if sound is not None:
            broken |= ~sound
        repeats = self._stream and self._recurs(counts, sound)
        if faults & ~REPAIRABLE:  # flagged counts mean nothing: no further findings on them
            return Checked(_fault_reasons(faults), broken)
        if repeats:
            also = (Reason.SATURATED,) if too_many(railed) else ()
            return Checked((Reason.FROZEN, *also), broken)
        if 1 not in broken.tobytes():
            return SOUND
        if too_many(broken):
            reasons = [*_fault_reasons(faults)]
            if railed.any():
                reasons.append(Reason.SATURATED)
            return Checked((*reasons, Reason.ELECTRODES_BROKEN), broken)
        return Checked((), broken)

    def electrodes(self) -> dict[tuple[int, int], Reason]:
        """Return the current reason of each broken electrode, by (row of the finger, electrode
        0..23)."""
        findings: dict[tuple[int, int], Reason] = {}
        for where, reason in (
            (self._jumps > JUMPS_MAX, Reason.ELECTRODE_JUMPS),
            (self._changed <= self._number - UNCHANGED_MAX, Reason.ELECTRODE_DEAD),
            (at_rail(self._previous) & (self._previous != NO_COUNT), Reason.SATURATED),
        ):
            findings |= dict.fromkeys(_places(where), reason)
        for finger, electrode in _places(self._faults != 0):
            findings[finger, electrode] = _fault_reasons(int(self._faults[finger, electrode]))[0]
        return findings

    def _compare(self, counts: NDArray[np.uint16]) -> NDArray[np.bool_]:
        """Note which counts changed or jumped since the last reading; return those at a rail.

        `counts`: the last count of an electrode stands for one that was not read.
        """
        previous = self._previous
        self._number += 1
        above = self._above
        np.subtract(counts, self._one, out=above[0])
        step = np.subtract(counts, previous, out=above[2])
        np.add(step, self._jump, out=above[1])
        railed: NDArray[np.bool_]
        railed, far, differs = above > self._limits
        np.putmask(self._changed, differs, self._number)
        if self._has_jumped:
            self._jumps *= JUMPS_FADE
            remembered = self._jumps >= JUMPS_FORGOTTEN
            self._jumps *= remembered
            self._has_jumped = 1 in remembered.tobytes()
        if 1 in far.tobytes():
            near = counts - previous + STILL_COUNTS <= 2 * STILL_COUNTS
            if np.count_nonzero(near) >= STILL:  # some finger may keep still
                jumps = far & (near.sum(axis=1, keepdims=True) >= STILL)
                self._has_jumped |= 1 in jumps.tobytes()
                self._jumps += jumps
        self._previous = counts
        return railed

    def _recurs(self, counts: NDArray[np.uint16], sound: NDArray[np.bool_] | None) -> bool:
        """Take in a sweep, shape (fingers, 24). Return True if some finger repeats one of its last
        `SWEEPS`. `sound`: True for counts that were read; None: all were."""
        past, place = self._past, self._number % SWEEPS
        now = kept = counts.T
        if sound is not None:
            now = np.where(sound, counts, np.uint16(NO_COUNT)).T
            kept = np.where(sound.sum(axis=1) >= READ_MIN, now, past[:, :, place])
        equal = np.equal(past, now[:, :, np.newaxis], out=self._equal)
        equals = np.add.reduce(equal.view(np.uint8), axis=0, out=self._equals)
        again = False
        if equals.item(equals.argmax()) >= READ_MIN:
            read = (past != NO_COUNT) & (now[:, :, np.newaxis] != NO_COUNT)
            both = np.count_nonzero(equal & read, axis=0)
            unread = ELECTRODES - np.count_nonzero(read, axis=0)
            same = (both >= READ_MIN) & (both + unread >= EQUAL_MIN)
            for finger in np.flatnonzero(same.any(axis=1)):
                again = True
                # A repeated sweep takes the place of its first copy, so no other is forgotten.
                past[:, finger, same[finger].argmax()] = past[:, finger, place]
        past[:, :, place] = kept
        return again

    def _worn_out(self) -> NDArray[np.bool_]:
        """Return the electrodes, (fingers, 24), that the last readings show to be broken."""
        worn_out: NDArray[np.bool_] = self._changed <= self._number - UNCHANGED_MAX
        if self._has_jumped:
            worn_out |= self._jumps > JUMPS_MAX
        return worn_out


def at_rail(counts: NDArray[np.uint16]) -> NDArray[np.bool_]:
    """Return True for counts of 0, or of 4095 and more, in the shape of `counts`."""
    # One less than 0 is 65535: both rails are on the same side.
    railed: NDArray[np.bool_] = counts - np.uint16(1) >= np.uint16(COUNT_MAX - 1)
    return railed


def _places(where: NDArray[np.bool_]) -> list[tuple[int, int]]:
    return [(int(finger), int(electrode)) for finger, electrode in np.argwhere(where)]


def _fault_reasons(bits: int) -> tuple[Reason, ...]:
    if not bits:
        return ()
    known = tuple(reason for fault, reason in REASON_OF_FAULT.items() if bits & fault)
    return known or (Reason.NOT_A_COUNT,)  # an unknown flag is still a flag
