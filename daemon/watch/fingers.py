"""The tactile image and the motion of each finger."""

from __future__ import annotations

from collections.abc import Collection

import msgspec
import numpy as np

from graspd.daemon.judge.reasons import FingerState
from graspd.daemon.publish.messages import Tactile, Verdict
from graspd.models.contract import Finger
from graspd.models.layout import ELECTRODES
from graspd.models.levels import PIXELS, RestCounts, fall_of, levels_of

OLD_NS = 1_000_000_000
"""Largest age of a reading whose image is shown, ns."""


class FingerMotion(msgspec.Struct, frozen=True, kw_only=True):
    """Motion of a finger, in units of its own noise."""

    now: float | None
    """Motion now; None: not known."""
    limit: float
    """Largest motion that counts as still."""


class FingerImage(msgspec.Struct, frozen=True, kw_only=True):
    """Picture of one finger."""

    name: str
    touches: bool | None
    """True if it touches; None: not known."""
    from_rest: bool
    """True if levels are relative to the resting counts, False: to the finger's median."""
    levels: list[int]
    """Level of each pixel, 12 rows of 11; see `levels_of`."""
    deepest: int
    """Largest fall of an electrode, counts."""
    marked: list[int]
    """Pixels of electrodes that are faulty or repaired."""
    motion: FingerMotion | None
    """Motion; None: the daemon has no gate."""
    state: FingerState | None = None
    """State; None: not known."""


class Fingers:
    """Learns the resting counts from readings, and draws the newest reading."""

    def __init__(self) -> None:
        self._tactile: Tactile | None = None
        self._tactile_ns = 0
        self._rest = RestCounts()

    def take(self, tactile: Tactile, now_ns: int, resting: Collection[str]) -> bool:
        """Take in a reading; return False, and ignore it, if its shapes are wrong.

        `resting`: fingers that rest in it, to learn from.
        """
        lengths = {len(tactile.fingers), len(tactile.counts), len(tactile.faults)}
        rows = [*tactile.counts, *tactile.faults]
        if len(lengths) != 1 or any(len(row) != ELECTRODES for row in rows):
            return False
        self._tactile, self._tactile_ns = tactile, now_ns
        for index, finger in enumerate(tactile.fingers):
            if finger in resting:
                counts = np.array(tactile.counts[index])
                sound = np.array(tactile.faults[index]) == 0
                self._rest.learn(finger, counts, sound)
        return True

    def images(self, verdict: Verdict, now_ns: int) -> list[FingerImage]:
        """Return the image of each finger in the newest reading; none if it is too old."""
        tactile = self._tactile
        if tactile is None or now_ns - self._tactile_ns > OLD_NS:
            return []
        return [self._image(tactile, index, verdict) for index in range(len(tactile.fingers))]

    def _image(self, tactile: Tactile, index: int, verdict: Verdict) -> FingerImage:
        name = tactile.fingers[index]
        counts = np.array(tactile.counts[index], dtype=np.float64)
        sound = np.array(tactile.faults[index]) == 0
        electrodes = range(1, ELECTRODES + 1)
        repaired = [f"{name}_{number}" in verdict.repaired for number in electrodes]
        rest = self._rest.of(name)
        fall = fall_of(counts, sound, rest)
        return FingerImage(
            name=name,
            touches=None if verdict.contact is None else name in verdict.contact,
            from_rest=rest is not None,
            levels=levels_of(fall, from_rest=rest is not None).tolist(),
            deepest=round(float(fall.max())),
            marked=sorted(PIXELS[electrode] for electrode in np.flatnonzero(~sound | repaired)),
            motion=_motion(verdict, name),
            state=(verdict.fingers or {}).get(name),
        )

    @property
    def joints(self) -> dict[str, float]:
        return {} if self._tactile is None else self._tactile.joints


def _motion(verdict: Verdict, finger: Finger) -> FingerMotion | None:
    if verdict.motion is None:
        return None
    limit = (verdict.motion_limits or {}).get(finger, 0.0)
    return FingerMotion(now=verdict.motion.get(finger) if limit > 0.0 else None, limit=limit)
