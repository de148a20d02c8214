"""Print a run: each verdict, then counts, scores against recorded outcomes, latencies."""

from __future__ import annotations

import json
import sys
import time
from collections import Counter, deque
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, Final

from graspd.daemon.judge.reasons import Decision, GateState, Reason
from graspd.daemon.process.text import Colour, coloured, printable
from graspd.daemon.publish.companion import Companion, PublishedVerdict
from graspd.daemon.publish.messages import Verdict
from graspd.daemon.publish.outbox import LatencyHistogram
from graspd.daemon.trust.lift_book import GraspId, Report
from graspd.daemon.trust.trust import Trust
from graspd.drivers.base import Annotation

NAME_MAX = 80
"""Most printed characters of an object's name."""
COLOURS = {Decision.STABLE: Colour.GREEN, Decision.SLIP: Colour.RED}
WINDOW: Final = 50
"""Number of `stable` lifts in a row among which `Tally.worst` counts the slips."""
WAITING_MAX: Final = 1024
"""Most grasps that wait for their outcome; beyond it the oldest is dropped."""
WORTH: Final = {
    "coverage": "coverage",
    "slips_among_stable": "slips among stable",
    "worst_window": f"worst {WINDOW} in a row",
    "slips_called_stable": "slips called stable",
    "stable_called_slip": "stable called slip",
}
"""Printed names of the fractions in `Tally.worth`, in order."""


class Tally:
    """Count verdicts and reasons, and compare them with the outcomes of lifts."""

    def __init__(self) -> None:
        self.decisions: Counter[Decision] = Counter()
        self.reasons: Counter[Reason] = Counter()
        self.confusion: Counter[tuple[bool, bool]] = Counter()
        """Number of judged grasps by (recorded slip, judged slip)."""
        self.held = self.slipped = 0
        """Lifts with a known outcome that held, and that slipped."""
        self._latest: deque[bool] = deque(maxlen=WINDOW)
        """Outcomes of the latest `stable` lifts, True: slip."""
        self.worst: int | None = None
        """Most slips in `WINDOW` `stable` lifts in a row; None before `WINDOW` lifts."""

    @property
    def labelled(self) -> int:
        return self.held + self.slipped

    @property
    def stable(self) -> tuple[int, int]:
        """Number of `stable` lifts with a known outcome, and of the slips among them."""
        slips = self.confusion[True, False]
        return slips + self.confusion[False, False], slips

    def add(self, decision: Decision, reasons: Iterable[Reason], slipped: bool | None) -> None:
        """Count one verdict. `slipped`: its outcome; None: not known yet."""
        self.decisions[decision] += 1
        self.reasons.update(reasons)
        if slipped is not None:
            self.outcome(decision, slipped=slipped)

    def outcome(self, decision: Decision, *, slipped: bool) -> None:
        """Count the outcome of a lift after this decision."""
        self.slipped += slipped
        self.held += not slipped
        if decision is not Decision.UNKNOWN:
            self.confusion[slipped, decision is Decision.SLIP] += 1
        if decision is Decision.STABLE:
            self._latest.append(slipped)
            if len(self._latest) == WINDOW:
                self.worst = max(sum(self._latest), self.worst or 0)

    def scores(self) -> dict[str, float] | None:
        """Return accuracy, precision, recall, f1 of judged grasps with outcomes; slip is positive.

        None: no such grasp. A score that would divide by 0 is left out.
        """
        hit, miss = self.confusion[True, True], self.confusion[True, False]
        false_alarm, rest = self.confusion[False, True], self.confusion[False, False]
        total = hit + miss + false_alarm + rest
        if not total:
            return None
        return _fractions(
            {
                "accuracy": (hit + rest, total),
                "precision": (hit, hit + false_alarm),
                "recall": (hit, hit + miss),
                "f1": (2 * hit, 2 * hit + false_alarm + miss),
            }
        )

    def worth(self) -> dict[str, float] | None:
        """Return the fractions (0..1) named by the keys of `WORTH`; None: no outcome is known.

        Those of 0 lifts are left out.
        """
        if not self.labelled:
            return None
        (stable, slips), held = self.stable, self.confusion[False, False]
        return _fractions(
            {
                "coverage": (held, self.held),
                "slips_among_stable": (slips, stable),
                "worst_window": (self.worst or 0, 0 if self.worst is None else WINDOW),
                "slips_called_stable": (slips, self.slipped),
                "stable_called_slip": (self.confusion[False, True], self.held),
            }
        )

    def as_dict(self) -> dict[str, Any]:
        return {
            "verdicts": {decision.value: self.decisions[decision] for decision in Decision},
            "reasons": {reason.value: number for reason, number in self.reasons.items()},
            "labelled": self.labelled,
            "judged_and_labelled": self.confusion.total(),
            "scores": self.scores(),
            "stable": self.worth(),
        }

    def counts(self) -> str:
        return ", ".join(f"{self.decisions[decision]} {decision}" for decision in Decision)

    def lines(self) -> Iterator[str]:
        """Yield lines for people: reasons, scores, and the fractions of `worth`."""
        if self.reasons:
            given = ", ".join(f"{number} {reason}" for reason, number in self.reasons.most_common())
            yield f"unknown because: {given}"
        scores = self.scores()
        if scores is not None:
            yield (
                f"against {self.confusion.total()} recorded outcomes (slip positive): "
                + ", ".join(f"{name} {100 * value:.1f} %" for name, value in scores.items())
            )
        worth = self.worth()
        if worth is not None:
            yield ", ".join(f"{WORTH[name]} {100 * value:.1f} %" for name, value in worth.items())


def _fractions(parts: Mapping[str, tuple[int, int]]) -> dict[str, float]:
    """Return part / whole by name, from (part, whole); a whole of 0 is left out."""
    return {name: part / whole for name, (part, whole) in parts.items() if whole}


class RunSummary:
    """Collect verdicts in constant memory.

    With a gate each grasp counts once, by its first judgement, else each reading counts.
    """

    def __init__(self) -> None:
        self.tally = Tally()
        self.trained_on: Mapping[Path, str] = {}
        """Recordings that the model was trained on, each with a text for people."""
        self._waiting: dict[GraspId, Decision] = {}
        """Decisions on grasps whose outcome may still come, the oldest first."""
        self.repaired = 0
        """Number of counted verdicts, other than `unknown`, with a repaired electrode."""
        self.latency = LatencyHistogram()
        self.readings = 0
        """Number of verdicts in a run with a gate; 0 without one."""
        self.grasps = 0
        self.again = 0
        """Number of further judgements of the same grasp."""
        self._last = GraspId("", 0)
        self._judged_grasp: GraspId | None = None

    def add(self, verdict: Verdict, slipped: bool | None, grasp: GraspId | None = None) -> None:
        """Count one verdict. `slipped`: its recorded outcome; None: not recorded.

        `grasp`: id of its grasp, if that is from another start than the verdict, as in a replay.
        """
        grasp = grasp or GraspId(verdict.boot_id, verdict.grasp)
        self.latency.add(verdict.latency_us)
        if verdict.gate is not None:
            self.readings += 1
            same_start = grasp.boot_id == self._last.boot_id
            self.grasps += grasp.grasp - (self._last.grasp if same_start else 0)
            self._last = grasp
            if not verdict.judged:
                return
            if grasp == self._judged_grasp:
                self.again += 1
                return
            self._judged_grasp = grasp
        self.tally.add(verdict.verdict, verdict.reasons, slipped)
        if slipped is None:
            self._waiting.setdefault(grasp, verdict.verdict)
            if len(self._waiting) > WAITING_MAX:
                del self._waiting[next(iter(self._waiting))]
        self.repaired += verdict.valid and bool(verdict.repaired)

    def outcome(self, grasp: GraspId, *, slipped: bool) -> None:
        """Count an outcome of a grasp whose verdict is counted and has none; ignore others."""
        decision = self._waiting.pop(grasp, None)
        if decision is not None:
            self.tally.outcome(decision, slipped=slipped)

    def as_dict(self, wall_s: float, trust: Trust | None) -> dict[str, Any]:
        """Return counts, scores, risk and latencies for JSON. `wall_s`: duration of the run, s."""
        return {
            **self.tally.as_dict(),
            "gated": self._gated(),
            "repaired": self.repaired,
            "outcomes": 0 if trust is None else trust.learner.outcomes,
            "risk": None if trust is None else trust.report()._asdict(),
            "trained_on": [path.name for path in self.trained_on],
            "latency_us": self.latency.spread_us(),
            "wall_s": wall_s,
        }

    def _gated(self) -> dict[str, int] | None:
        if not self.readings:
            return None
        return {"readings": self.readings, "grasps": self.grasps, "judged_again": self.again}

    def lines(self, wall_s: float, trust: Trust | None) -> list[str]:
        total = self.tally.decisions.total()
        lines = []
        if self.trained_on:
            lines.append(trained_on_line("the model", self.trained_on.values()))
        if self.readings:
            lines += [
                f"{self.readings} readings in {wall_s:.2f} s: {self.grasps} grasps, "
                f"{total} judged, {self.again} again after a change",
                f"first judgements: {self.tally.counts()}",
            ]
        else:
            lines += [f"{total} verdicts in {wall_s:.2f} s: {self.tally.counts()}"]
        lines += self.tally.lines()
        if not self.tally.labelled:
            lines.append("no outcome of a lift is known, so there is no score")
        if self.repaired:
            lines.append(f"{self.repaired} judged with repaired electrodes")
        lines += _learned(trust)
        lines.append(
            f"reading to verdict: p50 {self.latency.quantile_us(0.5):.0f} us, "
            f"p99 {self.latency.quantile_us(0.99):.0f} us, max {self.latency.max_us:.0f} us"
        )
        return lines


def trained_on_line(which: str, known: Iterable[str]) -> str:
    """Return the warning that model `which` was trained on the grasps in the texts `known`."""
    return f"{which} was trained on {', '.join(known)}: it judges other grasps worse than these"


def _learned(trust: Trust | None) -> Iterator[str]:
    """Yield lines on what outcomes taught, and on the risk; none if no outcome was reported."""
    if trust is None or not trust.lifts.told:
        return
    yield f"learned from {trust.learner.outcomes} outcomes"
    report = trust.report()
    if report.target is not None and report.bound is not None:
        awaited = f"; {report.outstanding} outcomes awaited" if report.outstanding else ""
        yield (
            f"risk: {report.slips} of {report.lifts} lifts of `stable` slipped, "
            f"at most {int(report.bound)} can: {100 * report.target:g} % of them, "
            f"and {report.beyond_share:.2f} more{awaited}"
        )


class Printer(Companion):
    """Print verdicts when they come, and a summary at the end."""

    def __init__(self, *, as_json: bool) -> None:
        """`as_json`: True prints whole messages, and the summary on stderr."""
        self._as_json = as_json
        self.result = RunSummary()
        self._start_s = time.monotonic()
        self._gate: GateState | None = None

    def on_verdict(self, published: PublishedVerdict) -> None:
        """Count a verdict. Print its message if `as_json` is set; else, if it is news, a line with
        the recorded outcome."""
        verdict, reading = published.verdict, published.reading
        annotation = reading.annotation if reading else None
        self.result.add(verdict, annotation.slipped if annotation else None, published.grasp)
        if not self._as_json and not self._is_news(verdict):
            return
        line = published.payload.decode() if self._as_json else _line(verdict, annotation)
        sys.stdout.write(line + "\n")
        sys.stdout.flush()  # also into a pipe, because readings may come in real time

    def _is_news(self, verdict: Verdict) -> bool:
        """Return True for a new judgement, a change of the gate's state, and without a gate."""
        if verdict.gate is None or verdict.judged or verdict.gate is not self._gate:
            self._gate = verdict.gate
            return True
        return False

    def on_outcome(self, report: Report) -> None:
        self.result.outcome(report.grasp, slipped=report.outcome == "slip")

    def summary(self, trust: Trust | None) -> None:
        """Print the summary since the start. `trust`: what outcomes taught, if anything."""
        wall_s = time.monotonic() - self._start_s
        if self._as_json:
            sys.stdout.flush()
            sys.stderr.write(json.dumps(self.result.as_dict(wall_s, trust)) + "\n")
        else:
            sys.stdout.write("\n" + "\n".join(self.result.lines(wall_s, trust)) + "\n")


def _line(verdict: Verdict, annotation: Annotation | None) -> str:
    if verdict.p_slip is None:
        finding = ", ".join(verdict.reasons)
    else:
        finding = f"p_slip {verdict.p_slip:.3f}"
    gate = "" if verdict.gate is None else f"{verdict.gate:9}"
    said = f"{verdict.verdict:8}"
    if verdict.verdict in COLOURS:
        said = coloured(said, COLOURS[verdict.verdict])
    line = f"{verdict.grasp:6d}  {gate}{said}{finding:16}{verdict.latency_us:6.0f} us"
    if annotation is not None:
        line += f"  {printable(annotation.object_name or '', NAME_MAX)}"
        if annotation.slipped is not None:
            line += f" (was {'slip' if annotation.slipped else 'stable'})"
    return line.rstrip()
