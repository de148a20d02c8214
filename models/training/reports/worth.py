"""`graspd report worth`: reliability of `stable` on another day, from its first grasp on.

Trains graspd's default and the published network on some days. Both judge grasps of another day and
of other objects, each after the outcomes of those before it.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator, Sequence
from typing import Any, Final

import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from sklearn.metrics import f1_score

from graspd.models.training.commands.common import progress_bar
from graspd.models.training.data.datasets import read_all
from graspd.models.training.data.protocols import DAYS, DAYS_FOLDS, splits
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
    fitted_scales,
    reliability,
    reliability_lines,
)
from graspd.models.training.reports.streams import Stream, live, streams
from graspd.models.trust.learner import SCALE
from graspd.models.trust.risk import BUDGET_START, RiskLimits
from graspd.models.zoo import read_card

ALLOWED: Final = 0.05
TARGETS: Final = (0.02, ALLOWED, 0.1, 0.2)
WARM_UP, EXPLORE = 50, 0.05
"""Defaults of `warm_up`, outcomes, and `explore`, a share, in the scene's `[risk]`."""
WARM_UPS: Final = (0, 20, WARM_UP, 100)
"""Lengths of the warm-up that are compared, outcomes."""
ALL_DAYS: Final = "all"
GRASPS: Final = (0, 10, 25, 50, 75, 100, 150, 200, 250, 300)
"""Limits of the parts of a day over which figures are averaged, grasps since its start."""
LEAST: Final = 100
"""Fewest grasps of a part, over all streams; smaller parts are left out."""
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
"""Width and height at which the pages show the picture, inches."""
FONT_PT: Final = 9.0
BY_GRASP: Final = "slips among `stable` / good lifts kept, %, by grasp of the day"


Figures = dict[str, Any]
"""Figures by name: fractions, unless the name says otherwise; NaN: no grasp."""
Curves = dict[str, list[Figures]]
"""Figures of the parts of the day, by method: `grasps`, the middle of the part;
`slips_among_stable`; `coverage`, the share of the grasps that held which were called stable."""


def run(args: argparse.Namespace) -> int:
    """Measure, draw and print. Raises `DatasetError`, `ModelError`, `OSError` or, for data without
    a day or its objects, `TooFewGraspsError`."""
    grasps = read_all(args.data)
    grasps = grasps.few() if args.quick else grasps
    for seed in range(args.seeds):
        splits("days", grasps, seed, DAYS_FOLDS)
    if args.card is not None:
        read_card(args.card)  # fail now, not after the trainings
    args.out.mkdir(parents=True, exist_ok=True)
    with progress_bar("trainings", args.seeds * DAYS_FOLDS * len(DAYS)) as on_day:
        if args.quick:
            several = list(streams(grasps, seeds=1, folds=1, epochs=1))
        else:
            several = list(streams(grasps, args.seeds, on_day=on_day))
    quick = " --quick" if args.quick else ""
    worth = worth_of(several, f"graspd report worth --data DIR --seeds {args.seeds}{quick}")
    text = "\n".join([*([f"**{QUICK}**", ""] if quick else []), *lines(worth)])
    write_whole(args.out / "worth.json", to_json(worth))
    write_whole(args.out / "worth.md", f"{text}\n".encode())
    write_whole(args.out / "worth.svg", draw(worth["curves"], quick=args.quick).encode())
    if args.card is not None:
        write_whole(args.card, to_json({**read_card(args.card), "worth": worth}))
    sys.stdout.write(f"{text}\n")
    return 0


def worth_of(several: Sequence[Stream], command: str) -> Figures:
    """Run `live` on all streams, with scales fitted on other objects; return the figures.

    `risk` is by target and day, `warm_up` by its length at a target of `ALLOWED`, `days` F1 of
    the judged grasps of a day without outcomes (`alone`) and with them (`learning`).
    """
    unscaled = [live(one, RiskLimits(), every=True, scale=1.0) for one in several]
    scales = fitted_scales(pd.concat(unscaled))

    def lives(chosen: RiskLimits, *, every: bool) -> pd.DataFrame:
        lived = []
        for one in several:
            first = one.rows.iloc[0]
            scale = scales.get((first["split"], first["fold"]), SCALE)
            lived.append(live(one, chosen, every=every, scale=scale))
        return pd.concat(lived, ignore_index=True)

    learning = lives(RiskLimits(), every=True)
    risks = {target: lives(limits(target), every=False) for target in TARGETS}
    warm_ups = {
        count: risks[ALLOWED] if count == WARM_UP else lives(limits(ALLOWED, count), every=False)
        for count in WARM_UPS
    }
    return {
        "command": command,
        "sessions": len(several),
        "curves": measured(learning, risks[ALLOWED]),
        "risk": [
            risk_figures(of_day, target, day)
            for target, of_target in risks.items()
            for day, of_day in of_target.groupby("day")
        ],
        "warm_up": [
            risk_figures(rows, ALLOWED, ALL_DAYS, count) for count, rows in warm_ups.items()
        ],
        "days": [_day_f1(day, of_day) for day, of_day in learning.groupby("day")],
        "reliability": reliability(learning, scales),
    }


def limits(share: float, warm_up: int = WARM_UP) -> RiskLimits:
    """Return the limits of a scene with this allowed share of slips and `warm_up`, in outcomes."""
    return RiskLimits(share, warm_up, EXPLORE)


def measured(learning: pd.DataFrame, risk: pd.DataFrame) -> Curves:
    """Return each method's `slips_among_stable` and `coverage` by part of the day, all streams.

    `learning`, `risk`: rows of `live` without and with a risk target.
    """
    said = {
        PUBLISHED: learning["published"] < 0.0,
        ALONE: (learning["margin"] < 0.0) & ~learning["refused"],
        LEARNING: learning["stable"],
        RISK: risk["stable"],
    }
    return {name: _curve(learning.assign(stable=stable)) for name, stable in said.items()}


def _curve(rows: pd.DataFrame) -> list[Figures]:
    return [
        {
            "grasps": int(part.left + part.right) // 2,
            "slips_among_stable": inside["slipped"][inside["stable"]].mean(),
            "coverage": inside["stable"][~inside["slipped"]].mean(),
        }
        for part, inside in rows.groupby(pd.cut(rows["grasp"], GRASPS, right=False), observed=True)
        if len(inside) >= LEAST
    ]


def risk_figures(rows: pd.DataFrame, target: float, day: str, warm_up: int = WARM_UP) -> Figures:
    """Return the figures under a risk target in rows of `live`, of one day or of `ALL_DAYS`.

    `kept`: share of `stable` among the grasps that held, mean of the sessions; `slips`: share of
    slips among all `stable` grasps; `above`: share of the sessions in which more than the target
    slipped; `supervised`: lifts under supervision that a session asks for, mean of the sessions.
    """
    slipped = rows["slipped"]
    sessions = (
        rows.assign(held=~slipped, slips=rows["stable"] & slipped)
        .groupby("session")[["stable", "supervised", "held", "slips"]]
        .sum()
    )
    stable, slips = sessions["stable"], sessions["slips"]
    return {
        "target": target,
        "warm_up": warm_up,
        "day": day,
        "sessions": len(sessions),
        "kept": ((stable - slips) / sessions["held"].clip(lower=1)).to_numpy().mean(),
        "slips": slips.sum() / max(stable.sum(), 1),
        "above": (slips > target * stable).mean(),
        "supervised": sessions["supervised"].mean(),
    }


def _day_f1(day: str, learning: pd.DataFrame) -> Figures:
    rows = learning[~learning["refused"]]
    said = {"alone": rows["margin"] >= 0.0, "learning": rows["p_slip"] >= 0.5}
    f1 = {name: f1_score(rows["slipped"], slip, zero_division=0.0) for name, slip in said.items()}
    return {"day": day, "sessions": learning["session"].nunique(), **f1}


def lines(worth: Figures) -> Iterator[str]:
    """Yield the report in Markdown, figures in %."""
    yield from curve_lines(worth["curves"])
    yield ""
    shown = ["sessions", "good lifts kept, %", "slips among `stable`, %",
             "sessions above the target, %", "supervised lifts of a session"]  # fmt: skip
    risk = ([f"{one['target']:g}", one["day"], *_risk_cells(one)] for one in worth["risk"])
    yield from markdown_table(["target", "day", *shown], risk)
    yield ""
    warm_ups = ([str(one["warm_up"]), *_risk_cells(one)] for one in worth["warm_up"])
    yield from markdown_table([f"warm-up, target {ALLOWED:g}", *shown], warm_ups)
    yield ""
    titles = ["day", "sessions", "F1 of judged, nothing told, %", "F1 of judged, learning, %"]
    days = (
        [one["day"], str(one["sessions"]), *_percents(one["alone"], one["learning"])]
        for one in worth["days"]
    )
    yield from markdown_table(titles, days)
    yield ""
    yield from reliability_lines(worth["reliability"])
    yield ""
    yield f"{worth['sessions']} sessions, each from nothing; `{worth['command']}`."


def _risk_cells(one: Figures) -> list[str]:
    shares = _percents(one["kept"], one["slips"], one["above"])
    return [str(one["sessions"]), *shares, f"{one['supervised']:.0f}"]


def _percents(*fractions: float) -> list[str]:
    return [f"{100 * fraction:.1f}" for fraction in fractions]


def curve_lines(curves: Curves) -> list[str]:
    """Return a Markdown table by part of the day, in %: slips among stable / good lifts kept."""
    grasps = [point["grasps"] for point in curves[PUBLISHED]]
    rows = [
        [
            name,
            *(f"{100 * p['slips_among_stable']:.0f} / {100 * p['coverage']:.0f}" for p in points),
        ]
        for name, points in curves.items()
    ]
    return list(markdown_table((BY_GRASP, *map(str, grasps)), rows))


def draw(curves: Curves, *, quick: bool = False) -> str:
    """Return an SVG of slips among `stable`, and of good lifts called so, by grasp of the day."""
    with style():
        figure = Figure(figsize=SIZE_IN, layout="constrained")
        left, right = figure.subplots(1, 2)
        for name, points in curves.items():
            grasps = [point["grasps"] for point in points]
            slips = [100 * point["slips_among_stable"] for point in points]
            kept = [100 * point["coverage"] for point in points]
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
