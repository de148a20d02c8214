"""Whether a reading may be judged at all, and if not, why."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from daemon.judge.verdict import Reason
from drivers.base import COUNT_MAX, ELECTRODES, ElectrodeFault, TactileReading
from models.contract import SeenCounts
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

UNCHANGED_MAX = 16
"""Readings in a row in which a live electrode may keep its count. Its noise is 3 to 4 counts
(standard deviation), so it keeps it about once in ten readings, 16 times in a row never; and all
24 of a finger do not even keep it once. Something along the way repeats old data."""
NO_COUNT = 0xFFFF


class Health:
    """Examines one reading after the other; remembers only what has not changed."""

    def __init__(self, fingers: int, seen: SeenCounts) -> None:
        """`seen` is what the model was trained on."""
        self._shape = (fingers, ELECTRODES)
        self._seen = SeenCheck(seen)
        self._previous = np.full(self._shape, NO_COUNT, dtype=np.uint16)
        self._unchanged = np.zeros(self._shape, dtype=np.int64)
        """Readings in a row in which each electrode has not changed."""

    def examine(self, reading: TactileReading) -> list[Reason]:
        """Reasons against judging this reading, none if it is sound."""
        counts = reading.counts
        if counts.shape != self._shape:
            return [Reason.MODEL_MISMATCH]
        frozen = self._is_frozen(counts)
        if reading.faults.any():  # flagged counts mean nothing: no further findings on them
            return _fault_reasons(int(np.bitwise_or.reduce(reading.faults, axis=None)))
        reasons = [Reason.FROZEN] if frozen else []
        if counts.min() == 0 or counts.max() >= COUNT_MAX:
            reasons.append(Reason.SATURATED)
        elif self._seen.never_seen(counts[np.newaxis]).any():
            reasons.append(Reason.NEVER_SEEN)
        return reasons

    def _is_frozen(self, counts: NDArray[np.uint16]) -> bool:
        """Whether a whole finger reads exactly as before, or an electrode has for too long."""
        same = counts == self._previous
        self._previous = counts
        self._unchanged = np.where(same, self._unchanged + 1, 0)
        return bool(same.all(axis=1).any() or self._unchanged.max() >= UNCHANGED_MAX)


def _fault_reasons(bits: int) -> list[Reason]:
    known = [reason for fault, reason in REASON_OF_FAULT.items() if bits & fault]
    return known or [Reason.NOT_A_COUNT]  # a flag that nobody explained is still a flag
