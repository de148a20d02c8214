"""Summary of a run: counts of verdicts, scores against recorded outcomes, latencies."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator
from typing import Any

from daemon.judge.pipeline import Judgement
from daemon.judge.reasons import Decision, Reason
from daemon.publish.latency import LatencyHistogram
from daemon.publish.messages import Verdict


class Tally:
    """Counts verdicts and their reasons, and compares them with how the lifts ended."""

    def __init__(self) -> None:
        self.decisions: Counter[Decision] = Counter()
        self.reasons: Counter[Reason] = Counter()
        self.confusion: Counter[tuple[bool, bool]] = Counter()
        """(recorded slip, judged slip) of the judged grasps whose outcome was recorded."""
        self.labelled = 0

    def add(self, decision: Decision, reasons: Iterable[Reason], slipped: bool | None) -> None:
        """Count one verdict; `slipped` is how the lift ended, None where it was not recorded."""
        self.decisions[decision] += 1
        self.reasons.update(reasons)
        if slipped is not None:
            self.labelled += 1
            if decision is not Decision.UNKNOWN:
                self.confusion[slipped, decision is Decision.SLIP] += 1

    def scores(self) -> dict[str, float] | None:
        """Accuracy, precision, recall and F1 over judged, labelled grasps; None if there are none.

        Slip is the positive class, as in the paper. A score whose denominator is zero is left out.
        """
        hit, miss = self.confusion[True, True], self.confusion[True, False]
        false_alarm, rest = self.confusion[False, True], self.confusion[False, False]
        total = hit + miss + false_alarm + rest
        if not total:
            return None
        fractions = {
            "accuracy": (hit + rest, total),
            "precision": (hit, hit + false_alarm),
            "recall": (hit, hit + miss),
            "f1": (2 * hit, 2 * hit + false_alarm + miss),
        }
        return {name: part / whole for name, (part, whole) in fractions.items() if whole}

    def as_dict(self) -> dict[str, Any]:
        """Everything as JSON-ready values."""
        return {
            "verdicts": {decision.value: self.decisions[decision] for decision in Decision},
            "reasons": {reason.value: number for reason, number in self.reasons.items()},
            "labelled": self.labelled,
            "judged_and_labelled": self.confusion.total(),
            "scores": self.scores(),
        }

    def counts(self) -> str:
        """How often each decision came, for people."""
        return ", ".join(f"{self.decisions[decision]} {decision}" for decision in Decision)

    def lines(self) -> Iterator[str]:
        """Reasons and scores, for people."""
        if self.reasons:
            given = ", ".join(f"{number} {reason}" for reason, number in self.reasons.most_common())
            yield f"unknown because: {given}"
        scores = self.scores()
        if scores is not None:
            yield (
                f"against {self.confusion.total()} recorded outcomes (slip positive): "
                + ", ".join(f"{name} {100 * value:.1f} %" for name, value in scores.items())
            )


class Summary:
    """Collects verdicts in constant memory.

    Behind a gate a grasp counts once, by its first judgement; else each reading does.
    """

    def __init__(self) -> None:
        self.tally = Tally()
        self.without_session = Tally()
        """The same readings without session calibration; empty where that was not tried."""
        self.repaired = 0
        """Verdicts made with at least one repaired electrode."""
        self.latency = LatencyHistogram()
        self.readings = 0
        """Verdicts behind a gate; 0 where each reading is a grasp."""
        self.grasps = 0
        """Grasps that began, of these."""
        self.again = 0
        """Judgements of grasps that had changed since they were judged."""
        self._judged_grasp: int | None = None
        self._compared_grasp: int | None = None

    def add(self, verdict: Verdict, slipped: bool | None) -> None:
        """Count one verdict; `slipped` is how the lift ended, None where it was not recorded."""
        self.latency.add(verdict.latency_us)
        if verdict.gate is not None:
            self.readings += 1
            self.grasps = max(self.grasps, verdict.grasp)
            if not verdict.judged:
                return
            if verdict.grasp == self._judged_grasp:
                self.again += 1
                return
            self._judged_grasp = verdict.grasp
        self.tally.add(verdict.verdict, verdict.reasons, slipped)
        self.repaired += verdict.valid and bool(verdict.repaired)

    def compare(self, judgement: Judgement, slipped: bool | None, grasp: int) -> None:
        """Count what would have been judged of a grasp without session calibration, once."""
        if grasp != self._compared_grasp:
            self._compared_grasp = grasp
            self.without_session.add(judgement.decision, judgement.reasons, slipped)

    def as_dict(self, wall_s: float) -> dict[str, Any]:
        """Everything as JSON-ready values; `wall_s` is how long the replay took, s."""
        compared = bool(self.without_session.decisions)
        return {
            **self.tally.as_dict(),
            "gated": self._gated(),
            "repaired": self.repaired,
            "without_session": self.without_session.as_dict() if compared else None,
            "latency_us": {
                "p50": self.latency.quantile_us(0.5),
                "p99": self.latency.quantile_us(0.99),
                "max": self.latency.max_us,
            },
            "wall_s": wall_s,
        }

    def _gated(self) -> dict[str, int] | None:
        if not self.readings:
            return None
        return {"readings": self.readings, "grasps": self.grasps, "judged_again": self.again}

    def lines(self, wall_s: float) -> list[str]:
        """The same for people."""
        total = self.tally.decisions.total()
        if self.readings:
            lines = [
                f"{self.readings} readings in {wall_s:.2f} s: {self.grasps} grasps, "
                f"{total} judged, {self.again} again after a change",
                f"first judgements: {self.tally.counts()}",
            ]
        else:
            lines = [f"{total} verdicts in {wall_s:.2f} s: {self.tally.counts()}"]
        lines += self.tally.lines()
        if self.repaired:
            lines.append(f"{self.repaired} of them with repaired electrodes")
        if self.without_session.decisions:
            lines.append(f"without session calibration: {self.without_session.counts()}")
            lines += [f"  {line}" for line in self.without_session.lines()]
        lines.append(
            f"reading to verdict: p50 {self.latency.quantile_us(0.5):.0f} us, "
            f"p99 {self.latency.quantile_us(0.99):.0f} us, max {self.latency.max_us:.0f} us"
        )
        return lines
