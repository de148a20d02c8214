"""Whether a reading may be judged at all, and if not, why."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from daemon.judge.verdict import Reason
from drivers.base import COUNT_MAX, ElectrodeFault, TactileReading
from models.contract import SeenCounts

REASON_OF_FAULT: dict[ElectrodeFault, Reason] = {
    ElectrodeFault.MISSING: Reason.SENSOR_MISSING,
    ElectrodeFault.NOT_A_COUNT: Reason.NOT_A_COUNT,
    ElectrodeFault.PARITY: Reason.PARITY,
    ElectrodeFault.ERROR_WORD: Reason.ERROR_WORD,
    ElectrodeFault.HELD: Reason.HELD,
    ElectrodeFault.CUT_OFF: Reason.CUT_OFF,
}
"""What the judge says of each fault that a driver can flag."""


class Health:
    """Examines one reading after the other; remembers only the last one."""

    def __init__(self, fingers: int, seen: SeenCounts) -> None:
        """`seen` bounds what the model was trained on, shape (fingers, 24)."""
        self._shape = (fingers, 24)
        self._low = np.array(seen.low, dtype=np.int32) - seen.margin
        self._high = np.array(seen.high, dtype=np.int32) + seen.margin
        self._previous: NDArray[np.uint16] | None = None

    def examine(self, reading: TactileReading) -> list[Reason]:
        """Reasons against judging this reading, none if it is sound."""
        counts = reading.counts
        if counts.shape != self._shape:
            self._previous = None
            return [Reason.MODEL_MISMATCH]
        repeats = self._repeats(counts)
        if reading.faults.any():  # flagged counts mean nothing: no further findings on them
            return _fault_reasons(int(np.bitwise_or.reduce(reading.faults, axis=None)))
        reasons = [Reason.FROZEN] if repeats else []
        if counts.min() == 0 or counts.max() >= COUNT_MAX:
            reasons.append(Reason.SATURATED)
        elif (counts < self._low).any() or (counts > self._high).any():
            reasons.append(Reason.NEVER_SEEN)
        return reasons

    def _repeats(self, counts: NDArray[np.uint16]) -> bool:
        """Whether a whole finger reads exactly as before.

        A live BioTac SP has 3 to 4 counts of noise on each electrode (standard deviation), so 24
        equal values in a row do not happen: something along the way repeats old data.
        """
        previous, self._previous = self._previous, counts
        return previous is not None and bool((previous == counts).all(axis=1).any())


def _fault_reasons(bits: int) -> list[Reason]:
    known = [reason for fault, reason in REASON_OF_FAULT.items() if bits & fault]
    return known or [Reason.NOT_A_COUNT]  # a flag that nobody explained is still a flag
