"""The grasps of a hand: what each was judged to be, how its lift ended, and how many there were."""

from __future__ import annotations

from collections import Counter

from daemon.judge.reasons import Decision, GateState
from daemon.publish.messages import OutcomeMessage, Verdict
from daemon.watch.evidence import lift
from daemon.watch.snapshot import Judged

GRASPS_MAX = 8
"""Grasps that are shown after they were judged."""
OPEN = {GateState.IDLE, GateState.RELEASED}
"""States of the gate in which no grasp is under way."""

Key = tuple[str, int]
"""`boot_id` and number of a grasp."""


class Grasps:
    """Takes verdicts and outcomes; a grasp is one number of the gate, however many its readings."""

    def __init__(self) -> None:
        """Without a grasp."""
        self._judged: dict[Key, tuple[Verdict, int]] = {}
        """What each was judged to be last, and when, ns; the newest last."""
        self._ended: dict[Key, str] = {}
        """How their lifts ended, of those that were told."""
        self._past: Counter[Decision] = Counter()
        self._now: Key | None = None
        """The grasp that is counted next; after it is let go too, until another begins."""
        self._said: Decision | None = None
        """What it was judged to be last; None: it was not judged yet."""
        self._is_held = False

    def take(self, verdict: Verdict, now_ns: int) -> None:
        """Take a verdict that arrived at `now_ns`."""
        key = verdict.boot_id, verdict.grasp
        self._is_held = verdict.gate not in OPEN
        if self._is_held and verdict.grasp > 0 and key != self._now:
            self._past = self._counted(over=True)
            self._now, self._said = key, None
        stands = verdict.valid and key in self._judged
        if stands or (verdict.judged and (verdict.valid or verdict.gate is not None)):
            if key == self._now:
                self._said = verdict.verdict
            self._keep(key, verdict, now_ns)

    def _keep(self, key: Key, verdict: Verdict, now_ns: int) -> None:
        self._judged.pop(key, None)
        self._judged[key] = verdict, now_ns
        if len(self._judged) > GRASPS_MAX:
            oldest = next(iter(self._judged))
            del self._judged[oldest]
            self._ended.pop(oldest, None)

    def end(self, told: OutcomeMessage) -> None:
        """Take how a lift ended; of a grasp that is not shown any more, nothing is kept."""
        key = told.grasp_boot_id or told.boot_id, told.grasp
        if key in self._judged:
            self._ended[key] = told.outcome

    def counts(self) -> dict[str, int]:
        """Number of grasps that were seen, by the verdict that each had last.

        One that was let go without having been judged counts as `unknown`; one that is held and not
        judged yet does not count yet.
        """
        counted = self._counted(over=not self._is_held)
        return {decision.value: counted[decision] for decision in Decision}

    def _counted(self, *, over: bool) -> Counter[Decision]:
        if self._now is None or (self._said is None and not over):
            return self._past
        return self._past + Counter([self._said or Decision.UNKNOWN])

    def last(self, now_ns: int, held: Key | None) -> list[Judged]:
        """The last that were judged, the newest first; `held` is in the hand."""
        return [
            Judged(
                verdict=verdict.verdict.value,
                p_slip=verdict.p_slip,
                grasp=verdict.grasp,
                ago_s=(now_ns - judged_ns) / 1e9,
                ended=self._ended.get(key),
                lift=lift(verdict, self._ended.get(key)),
                supervised=verdict.supervised,
                held=key == held,
            )
            for key, (verdict, judged_ns) in reversed(self._judged.items())
        ]
