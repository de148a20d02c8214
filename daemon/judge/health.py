"""Whether a reading may be judged at all, and if not, why; and what of it had to be repaired."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from daemon.judge.session import SessionCalibration
from daemon.judge.verdict import Reason
from drivers.base import COUNT_MAX, ELECTRODES, ElectrodeFault, TactileReading
from models.contract import SeenCounts
from models.electrodes import Electrodes
from models.seen import SeenCheck

REASON_OF_FAULT: dict[ElectrodeFault, Reason] = {
    ElectrodeFault.MISSING: Reason.SENSOR_MISSING,
    ElectrodeFault.NOT_A_COUNT: Reason.NOT_A_COUNT,
    ElectrodeFault.PARITY: Reason.PARITY,
    ElectrodeFault.ERROR_WORD: Reason.ERROR_WORD,
    ElectrodeFault.HELD: Reason.HELD,
    ElectrodeFault.CUT_OFF: Reason.CUT_OFF,
}
"""What the judge says of each fault that a driver can flag."""
REPAIRABLE = int(
    ElectrodeFault.MISSING
    | ElectrodeFault.NOT_A_COUNT
    | ElectrodeFault.PARITY
    | ElectrodeFault.ERROR_WORD
)
"""Bits of single electrodes. All others, known or not, speak against the whole reading."""

BROKEN_MAX = 12
"""Electrodes of a hand that may be repaired: twelve at random, repaired, cost `cnn1` 1.2 +- 0.3
points of F1 and `small-session` 0.6 +- 0.2, eighteen 2.1 and 1.3 (grasps not trained on, `cv`)."""
BROKEN_FINGER_MAX = 8
"""Of one finger: eight neighbours of the first finger, the worst place, cost 2.4 +- 0.8 and
1.4 +- 0.5 points, twelve 4.3 and 2.8; of another finger eight cost 0.6 at most."""
CONTRADICTING_MAX = 2
"""Electrodes that may contradict the others without anything else being known against them. Of
held-out grasps 99 % are judged with it; of readings with each electrode from another grasp none is,
and with a limit of four a tenth would be."""
FLAT_SPREAD_COUNTS = 70.0
"""Standard deviation of a finger's electrodes below which it is not touching, or not working: half
of the smallest of 4682 real grasps, 148."""
UNCHANGED_MAX = 16
"""Readings in a row in which a live electrode may keep its count. Its noise is 3 to 4 counts
(standard deviation), so it keeps it about once in ten readings, 16 times in a row never; and all
24 of a finger do not even keep it once. Something along the way repeats old data."""
JUMP_COUNTS = 150
"""A live electrode's spikes are 25 to 150 counts high; a jump is higher ..."""
STILL_COUNTS = 30
"""... while no electrode but itself and three others moves by more than this: a finger that touches
moves many, and in a table, where each reading is another grasp, nearly all differ."""
STILL = 20
"""Electrodes of 24 that must keep still."""
JUMPS_MAX = 2.0
"""An electrode that jumps more than twice within about ten readings has a loose contact."""
JUMPS_FADE = 0.9
NO_COUNT = 0xFFFF


@dataclass(frozen=True, slots=True, eq=False)
class Findings:
    """What was found in one reading."""

    reasons: tuple[Reason, ...]
    """Against judging it; none if it is sound, or has been repaired."""
    counts: NDArray[np.generic]
    """Shape (fingers, 24), with the broken electrodes repaired; as read where there are reasons."""
    repaired: NDArray[np.bool_] | None = None
    """Shape (fingers, 24); None if nothing had to be."""
    grasp: NDArray[np.generic] | None = None
    """Shape (fingers, 24): what a session may take in, even if it is like nothing that was seen
    before, because that is how a drifted sensor starts. Only electrodes that are certainly broken
    are repaired in it. None where the reading tells nothing."""


class Health:
    """Examines one reading after the other; remembers what has not changed and what jumps."""

    def __init__(
        self, fingers: int, seen: SeenCounts, session: SessionCalibration | None = None
    ) -> None:
        """`seen` is what the model was trained on, `session` how today's sensors differ from it."""
        self._shape = (fingers, ELECTRODES)
        self._seen = SeenCheck(seen)
        self._electrodes = Electrodes(seen)
        self._session = session
        self._previous = np.full(self._shape, NO_COUNT, dtype=np.uint16)
        self._unchanged = np.zeros(self._shape, dtype=np.int64)
        """Readings in a row in which each electrode has not changed."""
        self._jumps = np.zeros(self._shape)
        """Recent jumps of each electrode, fading."""

    def examine(self, reading: TactileReading) -> Findings:
        """Reasons against judging this reading, or the counts to judge it by."""
        counts = reading.counts
        if counts.shape != self._shape:
            return Findings((Reason.MODEL_MISMATCH,), counts)
        faults = int(np.bitwise_or.reduce(reading.faults, axis=None))
        repeats = self._compare(counts)
        if faults & ~REPAIRABLE:  # flagged counts mean nothing: no further findings on them
            return Findings(_fault_reasons(faults), counts)
        railed = (counts == 0) | (counts >= COUNT_MAX)
        if repeats:
            also = (Reason.SATURATED,) if _too_many(railed) else ()
            return Findings((Reason.FROZEN, *also), counts)
        broken = (
            (reading.faults != 0)
            | railed
            | (self._unchanged >= UNCHANGED_MAX)
            | (self._jumps > JUMPS_MAX)
        )
        if _too_many(broken):
            reasons = [*_fault_reasons(faults)]
            if (railed & (reading.faults == 0)).any():
                reasons.append(Reason.SATURATED)
            return Findings((*reasons, Reason.ELECTRODES_BROKEN), counts)
        if _is_flat(counts, broken):
            return Findings((Reason.FLAT,), counts)
        return self._compare_with_training(counts, broken)

    def _compare_with_training(
        self, counts: NDArray[np.uint16], broken: NDArray[np.bool_]
    ) -> Findings:
        values = self._to_training(counts)
        grasp, values = self._repair(counts, values, broken)
        at_most = int(np.count_nonzero(broken)) + CONTRADICTING_MAX + 1
        found = self._electrodes.implausible(values, broken, at_most)
        if np.count_nonzero(found) == at_most or _too_many(found):
            # So much does not fit that the reading as a whole is like nothing in the training.
            return self._never_seen(counts, grasp)
        repaired, values = self._repair(counts, values, found)
        if self._session is not None and self._is_odd(self._session, repaired):
            return self._never_seen(counts, grasp)
        if self._seen.never_seen(values[np.newaxis], int(np.count_nonzero(found))).any():
            return self._never_seen(counts, grasp)
        return Findings((), repaired, found if found.any() else None, grasp)

    def _never_seen(self, counts: NDArray[np.uint16], grasp: NDArray[np.generic]) -> Findings:
        """Refused; a session learns from it only while it is young: that is how drift begins.

        A calibrated one does not, or a sensor that fails would slowly become its own standard.
        """
        young = self._session is None or not self._session.calibrated
        return Findings((Reason.NEVER_SEEN,), counts, None, grasp if young else None)

    def _is_odd(self, session: SessionCalibration, counts: NDArray[np.generic]) -> bool:
        """Whether session or reading cannot be of grasps, whatever the session's spreads make it.

        The reading is compared once more with only the session's mean taken off: how much the
        electrodes of a finger vary, and with one another, hardly differs from day to day.
        """
        return session.odd or self._seen.is_far(
            self._electrodes.centre + (counts.astype(np.float64) - session.counts_mean)
        )

    def _repair(
        self,
        counts: NDArray[np.uint16],
        values: NDArray[np.float64],
        broken: NDArray[np.bool_],
    ) -> tuple[NDArray[np.generic], NDArray[np.float64]]:
        """Counts, and their values with the training's sensors, with the broken ones repaired."""
        if not broken.any():
            return counts, values
        values = self._electrodes.repaired(values, broken)
        return np.where(broken, self._from_training(values), counts), values

    def _compare(self, counts: NDArray[np.uint16]) -> bool:
        """Take in how the counts have changed; True if a whole finger reads exactly as before."""
        steps = np.abs(counts.astype(np.int32) - self._previous)
        same = steps == 0
        self._previous = counts
        self._unchanged = np.where(same, self._unchanged + 1, 0)
        moves = np.partition(steps, STILL - 1, axis=1)[:, STILL - 1 : STILL]
        jumped = (steps > JUMP_COUNTS) & (moves <= STILL_COUNTS)
        self._jumps = JUMPS_FADE * self._jumps + jumped
        return bool(same.all(axis=1).any())

    def _to_training(self, counts: NDArray[np.generic]) -> NDArray[np.float64]:
        """What the counts would have been with the training's sensors."""
        values = counts.astype(np.float64)
        if self._session is None:
            return values
        scale = self._electrodes.spread / self._session.counts_spread
        mapped: NDArray[np.float64] = (
            self._electrodes.centre + (values - self._session.counts_mean) * scale
        )
        return mapped

    def _from_training(self, values: NDArray[np.float64]) -> NDArray[np.float64]:
        if self._session is None:
            return np.clip(values, 0.0, COUNT_MAX)
        scale = self._session.counts_spread / self._electrodes.spread
        counts: NDArray[np.float64] = (
            self._session.counts_mean + (values - self._electrodes.centre) * scale
        )
        return np.clip(counts, 0.0, COUNT_MAX)


def _too_many(broken: NDArray[np.bool_]) -> bool:
    per_finger = np.count_nonzero(broken, axis=1)
    return bool(per_finger.sum() > BROKEN_MAX or per_finger.max() > BROKEN_FINGER_MAX)


def _is_flat(counts: NDArray[np.uint16], broken: NDArray[np.bool_]) -> bool:
    """Whether the sound electrodes of a finger read about the same."""
    values, sound = counts.astype(np.float64), ~broken
    number = sound.sum(axis=1)
    mean = (values * sound).sum(axis=1) / number
    squares = ((values - mean[:, np.newaxis]) ** 2 * sound).sum(axis=1) / number
    return bool((squares < FLAT_SPREAD_COUNTS**2).any())


def _fault_reasons(bits: int) -> tuple[Reason, ...]:
    if not bits:
        return ()
    known = tuple(reason for fault, reason in REASON_OF_FAULT.items() if bits & fault)
    return known or (Reason.NOT_A_COUNT,)  # a flag that nobody explained is still a flag
