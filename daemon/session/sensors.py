"""Detect exchanged sensors by their serial numbers or their resting counts."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from statistics import median  # numpy's loads modules for 40 ms at first
from typing import TYPE_CHECKING, Final

import numpy as np
from numpy.typing import NDArray

from graspd.biotac import ELECTRODES
from graspd.daemon.judge.pipeline import Pipeline
from graspd.daemon.publish.companion import Companion
from graspd.drivers.base import Driver, Reading

if TYPE_CHECKING:
    from graspd.daemon.session.file import KeptSession
    from graspd.models.session_statistics import SessionState

Rest = NDArray[np.float64]
"""Resting counts, shape (fingers, 24), which differ between sensors; 0: not known."""

UNTOLD: Final = (
    "%d fingers rest in another pattern than before: treated as other sensors, not calibrated; "
    "open the hand"
)
MOVED_COUNTS: Final = 50.0
"""Smallest change of a finger's pattern, counts, that means another sensor, not drift.

The change is the median over the electrodes, after subtracting the change that all share. With
rest read from the upper tail of the published grasps' counts it is 4 to 23 between the halves of
a day, 80 to 154 for the first finger between two days, and 26 to 122 between the sensors of one
hand. An untouched sensor changes by 1 in ten seconds.
"""
FIT_GRASPS: Final = 10
"""Fewest grasps by which unknown sensors are compared with a seeded session."""
FIT_SPREADS: Final = 1.0
"""Largest distance of the grasps' mean from that of a seeded session that fits, in its standard
deviations.

The distance is the root mean square over the electrodes of a finger, of the finger that is farthest
off. For ten grasps of a published day it is 0.2 to 0.8 (1 to 99 %) to that day's session, and
at least 1.6 to another day's.
"""
KNOWN_MIN: Final = 12
"""Fewest electrodes of a finger, known in both rests, by which the rests are compared."""
FOLLOWED_COUNTS: Final = 5.0
"""Change of a resting count above which the rest is saved; each save writes to the disk."""
LOOK_EVERY: Final = 5
"""Number of readings between two checks of the rest; a grasp takes longer to settle."""

log = logging.getLogger("graspd")


class SensorWatch(Companion):
    """Make the judge forget exchanged sensors before it judges the new ones."""

    def __init__(self, pipeline: Pipeline, tactile: Driver) -> None:
        self._tactile = tactile
        self._sensors_exchanged = pipeline.sensors_exchanged
        self._read_rest = pipeline.read_rest
        self._serials: dict[str, str] = {}
        """Last known serial numbers, by finger."""
        self._rest: Rest | None = None
        """Resting counts of the present sensors when last saved; None: not known yet."""
        self._is_first_tare = True
        """True after a start, an outage or an exchange, until the next tare."""
        self._readings = 0
        self._looked_at = b""
        """Bytes of the last compared resting counts, which change at most four times a second."""

    def on_reading(self, reading: Reading) -> None:
        serials = self._tactile.serials
        if serials != self._serials:
            changed = exchanged(self._serials, serials)
            if changed:
                log.warning(
                    "new sensor on %s: the hand must be seen open first", ", ".join(changed)
                )
                self._begin(self._with_serials(serials))
            self._serials.update(serials)
        self._readings += 1
        if self._read_rest is None or self._readings % LOOK_EVERY:
            return
        rest = self._read_rest()
        if rest.tobytes() != self._looked_at:
            self._looked_at = rest.tobytes()
            self._look_at(rest)

    def _look_at(self, rest: Rest) -> None:
        """Compare resting counts with the saved ones; begin another session if sensors changed."""
        tared = [bool(finger.any()) for finger in rest]
        if not any(tared):
            self._is_first_tare = True
        if not all(tared):
            return
        before, moved = self._rest, list[int]()
        if before is not None and has_drifted(before, rest):
            moved = moved_fingers(before, rest)
        former = self._with_rest(rest, is_known=before is not None and not moved)
        # A later tare of a single finger may come from one that touches.
        if former is not None or (moved and self._is_first_tare):
            if former is None:
                log.warning(UNTOLD, len(moved))
            self._begin(former, tared=former is not None)
            self._rest = rest
        elif before is None or (not moved and has_drifted(before, rest)):
            self._rest = rest
        self._is_first_tare = False

    def _with_serials(self, _serials: Mapping[str, str]) -> KeptSession | None:
        """Return the kept session of the sensors with these serial numbers; None: not known."""
        return None

    def _with_rest(self, _rest: Rest, *, is_known: bool) -> KeptSession | None:
        """Return the kept session of sensors with these resting counts; None: not known.
        `is_known`: True if these are the sensors of the running session."""
        return None

    def _begin(self, _former: KeptSession | None, *, tared: bool = False) -> None:
        """Have the judge forget the former sensors. `SessionKeeper` continues the session `_former`
        or begins an empty one (None). `tared`: the present tare was made with the new sensors."""
        self._sensors_exchanged()
        self._rest = None


def exchanged(before: Mapping[str, str], now: Mapping[str, str]) -> list[str]:
    """Return the fingers whose serial number was known before and has changed."""
    return [finger for finger in now if before.get(finger, now[finger]) != now[finger]]


def numbers(serials: Mapping[str, str]) -> dict[str, str]:
    """Return the real serial numbers, by finger; others only name the sender of a link."""
    return {finger: serial for finger, serial in serials.items() if "://" not in serial}


def moved_fingers(before: Rest, now: Rest) -> list[int]:
    """Return the rows of fingers whose resting pattern changed more than drift explains. Fingers
    with fewer than `KNOWN_MIN` electrodes known in both are left out."""
    moved = []
    for finger, (old, new) in enumerate(zip(before, now, strict=True)):
        both_known = (old > 0.0) & (new > 0.0)
        if np.count_nonzero(both_known) < KNOWN_MIN:
            continue
        step = new[both_known] - old[both_known]
        if median(np.abs(step - median(step))) > MOVED_COUNTS:
            moved.append(finger)
    return moved


def fits(seeded: SessionState, seen: SessionState, fingers: int) -> bool:
    """Return True if the grasps of a young session look like those of a seeded one.

    `fingers`: their number.
    """
    if len(seeded.mean) != len(seen.mean) or not seeded.weight:
        return False
    spread = np.sqrt(np.array(seeded.squares) / seeded.weight)
    away = (np.array(seen.mean) - seeded.mean) / np.maximum(spread, 1.0)
    counts = away[-fingers * ELECTRODES :].reshape(fingers, ELECTRODES)
    return bool((np.mean(counts**2, axis=1) <= FIT_SPREADS**2).all())


def has_drifted(before: Rest, now: Rest) -> bool:
    """Return True if an electrode has drifted enough that the rest is saved."""
    return bool((np.abs(now - before) > FOLLOWED_COUNTS).any())
