"""The grasps of a hand: verdicts, ends of lifts, and counts."""

from __future__ import annotations

from collections import Counter

from graspd.daemon.judge.reasons import Decision, GateState
from graspd.daemon.publish.messages import OutcomeMessage, Verdict
from graspd.daemon.watch.figures import lift
from graspd.daemon.watch.snapshot import JudgedGrasp

GRASPS_MAX = 8
OPEN = {GateState.IDLE, GateState.RELEASED}
"""States of the gate without a grasp."""

Key = tuple[str, int]
"""`boot_id` and number of a grasp."""


class GraspLog:
    """Counts the grasps of a hand by their last verdict, and lists the latest `GRASPS_MAX`."""

    def __init__(self) -> None:
        self._judged: dict[Key, tuple[Verdict, int]] = {}
        """Last verdict of each grasp and when it came, ns; the newest last."""
        self._ended: dict[Key, str] = {}
        self._past: Counter[Decision] = Counter()
        self._current: Key | None = None
        """The grasp that is counted next, until another begins."""
        self._decision: Decision | None = None
        """Last verdict of the current grasp."""
        self._is_held = False

    def take(self, verdict: Verdict, now_ns: int) -> None:
        """Take in a verdict that arrived at `now_ns`, monotonic."""
        key = verdict.boot_id, verdict.grasp
        self._is_held = verdict.gate not in OPEN
        if self._is_held and verdict.grasp > 0 and key != self._current:
            self._past = self._counted(over=True)
            self._current, self._decision = key, None
        confirms = verdict.valid and key in self._judged
        if confirms or (verdict.judged and (verdict.valid or verdict.gate is not None)):
            if key == self._current:
                self._decision = verdict.verdict
            self._keep(key, verdict, now_ns)

    def _keep(self, key: Key, verdict: Verdict, now_ns: int) -> None:
        self._judged.pop(key, None)
        self._judged[key] = verdict, now_ns
        if len(self._judged) > GRASPS_MAX:
            oldest = next(iter(self._judged))
            del self._judged[oldest]
            self._ended.pop(oldest, None)

    def end(self, told: OutcomeMessage) -> None:
        """Take in the outcome of a lift; one of a grasp that is not listed is ignored."""
        key = told.grasp_boot_id or told.boot_id, told.grasp
        if key in self._judged:
            self._ended[key] = told.outcome

    def counts(self) -> dict[str, int]:
        """Count the grasps by their last verdict; one without a verdict is `unknown`."""
        counted = self._counted(over=not self._is_held)
        return {decision.value: counted[decision] for decision in Decision}

    def _counted(self, *, over: bool) -> Counter[Decision]:
        if self._current is None or (self._decision is None and not over):
            return self._past
        return self._past + Counter([self._decision or Decision.UNKNOWN])

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
                ended=self._ended.get(key),
                lift=lift(verdict, self._ended.get(key)),
                supervised=verdict.supervised,
                held=key == held,
            )
            for key, (verdict, judged_ns) in reversed(self._judged.items())
        ]
