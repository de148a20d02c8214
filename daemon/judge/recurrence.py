"""Whether a finger's sweep was read before: who repeats old ones gives them new numbers."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from drivers.base import ELECTRODES

SWEEPS = 128
"""Different sweeps of each finger that are remembered: rings of so many are seen at once. Of any
two real sweeps of a finger at most 14 electrodes of 24 were equal, in 1.4 million pairs."""
READ_MIN = 12
"""Electrodes that must have been read in both sweeps: by chance one in 14 is equal."""
NO_COUNT = 0x8000
"""In place of a count: far from every one of 12 bits, upwards and, modulo 2**16, downwards."""
SWEEP_BYTES = ELECTRODES * 2


@dataclass(slots=True, eq=False)
class PastSweeps:
    """The last sweeps of each finger of a hand, as many as are remembered."""

    past: list[dict[bytes, None]]
    """Different ones, 24 counts of 16 bits each, oldest first; `NO_COUNT` where none was read."""
    lacking: list[int]
    """How many sweeps of the finger are to come until such a one is forgotten."""

    def __post_init__(self) -> None:
        """Raise `ValueError` for what cannot have been read."""
        if len(self.past) != len(self.lacking) or max(map(len, self.past), default=0) > SWEEPS:
            raise ValueError(f"at most {SWEEPS} sweeps of each finger are remembered")
        if any(set(map(len, past)) - {SWEEP_BYTES} for past in self.past):
            raise ValueError(f"a sweep has {ELECTRODES} counts")

    @classmethod
    def none(cls, fingers: int) -> PastSweeps:
        """Of a hand that has sent nothing yet."""
        return cls([{} for _ in range(fingers)], [0] * fingers)

    def recurs(self, counts: NDArray[np.uint16], sound: NDArray[np.bool_] | None = None) -> bool:
        """Take in a sweep, shape (fingers, 24); whether some finger sent the same before.

        `sound` tells which of the counts were read; None: all. What was not read may be anything.
        """
        if sound is not None or any(self.lacking):
            return self._recurs_in_part(counts, sound)
        sweeps, found = counts.tobytes(), False
        for finger, past in enumerate(self.past):
            found |= _known(past, sweeps[finger * SWEEP_BYTES : (finger + 1) * SWEEP_BYTES])
        return found

    def _recurs_in_part(self, counts: NDArray[np.uint16], sound: NDArray[np.bool_] | None) -> bool:
        """The same where some counts, of this sweep or of one before, were not read."""
        found = False
        for finger, past in enumerate(self.past):
            read = np.full(ELECTRODES, True) if sound is None else sound[finger]
            number = np.count_nonzero(read)
            left = max(self.lacking[finger] - 1, 0)
            self.lacking[finger] = SWEEPS if number < ELECTRODES else left
            if number < READ_MIN:
                continue
            now = np.where(read, counts[finger], np.uint16(NO_COUNT))
            if self.lacking[finger]:
                found |= _equals_one(np.frombuffer(b"".join(past), np.uint16), now)
            found |= _known(past, now.tobytes())
        return found


def _known(past: dict[bytes, None], sweep: bytes) -> bool:
    """Whether the sweep is one of these, the latest of which it is from now on."""
    known = sweep in past
    if known:
        del past[sweep]
    elif len(past) >= SWEEPS:
        del past[next(iter(past))]
    past[sweep] = None
    return known


def _equals_one(past: NDArray[np.uint16], now: NDArray[np.uint16]) -> bool:
    """Whether the sweep equals some other in all electrodes that were read in both."""
    others = past.reshape(-1, ELECTRODES)
    equal = (others == now) | (others == NO_COUNT) | (now == NO_COUNT)
    alike = others[equal.all(axis=1)]
    return any(np.count_nonzero((one != NO_COUNT) & (now != NO_COUNT)) >= READ_MIN for one in alike)
