"""A table that compares the published method and graspd by outcomes, a line per 25 grasps."""

from __future__ import annotations

import sys
from collections.abc import Sequence

from graspd.daemon.judge.reasons import Decision
from graspd.daemon.process.text import Colour, coloured, write_lines
from graspd.daemon.publish.companion import Companion, PublishedVerdict
from graspd.daemon.run.summary import Tally
from graspd.daemon.trust.trust import Trust
from graspd.models.judge.grasp_judge import Examined, GraspJudge
from graspd.models.runtime import TactileModel

GRASPS = 25
"""Number of grasps that one line counts."""
PUBLISHED = "cnn1"
"""Name of the published network in the zoo."""
COLUMNS = f"{'stable':>7}{'slipped':>11}{'good lifts kept':>17}"


class DayTable(Companion):
    """Writes a line for every `GRASPS` grasps, and the totals at the end."""

    def __init__(
        self, title: str, published: TactileModel, model: str, warnings: Sequence[str] = ()
    ) -> None:
        """`published`: network that judges each grasp without session, outcomes or refusal.

        `model`: name of graspd's model. `title`, `warnings`: lines to write above the table.
        """
        self._published = GraspJudge.of(published)
        self._part = Tally(), Tally()
        self._whole = Tally(), Tally()
        methods = f"the published method ({PUBLISHED})", f"graspd ({model})"
        heads = "".join(f"{method:>{len(COLUMNS)}}" for method in methods)
        self._write(
            title,
            *warnings,
            "",
            coloured(f"{'':9}{heads}", Colour.BOLD),
            coloured(f"{'grasps':9}{COLUMNS}{COLUMNS}", Colour.BOLD),
        )

    def on_verdict(self, published: PublishedVerdict) -> None:
        """Count a grasp whose outcome is recorded; write a line after each `GRASPS` of them."""
        verdict, reading = published.verdict, published.reading
        note = None if reading is None else reading.annotation
        if reading is None or note is None or note.slipped is None:
            return
        p_slip = self._published.judge(Examined(reading.counts)).p_slip
        if p_slip is None:
            said = Decision.UNKNOWN
        else:
            said = Decision.SLIP if p_slip >= 0.5 else Decision.STABLE
        for tallies in (self._part, self._whole):
            tallies[0].add(said, (), note.slipped)
            tallies[1].add(verdict.verdict, verdict.reasons, note.slipped)
        if self._part[0].labelled == GRASPS:
            self._end_part(None if verdict.risk is None else verdict.risk.target)

    def _end_part(self, allowed: float | None) -> None:
        last = self._whole[0].labelled
        first = last - self._part[0].labelled + 1
        self._line(f"{first}-{last}", self._part, allowed)
        self._part = Tally(), Tally()

    def summary(self, trust: Trust | None) -> None:
        """Write the totals, and what outcomes taught. `trust`: None: the run does not learn."""
        report = None if trust is None else trust.report()
        allowed = None if report is None else report.target
        if self._part[0].labelled:
            self._end_part(allowed)
        self._line("all", self._whole, allowed)
        self._write("", *self._figures())
        if trust is not None and trust.lifts.told:
            self._write(f"graspd learned from {trust.learner.outcomes} outcomes of lifts.")
            if report is not None and report.target is not None and report.bound is not None:
                share = f"{100 * report.target:g} % of its `stable`"
                most = int(report.bound)
                self._write(
                    f"At most {most} can slip: {share}, and {report.beyond_share:.2f} more."
                )
        self._write("Each verdict and all scores: --verbose.")

    def _figures(self) -> list[str]:
        """Return three lines of counts in all: slips among `stable`, held lifts kept, `unknown`."""
        published, graspd = self._whole
        return [
            f"`stable` that slipped  {_slips(graspd)}, published {_slips(published)}",
            f"good lifts kept        {_kept(graspd)}, published {_kept(published)}",
            f"unknown, grasp again   {graspd.decisions[Decision.UNKNOWN]} of {graspd.labelled}, "
            f"published {published.decisions[Decision.UNKNOWN]}",
        ]

    def _line(self, grasps: str, tallies: tuple[Tally, Tally], allowed: float | None) -> None:
        self._write(f"{grasps:9}{''.join(self._cells(tally, allowed) for tally in tallies)}")

    def _cells(self, tally: Tally, allowed: float | None) -> str:
        stable, slips = tally.stable
        worth = tally.worth() or {}
        share, kept = worth.get("slips_among_stable"), worth.get("coverage")
        slipped = f"{slips:5}" + (f"{100 * share:4.0f} %" if share is not None else f"{'-':>6}")
        if share is not None and allowed is not None:
            slipped = coloured(slipped, Colour.RED if share > allowed else Colour.GREEN)
        good = f"{100 * kept:.0f} %" if kept is not None else "-"
        return f"{stable:7}{slipped}{good:>17}"

    def _write(self, *lines: str) -> None:
        write_lines(*lines)
        sys.stdout.flush()


def _slips(tally: Tally) -> str:
    stable, slips = tally.stable
    share = f" ({100 * slips / stable:.0f} %)" if stable else ""
    return f"{slips} of {stable}{share}"


def _kept(tally: Tally) -> str:
    held = tally.confusion[False, False]
    share = f" ({100 * held / tally.held:.0f} %)" if tally.held else ""
    return f"{held} of {tally.held}{share}"
