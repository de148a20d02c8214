"""Print verdicts on standard output, for people or for programs."""

from __future__ import annotations

import json
import sys
import time

from graspd.daemon.judge.reasons import Decision, GateState
from graspd.daemon.process.text import Colour, coloured, printable
from graspd.daemon.publish.companion import Companion, PublishedVerdict
from graspd.daemon.publish.messages import Verdict
from graspd.daemon.run.summary import RunSummary
from graspd.daemon.trust.lift_book import Report
from graspd.daemon.trust.trust import Trust
from graspd.drivers.base import Annotation

NAME_MAX = 80
"""Most printed characters of an object's name."""
COLOURS = {Decision.STABLE: Colour.GREEN, Decision.SLIP: Colour.RED}


class Printer(Companion):
    """Print verdicts when they come, and a summary at the end."""

    def __init__(self, *, as_json: bool) -> None:
        """`as_json`: True prints whole messages, and the summary on stderr."""
        self._as_json = as_json
        self.result = RunSummary()
        self._start_s = time.monotonic()
        self._gate: GateState | None = None

    def on_verdict(self, published: PublishedVerdict) -> None:
        """Print a verdict, and the recorded outcome of its lift, if there is one."""
        verdict, reading = published.verdict, published.reading
        annotation = reading.annotation if reading else None
        self.result.add(verdict, annotation.slipped if annotation else None)
        if not self._as_json and not self._is_news(verdict):
            return
        line = published.payload.decode() if self._as_json else _line(verdict, annotation)
        sys.stdout.write(line + "\n")
        sys.stdout.flush()  # also into a pipe: readings may come in real time

    def _is_news(self, verdict: Verdict) -> bool:
        """Return True if the verdict is new; without a gate each is of a new grasp."""
        if verdict.gate is None or verdict.judged or verdict.gate is not self._gate:
            self._gate = verdict.gate
            return True
        return False

    def on_outcome(self, report: Report) -> None:
        self.result.outcome(report.grasp.grasp, slipped=report.outcome == "slip")

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
