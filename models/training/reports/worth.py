"""`graspd report worth`: what `stable` is worth on another day, from its first grasp on.

Trains graspd's default and the published network on some days. Both judge grasps of another day and
of other objects, each after the outcomes of those before it.
"""

from __future__ import annotations

import argparse
import itertools
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray
from sklearn.metrics import f1_score

from graspd.models.training.commands.common import progress_bar
from graspd.models.training.data.datasets import read_all
from graspd.models.training.data.protocols import DAYS, DAYS_FOLDS
from graspd.models.training.evaluating.files import markdown_table, to_json, write_whole
from graspd.models.training.evaluating.style import (
    BLUE,
    NAVY,
    OLIVE,
    ORANGE,
    QUICK,
    QUIET,
    mark_quick,
    style,
    to_svg,
)
from graspd.models.training.reports.reliability import (
    Reliability,
    fitted_scales,
    reliability,
    reliability_lines,
)
from graspd.models.training.reports.streams import Life, Stream, live, streams
from graspd.models.trust.risk import BUDGET_START, RiskLimits
from graspd.models.zoo import read_card

ALLOWED: Final = 0.05
TARGETS: Final = (0.02, ALLOWED, 0.1, 0.2)
WARM_UP, EXPLORE = 50, 0.05
"""Defaults of the scene's `[risk]`."""
WARM_UPS: Final = (0, 20, WARM_UP, 100)
"""Lengths of the warm-up that are compared, outcomes."""
ALL_DAYS: Final = "all"
GRASPS: Final = (0, 10, 25, 50, 75, 100, 150, 200, 250, 300)
"""Ends of the parts that the figures are means of, grasps of the day."""
LEAST: Final = 100
"""Parts with fewer grasps in all streams are left out."""
PUBLISHED, ALONE, LEARNING, RISK = (
    "the published method (cnn1)",
    "graspd, nothing told",
    "graspd, learning",
    f"graspd, at most {100 * ALLOWED:g} % slips allowed",
)
COLOURS: Final = {PUBLISHED: ORANGE, ALONE: OLIVE, LEARNING: BLUE, RISK: NAVY}
STYLES: Final = {PUBLISHED: "s-", ALONE: "o:", LEARNING: "o-", RISK: "D-"}
BOUND: Final = (
    f"allowed: {100 * ALLOWED:g} % of a session's 'stable' lifts + {BUDGET_START:g} slips,\n"
    "so a part of the day may lie above, above all the first"
)
SIZE_IN: Final = (8.6, 4.4)
"""Size at which the pages show the picture."""
FONT_PT: Final = 9.0
BY_GRASP: Final = "slips among `stable` / good lifts kept, %, by grasp of the day"


@dataclass(frozen=True, slots=True)
class WorthPoint:
    """Figures of a part of the day."""

    grasps: int
    """Middle of the part."""
    slips_among_stable: float
    """Fraction; NaN without stable grasps."""
    coverage: float
    """Fraction of the grasps that held which were called stable."""


Curves = dict[str, list[WorthPoint]]


@dataclass(frozen=True, slots=True)
class RiskFigures:
    """Results of a target in the sessions of one day, as fractions."""

    target: float
    warm_up: int
    """Outcomes."""
    day: str
    sessions: int
    kept: float
    """Share of `stable` among the grasps that held, mean of the sessions."""
    slips: float
    """Share of slips among all `stable` grasps."""
    above: float
    """Share of the sessions in which more than the target slipped."""
    supervised: float
    """Lifts under supervision that a session asks for, mean of the sessions; no fraction."""


@dataclass(frozen=True, slots=True)
class DayF1:
    """F1 of the judged grasps of one day, slip positive, as fractions."""

    day: str
    sessions: int
    alone: float
    """Without outcomes."""
    learning: float


@dataclass(frozen=True, slots=True)
class Worth:
    """All that the report measures."""

    command: str
    sessions: int
    curves: Curves
    risk: list[RiskFigures]
    """By target and day."""
    warm_up: list[RiskFigures]
    """Results of `ALLOWED` by length of the warm-up, all days together."""
    days: list[DayF1]
    reliability: Reliability


def run(args: argparse.Namespace) -> int:
    """Measure, draw and print. Raises `DatasetError`, `ModelError` or `OSError`."""
    grasps = read_all(args.data)
    args.out.mkdir(parents=True, exist_ok=True)
    with progress_bar("trainings", args.seeds * DAYS_FOLDS * len(DAYS)) as on_day:
        if args.quick:
            several = list(streams(grasps.few(), seeds=1, folds=1, epochs=1))
        else:
            several = list(streams(grasps, args.seeds, on_day=on_day))
    quick = " --quick" if args.quick else ""
    worth = worth_of(several, f"graspd report worth --data DIR --seeds {args.seeds}{quick}")
    text = "\n".join([*([f"**{QUICK}**", ""] if quick else []), *lines(worth)])
    write_whole(args.out / "worth.json", to_json(worth))
    write_whole(args.out / "worth.md", f"{text}\n".encode())
    write_whole(args.out / "worth.svg", draw(worth.curves, quick=args.quick).encode())
    if args.card is not None:
        write_whole(args.card, to_json({**read_card(args.card), "worth": worth}))
    sys.stdout.write(f"{text}\n")
    return 0


def worth_of(several: Sequence[Stream], command: str) -> Worth:
    """Live all streams, with scales that were fitted on other objects, and measure them."""
    unscaled = [live(one, RiskLimits(), every=True, scale=1.0) for one in several]
    scales = fitted_scales(unscaled)

    def lives(chosen: RiskLimits, *, every: bool) -> list[Life]:
        return [live(one, chosen, every=every, scale=scales[one.group]) for one in several]

    learning = lives(RiskLimits(), every=True)
    risks = {target: lives(limits(target), every=False) for target in TARGETS}
    warm_ups = {
        count: risks[ALLOWED] if count == WARM_UP else lives(limits(ALLOWED, count), every=False)
        for count in WARM_UPS
    }
    return Worth(
        command,
        len(several),
        measured(learning, risks[ALLOWED]),
        [
            risk_figures(of_day, target, day)
            for target, of_target in risks.items()
            for day, of_day in _by_day(of_target).items()
        ],
        [risk_figures(lived, ALLOWED, ALL_DAYS, count) for count, lived in warm_ups.items()],
        [_day_f1(day, of_day) for day, of_day in _by_day(learning).items()],
        reliability(learning, scales),
    )


def limits(share: float, warm_up: int = WARM_UP) -> RiskLimits:
    """Return the limits of a scene that sets this share and this warm-up."""
    return RiskLimits(share, warm_up, EXPLORE)


def measured(learning: Sequence[Life], risk: Sequence[Life]) -> Curves:
    """Return how often `stable` was said and slipped, over all streams together."""
    several = [life.stream for life in learning]
    said = {
        PUBLISHED: [one.published < 0.0 for one in several],
        ALONE: [(one.margins < 0.0) & ~one.refused for one in several],
        LEARNING: [life.stable for life in learning],
        RISK: [life.stable for life in risk],
    }
    slipped = [one.slipped for one in several]
    return {name: _curve(stable, slipped) for name, stable in said.items()}


def _curve(
    stable: Sequence[NDArray[np.bool_]], slipped: Sequence[NDArray[np.bool_]]
) -> list[WorthPoint]:
    points = []
    for first, last in itertools.pairwise(GRASPS):
        said = np.concatenate([one[first:last] for one in stable])
        slips = np.concatenate([one[first:last] for one in slipped])
        if len(said) < LEAST:
            break
        among = float(slips[said].mean()) if said.any() else float("nan")
        points.append(WorthPoint((first + last) // 2, among, float(said[~slips].mean())))
    return points


def risk_figures(
    lives: Sequence[Life], target: float, day: str, warm_up: int = WARM_UP
) -> RiskFigures:
    """Return what a target kept in these lives, which are all of one day or of `ALL_DAYS`."""
    kept, stable, slips, above = [], 0, 0, 0
    for life in lives:
        ended = life.stream.slipped
        called, slipped = int(life.stable.sum()), int((life.stable & ended).sum())
        kept.append((called - slipped) / max(int((~ended).sum()), 1))
        stable, slips = stable + called, slips + slipped
        above += slipped > target * called
    return RiskFigures(
        target,
        warm_up,
        day,
        len(lives),
        float(np.mean(kept)),
        slips / max(stable, 1),
        above / len(lives),
        float(np.mean([life.supervised.sum() for life in lives])),
    )


def _day_f1(day: str, learning: Sequence[Life]) -> DayF1:
    several = [life.stream for life in learning]
    judged = ~np.concatenate([one.refused for one in several])
    slipped = np.concatenate([one.slipped for one in several])[judged]
    alone = np.concatenate([one.margins for one in several])[judged] >= 0.0
    after = np.concatenate([life.p_slip for life in learning])[judged] >= 0.5
    f1 = (float(f1_score(slipped, called, zero_division=0.0)) for called in (alone, after))
    return DayF1(day, len(learning), *f1)


def _by_day(lives: Sequence[Life]) -> dict[str, list[Life]]:
    days = sorted({life.stream.protocol for life in lives})
    return {day: [life for life in lives if life.stream.protocol == day] for day in days}


def lines(worth: Worth) -> Iterator[str]:
    """Yield the report in Markdown, figures in %."""
    yield from curve_lines(worth.curves)
    yield ""
    shown = ["sessions", "good lifts kept, %", "slips among `stable`, %",
             "sessions above the target, %", "supervised lifts of a session"]  # fmt: skip
    risk = ([f"{one.target:g}", one.day, *_risk_cells(one)] for one in worth.risk)
    yield from markdown_table(["target", "day", *shown], risk)
    yield ""
    warm_ups = ([str(one.warm_up), *_risk_cells(one)] for one in worth.warm_up)
    yield from markdown_table([f"warm-up, target {ALLOWED:g}", *shown], warm_ups)
    yield ""
    titles = ["day", "sessions", "F1 of judged, nothing told, %", "F1 of judged, learning, %"]
    days = ([one.day, str(one.sessions), *_percents(one.alone, one.learning)] for one in worth.days)
    yield from markdown_table(titles, days)
    yield ""
    yield from reliability_lines(worth.reliability)
    yield ""
    yield f"{worth.sessions} sessions, each from nothing; `{worth.command}`."


def _risk_cells(one: RiskFigures) -> list[str]:
    shares = _percents(one.kept, one.slips, one.above)
    return [str(one.sessions), *shares, f"{one.supervised:.0f}"]


def _percents(*fractions: float) -> list[str]:
    return [f"{100 * fraction:.1f}" for fraction in fractions]


def curve_lines(curves: Curves) -> list[str]:
    """Return a table of slips among stable / good lifts kept, in %."""
    grasps = [point.grasps for point in curves[PUBLISHED]]
    rows = [
        [name, *(f"{100 * p.slips_among_stable:.0f} / {100 * p.coverage:.0f}" for p in points)]
        for name, points in curves.items()
    ]
    return list(markdown_table((BY_GRASP, *map(str, grasps)), rows))


def draw(curves: Curves, *, quick: bool = False) -> str:
    """Draw both figures by grasp of the day, as SVG."""
    with style():
        figure = Figure(figsize=SIZE_IN, layout="constrained")
        left, right = figure.subplots(1, 2)
        for name, points in curves.items():
            grasps = [point.grasps for point in points]
            slips = [100 * point.slips_among_stable for point in points]
            kept = [100 * point.coverage for point in points]
            for axes, values in ((left, slips), (right, kept)):
                axes.plot(grasps, values, STYLES[name], color=COLOURS[name], label=name, ms=5)
        left.axhline(100 * ALLOWED, color=QUIET, ls=":", lw=1.5, label=BOUND)
        _dress(left, "slips among 'stable', %")
        _dress(right, "good lifts that are called 'stable', %")
        right.set_ylim(0, 100)
        figure.supxlabel("grasp of a day and of objects that were not trained on", fontsize=FONT_PT)
        figure.legend(*left.get_legend_handles_labels(), loc="outside upper center", ncols=2,
                      fontsize=FONT_PT)  # fmt: skip
        if quick:
            mark_quick(figure)
        return to_svg(figure, "What `stable` is worth on another day", curve_lines(curves))


def _dress(axes: Axes, title: str) -> None:
    axes.set_title(title, fontsize=FONT_PT)
    axes.tick_params(labelsize=FONT_PT)
    axes.set_ylim(bottom=0)
