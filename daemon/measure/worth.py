"""`graspd report worth`: what `stable` is worth on another day, from its first grasp on.

Trains graspd's default and the published network on some days. Both judge grasps of another day and
of other objects, each after the outcomes of those before it.
"""

from __future__ import annotations

import argparse
import io
import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from graspd.daemon.measure.reliability import reliability_table
from graspd.daemon.measure.streams import Life, Stream, live, streams
from graspd.daemon.process.text import complain, markdown_table, progress, write_lines
from graspd.daemon.trust.risk import RiskLimits
from graspd.models.training.data.datasets import DatasetError, read_all

ALLOWED: Final = 0.05
TARGETS: Final = (ALLOWED, 0.1)
WARM_UP, EXPLORE = 50, 0.05
"""Of the scene's `[risk]`, as it is unless it is set."""
GRASPS: Final = (0, 10, 25, 50, 75, 100, 150, 200, 250, 300)
"""Ends of the parts that the figures are means of, grasps of the day."""
LEAST: Final = 100
"""Parts with fewer grasps in all streams are left out."""
QUICK_EVERY: Final = 20
"""With `--quick`, one of this many grasps is used."""
PUBLISHED, ALONE, LEARNING, RISK = (
    "the published method (cnn1)",
    "graspd, nothing told",
    "graspd, learning",
    f"graspd, at most {100 * ALLOWED:g} % slips allowed",
)
COLOURS: Final = {PUBLISHED: "#c65d21", ALONE: "#9a8f2f", LEARNING: "#1f6f8b", RISK: "#123f50"}
STYLES: Final = {PUBLISHED: "s-", ALONE: "o:", LEARNING: "o-", RISK: "o-"}


@dataclass(frozen=True, slots=True)
class WorthPoint:
    """Figures of a part of the day."""

    grasps: int
    """Middle of the part."""
    slips_among_stable: float
    """Fraction; NaN without stable grasps."""
    coverage: float
    """Fraction of the grasps that held which were called stable."""


def run(args: argparse.Namespace) -> int:
    """Measure, draw and print; 2 if data or folder are wrong."""
    try:
        grasps = read_all(args.data)
        args.out.mkdir(parents=True, exist_ok=True)
        if args.quick:
            grasps = grasps.rows(np.arange(0, len(grasps), QUICK_EVERY))
            several = list(streams(grasps, seeds=1, folds=1, epochs=1))
        else:
            several = list(streams(grasps, args.seeds))
        progress("")
        learning = [live(one, RiskLimits(), every=True) for one in several]
        lives = {
            share: [live(one, limits(share), every=False) for one in several] for share in TARGETS
        }
        curves = measured(several, learning, lives[ALLOWED])
        tables = (table(curves), risk_table(several, lives), reliability_table(several, learning))
        text = "\n".join("\n".join(lines) + "\n" for lines in tables)
        (args.out / "worth.md").write_text(text)
        (args.out / "worth.svg").write_text(draw(curves))
    except (DatasetError, OSError) as error:
        complain(error)
        return 2
    write_lines(text)
    return 0


Curves = dict[str, list[WorthPoint]]


def limits(share: float) -> RiskLimits:
    """Return the limits of a scene that sets this share and nothing else."""
    return RiskLimits(share, WARM_UP, EXPLORE)


def measured(several: Sequence[Stream], learning: Sequence[Life], risk: Sequence[Life]) -> Curves:
    """Return how often `stable` was said and slipped, over all streams together."""
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


def table(curves: Curves) -> list[str]:
    """Return a table of slips among stable / good lifts kept, in %."""
    grasps = [point.grasps for point in curves[PUBLISHED]]
    rows = [
        [name, *(f"{100 * p.slips_among_stable:.0f} / {100 * p.coverage:.0f}" for p in points)]
        for name, points in curves.items()
    ]
    titles = ("slips among `stable` / good lifts kept, %, by grasp of the day", *map(str, grasps))
    return list(markdown_table(titles, rows))


@dataclass(frozen=True, slots=True)
class RiskFigures:
    """What became of a target in some streams, as fractions."""

    kept: float
    """Of all grasps that held, mean of the streams."""
    slips: float
    """Of all that was called stable."""
    above: float
    """Of the streams: those of which more than the target slipped."""


def risk_figures(several: Sequence[Stream], lives: Sequence[Life], target: float) -> RiskFigures:
    """Return what a target kept; every life must be of its stream."""
    kept, stable, slips, above = [], 0, 0, 0
    for one, life in zip(several, lives, strict=True):
        called, slipped = int(life.stable.sum()), int((life.stable & one.slipped).sum())
        kept.append((called - slipped) / max(int((~one.slipped).sum()), 1))
        stable, slips = stable + called, slips + slipped
        above += slipped > target * called
    return RiskFigures(float(np.mean(kept)), slips / max(stable, 1), above / max(len(kept), 1))


def risk_table(several: Sequence[Stream], lives: dict[float, list[Life]]) -> list[str]:
    """Return what each target kept on each day, in %."""
    rows = []
    days = sorted({one.protocol for one in several})
    for target, of_target in lives.items():
        for day in days:
            chosen = [index for index, one in enumerate(several) if one.protocol == day]
            figures = risk_figures(
                [several[index] for index in chosen], [of_target[index] for index in chosen], target
            )
            shares = (figures.kept, figures.slips, figures.above)
            sessions = str(len(chosen))
            rows.append([f"{target:g}", day, sessions, *(f"{100 * share:.1f}" for share in shares)])
    titles = ("target", "day", "sessions", "good lifts kept, %", "slips among `stable`, %",
              "sessions above the target, %")  # fmt: skip
    return list(markdown_table(titles, rows))


def draw(curves: Curves) -> str:
    """Draw both figures against outcomes told, as SVG."""
    mpl.rcParams["svg.hashsalt"] = "graspd"
    figure = Figure(figsize=(11.0, 4.4), layout="constrained")
    left, right = figure.subplots(1, 2)
    for name, points in curves.items():
        grasps = [point.grasps for point in points]
        slips = [100 * point.slips_among_stable for point in points]
        kept = [100 * point.coverage for point in points]
        for axes, values in ((left, slips), (right, kept)):
            axes.plot(grasps, values, STYLES[name], color=COLOURS[name], label=name, markersize=5)
    left.axhline(100 * ALLOWED, color="#888", ls=":", lw=1)
    left.text(1.0, 100 * ALLOWED, "allowed ", transform=left.get_yaxis_transform(), ha="right",
              va="bottom", fontsize=8, color="#666")  # fmt: skip
    _dress(left, "slips among 'stable', %")
    _dress(right, "good lifts that are called 'stable', %")
    right.set_ylim(0, 100)
    figure.legend(*left.get_legend_handles_labels(), loc="outside upper center", ncols=4,
                  frameon=False, fontsize=9)  # fmt: skip
    text = io.StringIO()
    figure.savefig(text, format="svg", metadata={"Date": None, "Creator": None})
    return text.getvalue()


def _dress(axes: Any, title: str) -> None:  # noqa: ANN401 - matplotlib's own
    axes.set_xlabel("grasps of a day and of objects that were not trained on")
    axes.set_ylabel(title)
    axes.set_ylim(bottom=0)
    axes.grid(alpha=0.25)
