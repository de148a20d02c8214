"""Tactile images and grasps of a hand, from its messages so far."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Collection, Iterable, Sequence

import numpy as np

from graspd.biotac import ELECTRODES, Finger, electrode_name
from graspd.daemon.judge.reasons import FingerState
from graspd.daemon.publish.messages import OutcomeMessage, Status, Tactile, Verdict
from graspd.daemon.watch.figures import lift
from graspd.daemon.watch.snapshot import FingerImage, FingerMotion, JudgedGrasp
from graspd.models.levels import PIXELS, RestCounts, fall_of, levels_of

OLD_NS = 1_000_000_000
"""Largest age of a reading whose image and joint angles are shown, ns."""
GRASPS_MAX = 8

Key = tuple[str, int]
"""`boot_id` and number of a grasp."""


class Fingers:
    """Learns the resting counts from readings, and draws the newest reading."""

    def __init__(self) -> None:
        self._tactile: Tactile | None = None
        self._tactile_ns = 0
        self._rest: defaultdict[str, RestCounts] = defaultdict(RestCounts)

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
                self._rest[finger].learn(finger, counts, sound)
        return True

    def forget(self, fingers: Iterable[str]) -> None:
        """Forget the resting counts of these fingers, whose sensors may be others now."""
        for finger in fingers:
            self._rest.pop(finger, None)

    def images(self, verdict: Verdict, status: Status | None, now_ns: int) -> list[FingerImage]:
        """Return the image of each finger in the newest reading; none if it is too old."""
        broken = set() if status is None else status.health.keys()
        tactile = self._recent(now_ns)
        if tactile is None:
            return []
        indices = range(len(tactile.fingers))
        return [self._image(tactile, index, verdict, broken) for index in indices]

    def _image(
        self, tactile: Tactile, index: int, verdict: Verdict, broken: Collection[str]
    ) -> FingerImage:
        name = tactile.fingers[index]
        counts = np.array(tactile.counts[index], dtype=np.float64)
        electrodes = [electrode_name(name, place) for place in range(ELECTRODES)]
        repaired = [electrode in verdict.repaired for electrode in electrodes]
        faulty = np.array(tactile.faults[index]) != 0
        sound = ~(faulty | repaired | [electrode in broken for electrode in electrodes])
        rest = self._rest[name].of(name)
        fall = fall_of(counts, sound, rest)
        return FingerImage(
            name=name,
            from_rest=rest is not None,
            levels=levels_of(fall, from_rest=rest is not None).tolist(),
            deepest=round(float(fall.max())),
            marked=sorted(PIXELS[electrode] for electrode in np.flatnonzero(~sound)),
            broken=_broken(np.flatnonzero(~sound).tolist(), repaired),
            motion=_motion(verdict, name),
            state=_state(verdict, name),
        )

    def joints(self, now_ns: int) -> dict[str, float]:
        """Return the angles of the newest reading, rad; none if it is too old."""
        tactile = self._recent(now_ns)
        return {} if tactile is None else tactile.joints

    def _recent(self, now_ns: int) -> Tactile | None:
        return self._tactile if now_ns - self._tactile_ns <= OLD_NS else None


def _broken(places: Sequence[int], repaired: Sequence[bool]) -> str:
    """Return electrodes, counted from 0, as text that counts from 1: "7 repaired; 8, 9 broken"."""
    kinds: dict[str, list[str]] = {"repaired": [], "broken": []}
    for place in places:
        kinds["repaired" if repaired[place] else "broken"].append(str(place + 1))
    return "; ".join(f"{', '.join(found)} {kind}" for kind, found in kinds.items() if found)


def _state(verdict: Verdict, finger: Finger) -> FingerState | None:
    return None if verdict.fingers is None else verdict.fingers.get(finger)


def _motion(verdict: Verdict, finger: Finger) -> FingerMotion | None:
    """Return the motion of a finger; None if it is free, or the daemon has no gate."""
    if verdict.motion is None or _state(verdict, finger) is FingerState.FREE:
        return None
    limit = (verdict.motion_limits or {}).get(finger, 0.0)
    return FingerMotion(now=verdict.motion.get(finger) if limit > 0.0 else None, limit=limit)


class GraspLog:
    """The latest `GRASPS_MAX` judged grasps of a hand, each with its last judgement."""

    def __init__(self) -> None:
        self._judged: dict[Key, tuple[Verdict, int]] = {}
        """Last judgement of each grasp, and its time of arrival, ns; the newest last."""
        self._ended: dict[Key, str] = {}

    def take(self, verdict: Verdict, now_ns: int) -> None:
        """Take in a verdict of `now_ns`, monotonic, if it judges a grasp or repeats a judgement."""
        key = verdict.boot_id, verdict.grasp
        confirms = verdict.valid and key in self._judged
        if confirms or (verdict.judged and (verdict.valid or verdict.gate is not None)):
            self._judged.pop(key, None)
            self._judged[key] = verdict, now_ns
        if len(self._judged) > GRASPS_MAX:
            oldest = next(iter(self._judged))
            del self._judged[oldest]
            self._ended.pop(oldest, None)

    def end(self, told: OutcomeMessage) -> None:
        """Take in the outcome of a lift; ignore it if the grasp is not in the log."""
        key = told.grasp_boot_id or told.boot_id, told.grasp
        if key in self._judged:
            self._ended[key] = told.outcome

    def last(self, now_ns: int, held: Key | None) -> list[JudgedGrasp]:
        """Return the latest judged grasps, at most `GRASPS_MAX`, the newest first.

        `now_ns`: monotonic time from which their ages count. `held`: the grasp that the hand holds
        now; None: none.
        """
        return [
            JudgedGrasp(
                verdict=verdict.verdict.value,
                p_slip=verdict.p_slip,
                boot_id=verdict.boot_id,
                grasp=verdict.grasp,
                ago_s=(now_ns - judged_ns) / 1e9,
                lift=lift(verdict, self._ended.get(key)),
                supervised=verdict.supervised,
                held=key == held,
            )
            for key, (verdict, judged_ns) in reversed(self._judged.items())
        ]
