"""The demo's table: the published method beside graspd on the same grasps."""

from __future__ import annotations

import sys

from graspd.daemon.judge.network import Examined, Network
from graspd.daemon.judge.reasons import Decision
from graspd.daemon.process.text import Colour, coloured
from graspd.daemon.publish.companion import Companion, PublishedVerdict
from graspd.daemon.run.summary import Tally
from graspd.daemon.trust.trust import Trust
from graspd.models.runtime import TactileModel

GRASPS = 25
"""Grasps of one line."""
PUBLISHED = "cnn1"
"""Name of the published network in the zoo."""
COLUMNS = f"{'stable':>8}{'slipped':>15}{'good lifts kept':>18}"


class Demo(Companion):
    """Writes a line for every `GRASPS` grasps, and the sums at the end."""

    def __init__(self, published: TactileModel) -> None:
        """`published` judges every grasp without session, outcomes or refusal."""
        self._published = Network(published, 0.5)
        self._part = Tally(), Tally()
        self._whole = Tally(), Tally()
        self._grasps = 0
        self._write(
            "A day on which the sensors drift. All grasps are synthetic: nobody ever grasped them.",
            "",
            coloured(
                f"{'':10}{f'the published method ({PUBLISHED})':>{len(COLUMNS)}}"
                f"{'graspd':>{len(COLUMNS)}}",
                Colour.BOLD,
            ),
            coloured(f"{'grasps':10}{COLUMNS}{COLUMNS}", Colour.BOLD),
        )

    def on_verdict(self, published: PublishedVerdict) -> None:
        """Count a grasp."""
        verdict, reading = published.verdict, published.reading
        note = None if reading is None else reading.annotation
        if reading is None or note is None or note.slipped is None:
            return
        p_slip = self._published.judge(Examined((), reading.counts)).p_slip
        if p_slip is None:
            said = Decision.UNKNOWN
        else:
            said = Decision.SLIP if p_slip >= 0.5 else Decision.STABLE
        for tallies in (self._part, self._whole):
            tallies[0].add(said, (), note.slipped)
            tallies[1].add(verdict.verdict, verdict.reasons, note.slipped)
        self._grasps += 1
        if self._grasps % GRASPS == 0:
            allowed = None if verdict.risk is None else verdict.risk.target
            self._line(f"{self._grasps - GRASPS + 1}-{self._grasps}", self._part, allowed)
            self._part = Tally(), Tally()

    def summary(self, trust: Trust | None) -> None:
        """Write the last lines; `trust` is what outcomes have taught."""
        if trust is None:
            raise ValueError("the demo shows what outcomes teach")
        report = trust.report()
        self._line("all", self._whole, report.target)
        self._write("", f"graspd learned from {trust.learner.outcomes} outcomes of lifts.")
        if report.target is not None and report.bound is not None:
            self._write(
                f"Of its {report.lifts} `stable` {report.slips} slipped; at most "
                f"{int(report.bound)} can, whatever drifts: {100 * report.target:g} % of them, "
                f"and {report.beyond_share:.2f} more."
            )
        self._write("Each verdict: --verbose. Real grasps: `graspd data`.")

    def _line(self, grasps: str, tallies: tuple[Tally, Tally], allowed: float | None) -> None:
        self._write(f"{grasps:10}{''.join(self._cells(tally, allowed) for tally in tallies)}")

    def _cells(self, tally: Tally, allowed: float | None) -> str:
        stable, slips = tally.stable
        worth = tally.worth() or {}
        share, kept = worth.get("slips_among_stable"), worth.get("coverage")
        slipped = f"{slips:9}" + (f"{100 * share:4.0f} %" if share is not None else f"{'-':>6}")
        if share is not None and allowed is not None:
            slipped = coloured(slipped, Colour.RED if share > allowed else Colour.GREEN)
        good = f"{100 * kept:.0f} %" if kept is not None else "-"
        return f"{stable:8}{slipped}{good:>18}"

    def _write(self, *lines: str) -> None:
        sys.stdout.writelines(f"{line}\n" for line in lines)
        sys.stdout.flush()
